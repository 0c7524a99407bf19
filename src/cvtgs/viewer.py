"""A page in the browser that shows a scene while its size is chosen, on viser.

No other file imports viser.
"""

import io
import math
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from cvtgs.cameras import Cameras
from cvtgs.config import PRESETS
from cvtgs.errors import CvtgsError, InvalidArgumentError, MissingDependencyError, OutputError
from cvtgs.evaluation.metrics import psnr
from cvtgs.io import save
from cvtgs.math.parameters import build_covariances, normalize_quats, rotation_matrices
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.prepared import Prepared
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.text import printable
from cvtgs.validity import valid_rows

if TYPE_CHECKING:
    import viser

__all__ = ["SceneViewer", "ShownScene", "ViewerServer", "check_viewer"]

FULL, SIMPLIFIED = "full scene", "simplified"

SLIDER = (-3.5, 0.0, 0.05)
"""Decimal logarithms of rho: least, largest, step."""

SCORE_SIDE = 480
"""Longer side of the images that a view is scored on, pixels."""

_FLIPS, _FLIP_SECONDS = 1, 2.0
"""How often a page of its own shows each scene, and for how long."""

_GIVE_UP = 0.5
"""Seconds between looks at whether the page was closed."""


class ShownScene(NamedTuple):
    """A scene on the page, and what is said of it.

    Attributes:
        scene: The scene.
        facts: A line of text.
    """

    scene: GaussianScene
    facts: str


class SceneViewer:
    """Simplifies one scene again and again; what does not depend on the size is done once.

    Args:
        scene: The full scene.
        others: Scenes to look at beside it, by name.
        device: Where to compute, as :class:`cvtgs.Simplifier` takes it.

    Raises:
        InvalidArgumentError: A name of another scene is one of the viewer's own.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> viewer = SceneViewer(make("object", 1000), device="cpu")
        >>> viewer.simplify("draft", 0.01).facts.startswith("10 of 1,000 ")
        True
    """

    def __init__(
        self,
        scene: GaussianScene,
        others: Mapping[str, GaussianScene] | None = None,
        *,
        device: str = "auto",
    ) -> None:
        taken = {FULL, SIMPLIFIED} & set(others or {})
        if taken:
            raise InvalidArgumentError(
                f"a scene beside the full one must not be named {taken.pop()!r}; rename it."
            )
        self._scene, self._device = scene, device
        self._prepared: dict[str, Prepared] = {}
        self.scenes = {FULL: ShownScene(scene, _counted(scene, scene))}
        for name, other in (others or {}).items():
            self.scenes[name] = ShownScene(other, _counted(other, scene))

    def simplify(self, preset: str, rho: float) -> ShownScene:
        """Simplify the scene, and keep the result among the scenes.

        Args:
            preset: Name of a preset.
            rho: Ratio of Gaussians to keep, in (0, 1].

        Returns:
            The small scene.

        Raises:
            InvalidArgumentError: The ratio is out of range.
            ConfigError: There is no such preset.
        """
        if preset not in self._prepared:
            simplifier = Simplifier(preset=preset, device=self._device)
            self._prepared[preset] = simplifier.prepare(self._scene)
        small, report = self._prepared[preset].run(rho)
        facts = f"{_counted(small, self._scene)}, {report.seconds:.2f} s with {preset}"
        self.scenes[SIMPLIFIED] = ShownScene(small, facts)
        return self.scenes[SIMPLIFIED]

    def score(self, name: str, cameras: Cameras) -> float:
        """Return the mean PSNR of a scene against the full one, dB.

        Args:
            name: Which scene.
            cameras: From where.

        Returns:
            The mean over the cameras; infinite for the full scene itself.
        """
        images = [
            render(one.select(valid_rows(one)), cameras).rgb.clamp(0, 1)
            for one in (self.scenes[name].scene, self._scene)
        ]
        return float(psnr(*images).mean())

    def save(self, name: str, path: str | os.PathLike[str]) -> str:
        """Write a scene to a new file.

        Args:
            name: Which scene.
            path: The file; its suffix chooses the format.

        Returns:
            A line that says what was written.

        Raises:
            CvtgsError: What :func:`cvtgs.save` raises.
        """
        if not os.fspath(path).strip():
            raise OutputError("a file name is needed to save a scene, found none.")
        save(self.scenes[name].scene, path)
        return f"{os.fspath(path)}: {len(self.scenes[name].scene):,} Gaussians."


def _counted(scene: GaussianScene, full: GaussianScene) -> str:
    columns = 17 + 3 * scene.shN.shape[1]
    size = 4e-6 * columns * len(scene)
    return f"{len(scene):,} of {len(full):,} Gaussians, {size:,.3g} MB as .ply"


