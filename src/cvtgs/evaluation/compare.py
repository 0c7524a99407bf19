"""Scores and images of simplified scenes next to the full one, and to photographs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.images import as_bytes
from cvtgs.evaluation.report import Evaluation, SceneScores
from cvtgs.evaluation.scorer import (
    EvaluationSettings,
    ImageScores,
    chosen_metrics,
    render_view,
    scene_scores,
)
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.scene import GaussianScene

STAGE = "evaluate"
"""The stage of the progress events; a step is an image."""

Images = UInt8[np.ndarray, "c h w 3"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """Images, scores and sizes of a full scene and of simplified ones.

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


def evaluate(
    reference: GaussianScene,
    small: Mapping[str, GaussianScene],
    cameras: Cameras,
    *,
    reference_name: str = "full",
    photographs: Float[Tensor, "c h w 3"] | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    listener: ProgressListener = silent,
) -> Evaluation:
    """Score simplified scenes by images.

    Every view of the full scene is rendered once, whatever the number of small ones. Memory:
    what :func:`cvtgs.rendering.render` needs, and two images.

    Args:
        reference: The full scene.
        small: Simplified scenes by name.
        cameras: From where to look.
        reference_name: Name of the full scene.
        photographs: ``(c, h, w, 3)`` one per camera, in [0, 1], to score all scenes against too.
        settings: Background, which LPIPS, and what renders.
        listener: Called after each image.

    Returns:
        The scores, per view and on average.

    Raises:
        InvalidArgumentError: There is no camera, two scenes share a name, or the photographs
            have another shape than the images.
        DeviceError: The backend does not work on a scene's device.
        MissingDependencyError: The backend's package or the chosen LPIPS is missing.

    Example:
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 500, sh_degree=0)
        >>> cameras = automatic_views(scene, 2, width=32, height=24)
        >>> settings = EvaluationSettings(lpips="off")
        >>> evaluate(scene, {"same": scene}, cameras, settings=settings).scenes[0].psnr.mean
        inf
    """
    scenes = _named_scenes(reference, small, reference_name)
    return _score_images(
        scenes, cameras, photographs=photographs, settings=settings, listener=listener
    )


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
    """Score simplified scenes by images, and keep the images.

    Memory: ``3 c h w`` bytes per scene, and what :func:`cvtgs.evaluation.evaluate` needs.

    Args:
        reference: The full scene.
        small: Simplified scenes by name.
        cameras: From where to look.
        reference_name: Name of the full scene.
        sizes: Bytes of the files, by name.
        settings: Background, which LPIPS, and what renders.
        listener: Called after each image.

    Returns:
        The images and the scores.

    Raises:
        InvalidArgumentError: There is no camera, or two scenes share a name.
        DeviceError: The backend does not work on a scene's device.
        MissingDependencyError: The backend's package or the chosen LPIPS is missing.

    Example:
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 500, sh_degree=0)
        >>> cameras = automatic_views(scene, 2, width=32, height=24)
        >>> compare(scene, {"same": scene}, cameras).full.shape
        (2, 24, 32, 3)
    """
    scenes = _named_scenes(reference, small, reference_name)
    shape = (len(cameras), cameras.height, cameras.width, 3)
    images = {name: np.zeros(shape, np.uint8) for name in scenes}
    evaluation = _score_images(scenes, cameras, images=images, settings=settings, listener=listener)
    full = images.pop(reference_name)
    return Comparison(evaluation=evaluation, full=full, small=images, sizes=dict(sizes or {}))


def _named_scenes(
    reference: GaussianScene, small: Mapping[str, GaussianScene], reference_name: str
) -> dict[str, GaussianScene]:
    if reference_name in small:
        raise InvalidArgumentError(
            f"the scenes must have different names; {reference_name!r} is that of the full scene."
        )
    return {reference_name: reference, **small}


@torch.no_grad()
def _score_images(
    scenes: Mapping[str, GaussianScene],
    cameras: Cameras,
    *,
    photographs: Float[Tensor, "c h w 3"] | None = None,
    images: Mapping[str, Images] | None = None,
    settings: EvaluationSettings,
    listener: ProgressListener,
) -> Evaluation:
    """Score all scenes against the first, view by view; fill ``images`` where they are given."""
    if len(cameras) == 0:
        raise InvalidArgumentError("an evaluation needs at least one camera, found none.")
    wanted = (len(cameras), cameras.height, cameras.width, 3)
    if photographs is not None and tuple(photographs.shape) != wanted:
        raise InvalidArgumentError(
            f"photographs must have shape {wanted}, found {tuple(photographs.shape)}."
        )
    metrics = chosen_metrics(settings.lpips, (cameras.width, cameras.height))
    (reference_name, reference), *_ = scenes.items()
    against_full: dict[str, list[ImageScores]] = {name: [] for name in scenes}
    against_photographs: dict[str, list[ImageScores]] = {name: [] for name in scenes}
    total, done, backend = len(cameras) * len(scenes), 0, ""
    listener(ProgressEvent(stage=STAGE, done=0, total=total))
    for view in range(len(cameras)):
        camera = cameras.select(torch.tensor([view]))
        truth = truth_alpha = reference.means.new_zeros(0)
        for name, scene in scenes.items():
            rendered = render_view(scene, camera, backend=settings.backend)
            backend = rendered.backend
            background = scene.means.new_tensor(settings.background)
            image = rendered.over(background).clamp(0, 1)
            if images is not None:
                images[name][view] = as_bytes(image[0])
            if name == reference_name:
                truth, truth_alpha = image, rendered.alpha
            else:
                alphas = (rendered.alpha, truth_alpha.to(rendered.alpha))
                against_full[name].append(metrics.compare(image, truth, alphas=alphas))
            if photographs is not None:
                found = metrics.compare(image, photographs[view : view + 1])
                against_photographs[name].append(found)
            done += 1
            listener(ProgressEvent(stage=STAGE, done=done, total=total))
    del against_full[reference_name]
    return Evaluation(
        reference=reference_name,
        reference_count=len(reference),
        views=cameras.view_names,
        width=cameras.width,
        height=cameras.height,
        backend=backend,
        lpips_network=metrics.lpips.network if metrics.lpips else None,
        lpips_note=metrics.note,
        scenes=tuple(
            scene_scores(name, len(scenes[name]), rows) for name, rows in against_full.items()
        ),
        photographs=tuple(
            scene_scores(name, len(scenes[name]), rows)
            for name, rows in against_photographs.items()
            if rows
        ),
    )
