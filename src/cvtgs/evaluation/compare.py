"""Images of a full scene and of simplified ones, side by side, with their scores."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.evaluation.evaluate import evaluate
from cvtgs.evaluation.scores import Evaluation, SceneScores
from cvtgs.evaluation.settings import EvaluationSettings
from cvtgs.progress import ProgressListener, silent
from cvtgs.scene import GaussianScene

Images = UInt8[np.ndarray, "c h w 3"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """What people look at: images, scores and sizes.

    Attributes:
        evaluation: The scores.
        full: ``(c, h, w, 3)`` images of the full scene, 8 bits.
        small: The same of each simplified scene, by name.
        sizes: Bytes of the files by name of the scene, the full one included; may lack some.
    """

    evaluation: Evaluation
    full: Images
    small: Mapping[str, Images]
    sizes: Mapping[str, int]

    def ratio(self, scores: SceneScores) -> float:
        """Return how many times fewer Gaussians a simplified scene has.

        Args:
            scores: Those of the simplified scene.

        Returns:
            For example 100.
        """
        return self.evaluation.reference_count / max(1, scores.count)


def compare(
    reference: GaussianScene,
    small: Mapping[str, GaussianScene],
    cameras: Cameras,
    *,
    reference_name: str = "full",
    sizes: Mapping[str, int] | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    listener: ProgressListener = silent,
) -> Comparison:
    """Take images of a full scene and of simplified ones, and score them.

    Memory: ``3 c h w`` bytes per scene, and what :func:`cvtgs.evaluation.evaluate` needs.

    Args:
        reference: The full scene.
        small: Simplified scenes by name.
        cameras: From where to look.
        reference_name: Name of the full scene.
        sizes: Bytes of the files, by name.
        settings: Background, which LPIPS, and what renders.
        listener: Told about each image.

    Returns:
        The images and the scores.

    Raises:
        InvalidArgumentError: There is no camera, or two scenes share a name.
        DeviceError: The backend does not work on a scene's device.
        MissingDependencyError: The backend's package or the LPIPS asked for is missing.

    Example:
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 500, sh_degree=0)
        >>> cameras = automatic_views(scene, 2, width=32, height=24)
        >>> compare(scene, {"same": scene}, cameras).full.shape
        (2, 24, 32, 3)
    """
    shape = (len(cameras), cameras.height, cameras.width, 3)
    images = {name: np.zeros(shape, np.uint8) for name in (reference_name, *small)}

    def keep(view: int, name: str, image: Float[Tensor, "h w 3"]) -> None:
        images[name][view] = as_bytes(image)

    evaluation = evaluate(
        reference,
        small,
        cameras,
        reference_name=reference_name,
        settings=settings,
        listener=listener,
        on_image=keep,
    )
    full = images.pop(reference_name)
    return Comparison(evaluation=evaluation, full=full, small=images, sizes=dict(sizes or {}))


def as_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Round colours to 8 bits."""
    rounded = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    array: UInt8[np.ndarray, "h w 3"] = rounded.cpu().numpy()
    return array