class ViewerServer:
    """The page: a server of viser with the scenes, a slider of rho, presets, scores and saving.

    Colours are those of the constant SH band, since viser shows no others; scores take all bands.

    Args:
        viewer: The scenes.
        host: Address to listen on.
        port: Port to listen on; the next free one is taken.
        preset: Preset to start with.
        rho: Ratio to start with, in (0, 1].

    Raises:
        MissingDependencyError: viser is not installed.
        ConfigError: There is no such preset.
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
        module = _viser()
        self._viewer, self._wanted = viewer, threading.Event()
        self._closed, self._first = False, threading.Event()
        with redirect_stdout(io.StringIO()):  # viser prints, whatever verbose is
            self._server: viser.ViserServer = module.ViserServer(
                host=host, port=port, label="cvtgs", verbose=False
            )
        self._server.scene.set_up_direction("-y")
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
        keep = gui.add_button("save what is shown")
        self._notes = gui.add_markdown("")
        self._slider.on_update(lambda _: self._wanted.set())
        self._preset.on_update(lambda _: self._wanted.set())
        self._shown.on_update(lambda _: self._show())
        score.on_click(self._score)
        keep.on_click(lambda _: self._try(self._save))
        self._handles: dict[str, Any] = {}
        for name, one in viewer.scenes.items():
            self._draw(name, one.scene)
        self._wanted.set()
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def page(self) -> str:
        """Return a page of its own with what is shown now; its time line flips between scenes.

        Returns:
            HTML that needs no server and fetches nothing.
        """
        recorder = self._server.get_scene_serializer()
        names = [name for name in (FULL, SIMPLIFIED, *self._handles) if name in self._handles]
        for _ in range(_FLIPS):
            for name in dict.fromkeys(names):
                for other, handle in self._handles.items():
                    handle.visible = other == name
                recorder.insert_sleep(_FLIP_SECONDS)
        html: str = recorder.as_html(dark_mode=True)
        self._show()
        return html

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def wait(self) -> None:
        """Serve until the process is interrupted."""
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
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _work(self) -> None:
        """Simplify for the latest position of the slider; positions in between are skipped."""
        while not self._closed:
            self._wanted.wait()
            self._wanted.clear()
            if not self._closed:
                self._try(self._simplify)
                self._first.set()

    def _simplify(self) -> str:
        rho = min(1.0, 10.0**self._slider.value)
        self._facts.content = f"simplifying to {rho:.4g} ..."
        small = self._viewer.simplify(self._preset.value, rho)
        self._draw(SIMPLIFIED, small.scene)
        self._show()
        return ""

    def _draw(self, name: str, scene: GaussianScene) -> None:
        part = scene.select(valid_rows(scene)).to("cpu")
        covariances = build_covariances(part.scales, normalize_quats(part.quats))
        before = self._handles.get(name)
        self._handles[name] = self._server.scene.add_gaussian_splats(
            f"/scene {len(self._handles)}" if before is None else before.name,
            centers=part.means.float().numpy(),
            covariances=covariances.float().numpy(),
            rgbs=(0.5 + SH_C0 * part.sh0[:, 0]).clamp(0, 1).float().numpy(),
            opacities=part.opacities[:, None].float().numpy(),
            visible=self._shown.value == name,
        )

    def _show(self) -> None:
        for name, handle in self._handles.items():
            handle.visible = name == self._shown.value
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
        """Run something for the page; what goes wrong is said there."""
        try:
            self._notes.content = printable(action())
        except CvtgsError as error:
            self._notes.content = f"**{printable(str(error))}**"


def camera_of(
    wxyz: tuple[float, ...], position: tuple[float, ...], *, fov: float, aspect: float
) -> Cameras:
    """Return the camera of a view of the page.

    Args:
        wxyz: Rotation from the camera (x right, y down, z forward) to the world.
        position: Of the camera, scene units.
        fov: Vertical field of view, radians.
        aspect: Width by height.

    Returns:
        One camera of a small image.
    """
    quat = torch.tensor([wxyz], dtype=torch.float64)
    rotation = rotation_matrices(quat)[0]
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = rotation.T
    view[:3, 3] = -rotation.T @ torch.tensor(position, dtype=torch.float64)
    width = SCORE_SIDE if aspect >= 1 else max(16, round(SCORE_SIDE * aspect))
    height = max(16, round(width / aspect))
    focal = height / 2 / math.tan(fov / 2)
    intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Cameras(
        viewmats=view.float()[None],
        Ks=torch.tensor([intrinsics], dtype=torch.float32),
        width=width,
        height=height,
    )


def check_viewer() -> None:
    """Check that a page could be served, before scenes are read.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    _viser()


def _viser() -> Any:
    try:
        import viser  # noqa: PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            "the viewer needs the package viser; install it with: pip install 'cvtgs[view]'."
        ) from error
    return viser
