"""Serve a page with viser: the nodes of its scenes, the controls, and the simplification."""

import math
import re
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.errors import CvtgsError, OutputError, OutputExistsError, memory_errors
from cvtgs.io.files import is_within
from cvtgs.math.frames import robust_frame
from cvtgs.math.parameters import build_covariances, normalize_quats
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene
from cvtgs.text import counted, printable, printable_name, shortened, shown
from cvtgs.validity import valid_part
from cvtgs.viewer.connection import start_server, stop_server
from cvtgs.viewer.scenes import FULL, SIMPLIFIED, SceneViewer, camera_of
from cvtgs.views import automatic_views
from cvtgs.views.layout import find_layout

if TYPE_CHECKING:
    import viser

Point = tuple[float, float, float]

_FLIP_SECONDS = 2.0  # seconds for which a standalone page shows each scene
_ANY_PORT = 8999  # first port tried for the temporary server that records a standalone page

_ABOVE = 0.85
"""Height of labels in the initial view, as a share of half the image; all scenes share it."""

SLIDER = (-3.5, 0.0, 0.05)
"""Range of the slider in log10 of rho: minimum, maximum, step. It starts lower if need be."""

_MARKUP = re.compile(r"[!-/:-@\[-`{-~]")
"""The characters that Markdown, which may contain HTML, can give a meaning."""

_ADVICE = "free some, or choose another preset"

_CLASSIC_WORKERS = """
if (location.protocol === "file:") {
  const Original = Worker;
  window.Worker = function (url, options) {
    if (options?.type !== "module" || !String(url).startsWith("blob:")) {
      return new Original(url, options);
    }
    const request = new XMLHttpRequest();
    request.open("GET", url, false);
    request.send();
    const code = request.responseText.replaceAll("import.meta.url", "self.location.href");
    return new Original(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  };
}
"""
"""Chromium starts no worker that is a module in a page that was opened as a file. viser's worker
sorts the Gaussians; without it, they are blended in any order."""

_LABEL = 24  # letters of a scene's name in its label, which must fit on a phone

_GIVE_UP = 0.5  # seconds between checks whether the server was closed


