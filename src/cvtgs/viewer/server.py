"""The server of the page, with a slider of rho, presets, scores and saving."""

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from cvtgs.config import PRESETS
from cvtgs.errors import CvtgsError
from cvtgs.scene import GaussianScene
from cvtgs.text import printable
from cvtgs.viewer.nodes import SceneNode, look_at, record_page, start_server, stop_server
from cvtgs.viewer.scenes import FULL, SIMPLIFIED, SceneViewer, camera_of

if TYPE_CHECKING:
    import viser

__all__ = ["ViewerServer"]

SLIDER = (-3.5, 0.0, 0.05)
"""Range of the slider in log10 of rho: minimum, maximum, step."""

_GIVE_UP = 0.5
"""Seconds between checks whether the server was closed."""


class ViewerServer:
    """A viser server that shows the scenes, with a slider of rho, presets, scores and saving.

    Colours are those of the constant SH band, since viser shows no others; scores use all bands.

    Args:
        viewer: The scenes.
        host: Address to listen on.
        port: Port to listen on; if it is taken, the next free one.
        preset: Preset to start with.
        rho: Ratio to start with, in (0, 1].

    Raises:
        MissingDependencyError: viser is not installed.
        ConfigError: The preset does not exist.
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
        self._viewer, self._wanted = viewer, threading.Event()
        self._closed, self._first = False, threading.Event()
        self._server = start_server(host, port)
        self._label = look_at(self._server, viewer.scenes[FULL].scene)
        gui, low, high, step = self._server.gui, *SLIDER
        self._facts = gui.add_markdown("")
        start = min(max(math.log10(rho), low), high)
        self._slider = gui.add_slider(
            "log10 of rho", min=low, max=high, step=step, initial_value=round(start / step) * step
        )
        presets = tuple(PRESETS)
        self._preset = gui.add_dropdown("preset", presets, initial_value=preset)
        self._shown = gui.add_dropdown(
            "show", (SIMPLIFIED, *viewer.scenes), initial_value=SIMPLIFIED
        )
        score = gui.add_button("PSNR of this view")
        self._path = gui.add_text("file", "small.ply")
        keep = gui.add_button("save this scene")
        self._notes = gui.add_markdown("")
        self._slider.on_update(lambda _: self._wanted.set())
        self._preset.on_update(lambda _: self._wanted.set())
        self._shown.on_update(lambda _: self._show())
        score.on_click(self._score)
        keep.on_click(lambda _: self._try(self._save))
        self._nodes: dict[str, SceneNode] = {}
        for name, one in viewer.scenes.items():
            self._draw(name, one.scene)
        self._wanted.set()
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def page(self) -> str:
        """Return a standalone page with the current scenes; its time line flips between them.

        Returns:
            HTML that needs no server and fetches nothing.
        """
        names = [name for name in (FULL, SIMPLIFIED, *self._nodes) if name in self._nodes]
        html = record_page(self._server, [self._nodes[name] for name in dict.fromkeys(names)])
        self._show()
        return html

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def wait(self) -> None:
        """Serve until the process is interrupted or the server is closed."""
        while not self._closed:
            self._worker.join(timeout=_GIVE_UP)

    def finish(self) -> None:
        """Wait until the first simplified scene is shown, or is known to fail."""
        self._first.wait()

    def close(self) -> None:
        """Stop the server."""
        self._closed = True
        self._wanted.set()
        self._worker.join()
        stop_server(self._server)

    def _work(self) -> None:
        """Simplify for the latest position of the slider; skip positions in between."""
        while not self._closed:
            self._wanted.wait()
            self._wanted.clear()
            if not self._closed:
                self._try(self._simplify)
                is_first = not self._first.is_set()
                self._first.set()
                if is_first and not (self._wanted.is_set() or self._closed):
                    with suppress(CvtgsError):  # the next run reports it
                        self._viewer.warm_up(self._preset.value)

    def _simplify(self) -> str:
        rho = min(1.0, 10.0**self._slider.value)
        self._facts.content = f"simplifying to {rho:.4g} ..."
        small = self._viewer.simplify(self._preset.value, rho)
        self._draw(SIMPLIFIED, small.scene)
        self._show()
        return ""

    def _draw(self, name: str, scene: GaussianScene) -> None:
        if name not in self._nodes:
            path = f"/scene {len(self._nodes)}"
            self._nodes[name] = SceneNode(self._server, name, path, label=self._label)
        self._nodes[name].draw(scene, visible=self._shown.value == name)

    def _show(self) -> None:
        for name, node in self._nodes.items():
            node.show(name == self._shown.value)
        if self._shown.value in self._viewer.scenes:
            self._facts.content = self._viewer.scenes[self._shown.value].facts

    def _score(self, event: "viser.GuiEvent[Any]") -> None:
        camera = None if event.client is None else event.client.camera
        if camera is not None:
            cameras = camera_of(
                tuple(camera.wxyz), tuple(camera.position), fov=camera.fov, aspect=camera.aspect
            )
            name = self._shown.value
            self._try(lambda: f"{name}: {self._viewer.score(name, cameras):.2f} dB in this view")

    def _save(self) -> str:
        return self._viewer.save(self._shown.value, self._path.value.strip())

    def _try(self, action: Callable[[], str]) -> None:
        """Run an action, and show its result or its error on the page."""
        try:
            self._notes.content = printable(action())
        except CvtgsError as error:
            self._notes.content = f"**{printable(str(error))}**"
