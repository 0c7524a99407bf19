"""The scenes of a page, which are simplified repeatedly, scored and saved."""

import math
import os
from collections.abc import Mapping
from typing import NamedTuple

import torch

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError, OutputError, RunError
from cvtgs.evaluation.metrics import psnr
from cvtgs.io import save
from cvtgs.math.parameters import rotation_matrices
from cvtgs.prepared import Prepared
from cvtgs.progress import ProgressEvent
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.text import counted, shown, size_text
from cvtgs.validity import valid_part

FULL, SIMPLIFIED = "full scene", "simplified"

WARM_RATIO = 0.5  # largest ratio to prepare for: above 0.031, pairs of single Gaussians merge
SCORE_SIDE, LEAST_SIDE = 480, 16  # longer side of scored images, and least of the other, pixels


class ShownScene(NamedTuple):
    """A scene on the page, and a description.

    Attributes:
        scene: The scene.
        facts: The description, one line of text.
    """

    scene: GaussianScene
    facts: str


class SceneViewer:
    """Simplifies one scene repeatedly; work that does not depend on the size is done once.

    Args:
        scene: The full scene.
        others: Other scenes to show, by name.
        device: Device to compute on, as for :class:`cvtgs.Simplifier`.

    Raises:
        InvalidArgumentError: Another scene has a name that the viewer itself uses.

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
                f"scenes other than the full one must not be named {taken.pop()!r}; rename it."
            )
        self._scene, self._device, self._is_stopped = scene, device, False
        self._prepared: dict[str, Prepared] = {}
        self.scenes: dict[str, ShownScene] = {FULL: ShownScene(scene, _counted(scene, scene))}
        for name, other in (others or {}).items():
            self.scenes[name] = ShownScene(other, _counted(other, scene))

    def simplify(self, preset: str, rho: float) -> ShownScene:
        """Simplify the scene, and add the result to the scenes.

        Args:
            preset: Name of a preset.
            rho: Ratio of Gaussians to keep, in (0, 1].

        Returns:
            The simplified scene.

        Raises:
            InvalidArgumentError: The ratio is out of range.
            ConfigError: The preset does not exist.
            RunError: The viewer was stopped.
        """
        if preset not in self._prepared:
            simplifier = Simplifier(preset=preset, device=self._device, listener=self._go_on)
            self._prepared[preset] = simplifier.prepare(self._scene)
        small, report = self._prepared[preset].run(rho)
        facts = f"{_counted(small, self._scene)}, {report.seconds:.2f} s with {preset}"
        self.scenes[SIMPLIFIED] = ShownScene(small, facts)
        return self.scenes[SIMPLIFIED]

    def stop(self) -> None:
        """End a running simplification at its next stage or step, and later ones, with an error."""
        self._is_stopped = True

    def resume(self) -> None:
        """Allow simplifications again."""
        self._is_stopped = False

    def _go_on(self, event: ProgressEvent) -> None:
        """Raise if the viewer was stopped."""
        if self._is_stopped:
            raise RunError(f"the viewer was stopped during {event.stage}.")

    def warm_up(self, preset: str) -> None:
        """Compute the data that all sizes share, so that the first slider move is not slower.

        Args:
            preset: Name of a preset; no-op unless the scene was simplified with it.
        """
        if preset in self._prepared:
            self._prepared[preset].warm_up(WARM_RATIO)

    def score(self, name: str, cameras: Cameras) -> float:
        """Return the mean PSNR of a scene against the full scene, in dB.

        Args:
            name: Name of the scene.
            cameras: Cameras to render from.

        Returns:
            The mean over the cameras; infinite for the full scene itself.

        Raises:
            InvalidArgumentError: There is no such scene, or not yet, or no camera sees anything of
                the full one.
        """
        small, full = (render(valid_part(one), cameras) for one in (self._named(name), self._scene))
        if float(full.alpha.amax()) == 0.0:
            raise InvalidArgumentError("this view shows nothing of the full scene.")
        return float(psnr(small.rgb.clamp(0, 1), full.rgb.clamp(0, 1)).mean())

    def save(self, name: str, path: str | os.PathLike[str]) -> str:
        """Write a scene to a new file.

        Args:
            name: Name of the scene.
            path: The file; its suffix sets the format.

        Returns:
            A line with the path and the number of Gaussians.

        Raises:
            CvtgsError: The name is empty, there is no such scene, or :func:`cvtgs.save` fails.
        """
        if not os.fspath(path).strip():
            raise OutputError("a file name is needed to save a scene, found none.")
        scene = self._named(name)
        save(scene, path)
        return f"{os.fspath(path)}: {counted(len(scene), 'Gaussian')}."

    def _named(self, name: str) -> GaussianScene:
        if name not in self.scenes:
            raise InvalidArgumentError(f"the scene {name!r} does not exist, or not yet.")
        return self.scenes[name].scene


def _counted(scene: GaussianScene, full: GaussianScene) -> str:
    columns = 17 + 3 * scene.shN.shape[1]
    size = size_text(4 * columns * len(scene))
    return f"{len(scene):,} of {counted(len(full), 'Gaussian')}, about {size} as .ply"


def camera_of(
    wxyz: tuple[float, ...], position: tuple[float, ...], *, fov: float, aspect: float
) -> Cameras:
    """Return the camera that a visitor of the page looks through.

    Args:
        wxyz: Rotation from the camera (x right, y down, z forward) to the world.
        position: Position of the camera, scene units.
        fov: Vertical field of view, radians.
        aspect: Width divided by height.

    Raises:
        InvalidArgumentError: Nothing can be seen, as in a window without height.
    """
    numbers = (*wxyz, *position, fov, aspect)
    if not (all(map(math.isfinite, numbers)) and any(wxyz) and aspect > 0 and 0 < fov < math.pi):
        raise InvalidArgumentError(
            f"a view must have a size, a direction and a field of view, found aspect {aspect:g}, "
            f"rotation {shown(wxyz)} and {fov:g} radians."
        )
    quat = torch.tensor([wxyz], dtype=torch.float64, device="cpu")
    rotation = rotation_matrices(quat)[0]
    view = torch.eye(4, dtype=torch.float64, device="cpu")
    view[:3, :3] = rotation.T
    view[:3, 3] = -rotation.T @ torch.tensor(position, dtype=torch.float64, device="cpu")
    width, height = (max(LEAST_SIDE, round(SCORE_SIDE * min(1.0, x))) for x in (aspect, 1 / aspect))
    focal = height / 2 / math.tan(fov / 2)
    intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Cameras(
        viewmats=view[None],
        Ks=torch.tensor([intrinsics], dtype=torch.float64, device="cpu"),
        width=width,
        height=height,
    )