def scene_page(scenes: Mapping[str, GaussianScene]) -> str:
    """Return a standalone page with a 3D viewer, whose time line flips between scenes.

    Colours are those of the constant SH band.

    Args:
        scenes: The scenes by name; the camera starts at a good view of the first.

    Returns:
        HTML that needs no server and fetches nothing.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    server = start_server("127.0.0.1", _ANY_PORT)
    try:
        place = look_at(server, next(iter(scenes.values())))
        nodes = []
        for number, (name, scene) in enumerate(scenes.items()):
            nodes.append(SceneNode(server, name, f"/scene {number}", label=place))
            nodes[-1].draw(scene, visible=False)
        return record_page(server, nodes)
    finally:
        stop_server(server)


class SceneNode:
    """A scene on a server, and a label with its name that is shown and hidden with it."""

    def __init__(self, server: "viser.ViserServer", name: str, path: str, *, label: Point) -> None:
        self.name: str = printable_name(name)
        self._server = server
        self._path, self._label = path, label
        self._splats: Any = None
        self._lock = threading.Lock()  # controls are used in other threads than scenes are drawn

    def draw(self, scene: GaussianScene, *, visible: bool) -> None:
        """Draw a scene in place of the current one."""
        part = valid_part(scene).to("cpu")
        part = part.with_tensors({name: x.detach() for name, x in part.tensors().items()})
        covariances = build_covariances(part.scales, normalize_quats(part.quats))
        arrays = {
            "centers": part.means.float().numpy(),
            "covariances": covariances.float().numpy(),
            "rgbs": (0.5 + SH_C0 * part.sh0[:, 0]).clamp(0, 1).float().numpy(),
            "opacities": part.opacities[:, None].float().numpy(),
        }
        with self._lock:
            scene_api = self._server.scene
            self._splats = scene_api.add_gaussian_splats(self._path, **arrays, visible=visible)
            text = f"{counted(len(part), 'Gaussian')}: {shortened(self.name, _LABEL)}"
            scene_api.add_label(f"{self._path}/name", text, position=self._label)

    def show(self, visible: bool) -> None:
        """Show or hide the scene and its label."""
        with self._lock:
            self._splats.visible = visible


def record_page(server: "viser.ViserServer", nodes: Sequence[SceneNode]) -> str:
    """Record the scenes one after the other, and return the page."""
    recorder = server.get_scene_serializer()
    for one in nodes:
        for node in nodes:
            node.show(node is one)
        recorder.insert_sleep(_FLIP_SECONDS)
    names = shortened(", ".join(node.name for node in nodes), 120)
    title = f"<title>Scenes in 3D: {escape(names)}</title>"
    page = str(recorder.as_html(dark_mode=True))
    page = re.sub("<title>.*?</title>", lambda _: title, page, count=1)
    return page.replace("<head>", f"<head><script>{_CLASSIC_WORKERS}</script>", 1)


def look_at(server: "viser.ViserServer", scene: GaussianScene) -> Point:
    """Set up and the initial camera to a good view; return the place of labels in it."""
    scene = valid_part(scene.to("cpu"))
    up = find_layout(scene).up
    axis = int(up.abs().argmax())
    server.scene.set_up_direction(f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}")
    camera = automatic_views(scene, 1)
    rotation, center = camera.viewmats[0, :3, :3], camera.centers[0]
    depth = float(rotation[2] @ (robust_frame(scene.means).center.cpu().double() - center))
    depth = max(depth, 1e-3)
    target, half = center + rotation[2] * depth, camera.height / 2 / float(camera.Ks[0, 1, 1])
    server.initial_camera.position = tuple(center.tolist())
    server.initial_camera.look_at = tuple(target.tolist())
    server.initial_camera.fov = 2 * math.atan(half)
    return tuple((target - rotation[1] * (_ABOVE * half * depth)).tolist())


class ViewerServer:
    """A viser server that shows the scenes, with a slider of rho, presets, scores and saving.

    Colours are those of the constant SH band, since viser shows no others; scores use all bands.

    Args:
        viewer: The scenes.
        host: Address to listen on. On one of this machine alone, only the page itself may connect;
            on another, anyone who reaches it may use the page.
        port: Port to listen on; if it is taken, the next free one.
        preset: Preset to start with.
        rho: Ratio to start with, in (0, 1]; it is exact until the slider is moved.

    Raises:
        MissingDependencyError: viser is not installed.
        ConfigError: The preset does not exist.
        InvalidArgumentError: The ratio is out of range, the host is not this machine, or no port
            is free.
    """

    def __init__(
        self,
        viewer: SceneViewer,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        preset: str = "draft",
        rho: float = 0.1,
    ) -> None:
        SimplifyConfig.compose(preset=preset)
        target_count(1, rho)
        self._viewer, self._wanted = viewer, threading.Event()
        self._start: float | None = rho
        self._error: Exception | None = None
        self._closed, self._first = False, threading.Event()
        self._server = start_server(host, port)
        # Like other pages with images; a shared page would go through a server of others.
        self._server.gui.configure_theme(dark_mode=True, show_share_button=False)
        self._label = look_at(self._server, viewer.scenes[FULL].scene)
        gui, low, high, step = self._server.gui, *SLIDER
        self._facts = gui.add_markdown("")
        start = round(math.log10(rho) / step) * step
        self._slider = gui.add_slider(
            "ratio (log10)", min=min(low, start), max=high, step=step, initial_value=start
        )
        presets = tuple(PRESETS)
        self._preset = gui.add_dropdown("preset", presets, initial_value=preset)
        self._shown = gui.add_dropdown(
            "show", tuple(dict.fromkeys((SIMPLIFIED, *viewer.scenes))), initial_value=SIMPLIFIED
        )
        score = gui.add_button("PSNR of this view")
        self._path = gui.add_text("file", "small.ply")
        keep = gui.add_button("Save this scene")
        self._notes = gui.add_markdown("")
        self._slider.on_update(lambda _: self._move())
        self._preset.on_update(lambda _: self._wanted.set())
        self._shown.on_update(lambda _: self._show())
        score.on_click(self._score)
        keep.on_click(lambda _: self._try(self._save))
        self._nodes: dict[str, SceneNode] = {}
        for name, one in viewer.scenes.items():
            self._draw(name, one.scene)
        self._wanted.set()
        # Ctrl+C in Thread.join takes a running thread for an ended one (Python before 3.13).
        self._ended = threading.Event()
        threading.Thread(target=self._work, daemon=True).start()

    def page(self) -> str:
        """Return a standalone page of the current scenes, as :func:`scene_page` does."""
        names = [name for name in (FULL, SIMPLIFIED, *self._nodes) if name in self._nodes]
        html = record_page(self._server, [self._nodes[name] for name in dict.fromkeys(names)])
        self._show()
        return html

    @property
    def address(self) -> str:
        """URL of the page."""
        host = self._server.get_host()
        host = f"[{host}]" if ":" in host else host  # IPv6
        return f"http://{host}:{self._server.get_port()}"

    def wait(self) -> None:
        """Serve until the process is interrupted or the server is closed."""
        while not self._ended.wait(timeout=_GIVE_UP):
            pass

    def finish(self) -> None:
        """Wait until the first simplified scene is shown.

        Raises:
            CvtgsError: It cannot be computed.
        """
        self._first.wait()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Stop the server, and a simplification at its next stage or step."""
        self._closed = True
        self._viewer.stop()
        self._wanted.set()
        self._ended.wait()
        self._viewer.resume()  # another server may show it
        stop_server(self._server)

    def _work(self) -> None:
        """Simplify for the latest position of the slider, until the server is closed."""
        try:
            while not self._closed:
                self._wanted.wait()
                self._wanted.clear()
                if self._closed:
                    break
                self._error = self._try(self._simplify)
                is_first = not self._first.is_set()
                self._first.set()
                if is_first and not (self._wanted.is_set() or self._closed):
                    # The next run reports errors.
                    with suppress(Exception):
                        self._viewer.warm_up(self._preset.value)
        finally:
            self._first.set()
            self._ended.set()

    def _move(self) -> None:
        """Take the ratio from the slider."""
        self._start = None
        self._wanted.set()

    def _simplify(self) -> str:
        slider = self._slider  # another program may send any value
        rho = self._start or 10.0 ** min(slider.max, max(slider.min, slider.value))
        before, self._facts.content = self._facts.content, f"simplifying to {rho:.4g} ..."
        try:
            small = self._viewer.simplify(self._preset.value, rho)
        except Exception:
            self._facts.content = before
            raise
        self._draw(SIMPLIFIED, small.scene)
        self._show()
        return ""

    def _draw(self, name: str, scene: GaussianScene) -> None:
        """Draw a scene; controls are used in other threads, which see only nodes that are drawn."""
        node = self._nodes.get(name)
        if node is None:
            path = f"/scene {len(self._nodes)}"
            node = SceneNode(self._server, name, path, label=self._label)
        node.draw(scene, visible=self._shown.value == name)
        self._nodes = {**self._nodes, name: node}

    def _show(self) -> None:
        for name, node in self._nodes.items():
            node.show(name == self._shown.value)
        if self._shown.value in self._viewer.scenes:
            self._facts.content = self._viewer.scenes[self._shown.value].facts

    def _score(self, event: "viser.GuiEvent[Any]") -> None:
        camera = None if event.client is None else event.client.camera
        if camera is not None:
            self._try(lambda: self._score_view(camera))

    def _score_view(self, camera: "viser.CameraHandle") -> str:
        rotation, position = (tuple(map(float, x)) for x in (camera.wxyz, camera.position))
        height = camera.image_height  # 0 in a window without height, where viser's aspect fails
        aspect = camera.image_width / height if height else 0.0
        cameras = camera_of(rotation, position, fov=camera.fov, aspect=aspect)
        name = self._shown.value
        return f"{name}: {self._viewer.score(name, cameras):.2f} dB in this view"

    def _save(self) -> str:
        """Save the shown scene; with ``host``, others than the user of this machine may do so."""
        name = self._path.value.strip()
        try:
            is_below = Path(name).resolve().is_relative_to(Path.cwd().resolve())  # links followed
        except (OSError, RuntimeError, ValueError) as error:  # no folder, a loop, a null byte
            raise OutputError(f"{shown(name)}: must be a path to write to: {error}.") from error
        if name and not (is_within(name) and is_below):
            raise OutputError(
                f"{name}: a scene is saved in the folder where the program was started, or below."
            )
        try:
            return self._viewer.save(self._shown.value, name)
        except OutputExistsError as error:
            raise OutputError(f"{name} exists already; give another name.") from error

    def _try(self, action: Callable[[], str]) -> Exception | None:
        """Run an action, and show its result or its error, which is returned, on the page."""
        try:
            with memory_errors("this", _ADVICE):
                self._notes.content = plain(action())
        except CvtgsError as error:
            self._notes.content = f"**{plain(str(error))}**"
            return error
        except Exception as error:  # such as for a value that only another program would send
            self._notes.content = f"**unexpected error ({type(error).__name__}): see the terminal**"
            with suppress(OSError, ValueError):  # nothing reads the terminal
                traceback.print_exc()
            return error
        return None


def plain(text: str) -> str:
    """Escape a text for Markdown, so that names with markup in them are shown as they are."""
    return _MARKUP.sub(r"\\\g<0>", printable(text))
