"""A stand-in for the parts of viser 1.1 that the viewer uses: no browser, no network.

Setting the value of a control calls its callbacks, as viser does for values that users or code
set.
"""

from types import SimpleNamespace


class Handle:
    """A control or a scene node with attributes and callbacks."""

    def __init__(self, server, kind, **values):
        self.__dict__.update(server=server, kind=kind, calls=[], **values)

    def __setattr__(self, name, value):
        self.__dict__[name] = value
        self.server.log.append((self.__dict__.get("label", self.kind), name, value))
        if name == "value":
            self.call()

    def on_update(self, callback):
        self.calls.append(callback)
        return callback

    on_click = on_update

    def call(self, client=None):
        for callback in self.calls:
            callback(SimpleNamespace(client=client))


class Gui:
    def __init__(self, server):
        self.server, self.controls = server, {}

    def configure_theme(self, *, dark_mode, show_share_button):
        assert (dark_mode, show_share_button) == (True, False)

    def _add(self, kind, label, **values):
        self.controls[label] = Handle(self.server, kind, label=label, **values)
        return self.controls[label]

    def add_markdown(self, content):
        return self._add("markdown", f"markdown {len(self.controls)}", content=content)

    def add_slider(self, label, min, max, step, initial_value):
        assert min <= initial_value <= max
        return self._add("slider", label, value=initial_value, step=step, min=min, max=max)

    def add_dropdown(self, label, options, *, initial_value):
        assert initial_value in options
        return self._add("dropdown", label, value=initial_value, options=options)

    def add_button(self, label):
        return self._add("button", label)

    def add_text(self, label, initial_value):
        return self._add("text", label, value=initial_value)


class Scene:
    def __init__(self, server):
        self.server, self.nodes, self.labels, self.up = server, {}, {}, None
        self.positions = []

    def set_up_direction(self, direction):
        self.up = direction

    def add_label(self, name, text, *, position):
        assert name.rpartition("/")[0] in self.nodes
        assert len(position) == 3
        self.labels[name] = text
        self.positions.append(position)

    def add_gaussian_splats(self, name, centers, covariances, rgbs, opacities, *, visible):
        n = len(centers)
        assert (covariances.shape, rgbs.shape, opacities.shape) == ((n, 3, 3), (n, 3), (n, 1))
        self.nodes[name] = Handle(self.server, name, name=name, visible=visible, count=n)
        return self.nodes[name]


class Recorder:
    def __init__(self, server):
        self.server, self.shown = server, []

    def insert_sleep(self, duration):
        assert duration > 0
        nodes = self.server.scene.nodes.values()
        self.shown.append([node.count for node in nodes if node.visible])

    def as_html(self, *, dark_mode):
        return f"<html>{self.shown} {dark_mode}</html>"


class ViserServer:
    latest = None

    def __init__(self, host, port, *, label, verbose):
        self.host, self.port, self.log, self.is_open = host, port, [], True
        self.gui, self.scene, self.initial_camera = Gui(self), Scene(self), SimpleNamespace()
        ViserServer.latest = self
        print("a box with addresses")  # noqa: T201 (as viser does)

    def get_host(self):
        return self.host

    def get_port(self):
        return self.port

    def get_scene_serializer(self):
        return Recorder(self)

    def stop(self):
        self.is_open = False
        print("(viser) Server stopped")  # noqa: T201
