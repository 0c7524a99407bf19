"""Scores and images of simplified scenes against the full scene and against photographs."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from cvtgs.cameras import Cameras, checked_cameras
from cvtgs.checks import check_kinds
from cvtgs.clock import check_listener
from cvtgs.counts import checked_whole, spread_rows
from cvtgs.errors import InvalidArgumentError, warn
from cvtgs.evaluation.blind_views import check_seen, shows
from cvtgs.evaluation.images import Photographs, as_bytes
from cvtgs.evaluation.scorer import (
    Evaluation,
    EvaluationSettings,
    ImageScores,
    Metrics,
    SceneScores,
    chosen_metrics,
    render_views,
    scene_scores,
)
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.rendering import choose_backend
from cvtgs.scene import GaussianScene, SceneLike, as_scene
from cvtgs.text import printable_name, short_repr, shown
from cvtgs.validity import valid_rows
from cvtgs.views import automatic_views, find_own_cameras

STAGE = "evaluate"  # stage name in progress events; one step per image
OWN_CAMERAS, OWN_SIZE = 8, 640  # number and longer side of images from cameras beside a scene
ROUNDING = 1e-3  # values of photographs may be outside [0, 1] by this much, as in half precision

Images = UInt8[np.ndarray, "c h w 3"]
Alphas = UInt8[np.ndarray, "c h w"]


class SceneImages(NamedTuple):
    """Images of one scene, 8 bits per channel.

    Attributes:
        colors: ``(c, h, w, 3)`` colours over the background.
        alphas: ``(c, h, w)`` accumulated alpha: the share of each pixel that the scene covers.
    """

    colors: Images
    alphas: Alphas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """Images, scores and sizes of a full scene and of simplified ones.

    Attributes:
        evaluation: The scores, over all views.
        shown: Indices of the ``c`` views whose images are kept.
        full: Images of the full scene.
        small: Images of each simplified scene, by name.
        sizes: File sizes in bytes by name of the scene, the full one included; may be incomplete.
    """

    evaluation: Evaluation
    shown: tuple[int, ...]
    full: SceneImages
    small: Mapping[str, SceneImages]
    sizes: Mapping[str, int]

    __repr__ = short_repr

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views whose images are kept."""
        return tuple(self.evaluation.views[view] for view in self.shown)

    def ratio(self, scores: SceneScores) -> float:
        """Return the factor by which a simplified scene has fewer Gaussians, for example 100."""
        return self.evaluation.reference_count / max(1, scores.count)


def evaluate(
    reference: SceneLike,
    small: Mapping[str, SceneLike],
    cameras: Cameras | None = None,
    *,
    reference_name: str = "full",
    photographs: Float[Tensor, "c h w 3"] | Photographs | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    listener: ProgressListener = silent,
) -> Evaluation:
    """Score the images of simplified scenes.

    Each view of the full scene is rendered once for all simplified scenes. Views that show nothing
    of it do not count in mean scores against it, and a warning tells their number. Memory: that of
    :func:`cvtgs.rendering.render`, and two images.

    Args:
        reference: The full scene, or a file or folder of one.
        small: Simplified scenes, or files of them, by name.
        cameras: The cameras; None takes 8 of those beside the file of the full scene, in images of
            640 pixels, or else automatic views (:func:`cvtgs.views.automatic_views`).
        reference_name: Name of the full scene.
        photographs: ``(c, h, w, 3)`` one per camera, in [0, 1], to score all scenes against too;
            :class:`Photographs` of these cameras are read one by one.
        settings: Background, LPIPS network and backend.
        listener: Called before the first image and after each.

    Raises:
        InvalidArgumentError: There is no camera, none sees anything of the full scene, or images
            have fewer than 11 x 11 pixels; two scenes share a name, or the photographs do not have
            the shape of the images or are no floats in [0, 1].
        InvalidSceneError: The full scene has no Gaussian.
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
    cameras = _chosen_cameras(cameras, reference, scenes[reference_name], photographs)
    return _score_images(
        scenes, cameras, photographs=photographs, settings=settings, listener=listener
    )


def compare(  # noqa: PLR0913 (options by name)
    reference: SceneLike,
    small: Mapping[str, SceneLike],
    cameras: Cameras | None = None,
    *,
    reference_name: str = "full",
    sizes: Mapping[str, int] | None = None,
    most_images: int | None = None,
    photographs: Float[Tensor, "c h w 3"] | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    listener: ProgressListener = silent,
) -> Comparison:
    """Score the images of simplified scenes, and keep the images.

    Memory: ``4 c h w`` bytes per scene, and that of :func:`cvtgs.evaluation.evaluate`.

    Args:
        reference: The full scene, or a file or folder of one.
        small: Simplified scenes, or files of them, by name.
        cameras: The cameras; None chooses as for :func:`evaluate`.
        reference_name: Name of the full scene.
        sizes: File sizes in bytes, by name.
        most_images: Keep the images of at most this many views, spread over their order; scores
            always use all views. None keeps all.
        photographs: ``(c, h, w, 3)`` one per camera, in [0, 1], to score all scenes against too.
        settings: Background, LPIPS network and backend.
        listener: Called before the first image and after each.

    Raises:
        InvalidArgumentError: As for :func:`evaluate`, ``most_images`` is below 1, or ``sizes``
            names another scene.
        DeviceError: The backend does not work on a scene's device.
        MissingDependencyError: The backend's package or the chosen LPIPS is missing.

    Example:
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 500, sh_degree=0)
        >>> cameras = automatic_views(scene, 2, width=32, height=24)
        >>> compare(scene, {"same": scene}, cameras).full.colors.shape
        (2, 24, 32, 3)
    """
    if most_images is not None:
        most_images = checked_whole(most_images, "most_images")
    scenes = _named_scenes(reference, small, reference_name)
    for name in sizes or {}:
        if name not in scenes:
            raise InvalidArgumentError(
                f"sizes must be those of {', '.join(scenes)}; found one of {shown(name)}."
            )
    cameras = _chosen_cameras(cameras, reference, scenes[reference_name], photographs)
    views = spread_rows(len(cameras), most_images or len(cameras))
    shape = (len(views), cameras.height, cameras.width)
    images = {
        name: SceneImages(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8))
        for name in scenes
    }
    places = {view: place for place, view in enumerate(views)}

    def keep(name: str, view: int, color: Tensor, alpha: Tensor) -> None:
        if view in places:
            images[name].colors[places[view]] = as_bytes(color[0])
            images[name].alphas[places[view]] = as_bytes(alpha[0])

    evaluation = _score_images(
        scenes,
        cameras,
        photographs=photographs,
        keep=keep,
        settings=settings,
        listener=listener,
    )
    full = images.pop(reference_name)
    return Comparison(
        evaluation=evaluation, shown=views, full=full, small=images, sizes=dict(sizes or {})
    )


def _named_scenes(
    reference: SceneLike, small: Mapping[str, SceneLike], reference_name: str
) -> dict[str, GaussianScene]:
    if not isinstance(small, Mapping):
        raise InvalidArgumentError(
            f'small must be a dictionary of scenes by name, such as {{"small": scene}}, found '
            f"{type(small).__name__}."
        )
    for name in (reference_name, *small):
        if not isinstance(name, str):
            raise InvalidArgumentError(f"names of scenes must be texts, found {shown(name)}.")
        if any("\ud800" <= letter <= "\udfff" for letter in name):  # of a file name in other bytes
            raise InvalidArgumentError(
                f"names of scenes must be texts that files can hold (UTF-8), found {shown(name)}."
            )
    if reference_name in small:
        raise InvalidArgumentError(
            f"the scenes must have different names; {reference_name!r} is the name of the full "
            f"scene."
        )
    read = {name: as_scene(one, f"scene {name!r}") for name, one in small.items()}
    return {reference_name: as_scene(reference, "reference"), **read}


def _chosen_cameras(
    cameras: Cameras | None, source: SceneLike, scene: GaussianScene, photographs: object
) -> Cameras:
    """Return given cameras, those beside the file of the scene, or automatic ones."""
    if cameras is not None:
        return checked_cameras(cameras)
    if photographs is not None:
        raise InvalidArgumentError("photographs need the cameras that took them; found none.")
    own = None if isinstance(source, GaussianScene) else find_own_cameras(scene, source)
    if own is not None:
        return own.cameras.spread(OWN_CAMERAS).fitted(OWN_SIZE)
    return automatic_views(scene)


@torch.no_grad()
def check_scores(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    photographs: Float[Tensor, "c h w 3"] | None = None,
    settings: EvaluationSettings,
    name: str,
) -> None:
    """Raise, before long work, what :func:`evaluate` would raise after it."""
    metrics = _checked_metrics(scene, cameras, photographs, settings, name=name)
    image = render_views(scene[:1], next(iter(cameras.singles())), backend=settings.backend)
    color = image.over(scene.means.new_tensor(settings.background)).clamp(0, 1)
    metrics.compare(color, color)


def _checked_metrics(
    reference: GaussianScene,
    cameras: Cameras,
    photographs: Float[Tensor, "c h w 3"] | Photographs | None,
    settings: EvaluationSettings,
    *,
    name: str,
) -> Metrics:
    """Check the arguments of an evaluation, and return its metrics."""
    if len(checked_cameras(cameras)) == 0:
        raise InvalidArgumentError("an evaluation needs at least one camera, found none.")
    check_kinds({"settings": EvaluationSettings}, {"settings": settings})
    if photographs is not None and not isinstance(photographs, Photographs):
        shape = f"{len(cameras)} {cameras.height} {cameras.width} 3"
        check_kinds({"photographs": Float[Tensor, shape]}, {"photographs": photographs})
        low, high = (float(end) for end in photographs.aminmax())
        if not -ROUNDING <= low <= high <= 1 + ROUNDING:
            raise InvalidArgumentError(
                f"photographs must be in [0, 1], found values from {low:g} to {high:g}."
            )
    metrics = chosen_metrics(settings.lpips, (cameras.width, cameras.height))
    check_seen(reference, cameras, name=name, backend=settings.backend)
    return metrics


@torch.no_grad()
def _score_images(
    scenes: Mapping[str, GaussianScene],
    cameras: Cameras,
    *,
    photographs: Float[Tensor, "c h w 3"] | Photographs | None,
    keep: Callable[[str, int, Tensor, Tensor], None] = lambda name, view, color, alpha: None,
    settings: EvaluationSettings,
    listener: ProgressListener,
) -> Evaluation:
    """Score all scenes against the first, view by view; pass every image to ``keep``."""
    check_listener(listener)
    (reference_name, reference), *_ = scenes.items()
    for name, scene in scenes.items():
        if invalid := len(scene) - int(valid_rows(scene).sum()):
            warn(
                f"{name} has {invalid:,} Gaussians with NaN, infinite or zero values, of "
                f"{len(scene):,}; they are not drawn."
            )
    metrics = _checked_metrics(reference, cameras, photographs, settings, name=reference_name)
    against_full = defaultdict[str, list[ImageScores]](list)
    against_photographs = defaultdict[str, list[ImageScores]](list)
    blind: list[int] = []
    total, done = len(cameras) * len(scenes), 0
    listener(ProgressEvent(stage=STAGE, done=0, total=total))
    parts = photographs.split(1) if isinstance(photographs, Tensor) else photographs or ()
    for view, (camera, photograph) in enumerate(zip_longest(cameras.singles(), parts)):
        truth: tuple[Tensor, Tensor] | None = None
        for name, scene in scenes.items():
            image = render_views(scene, camera, backend=settings.backend)
            color = image.over(scene.means.new_tensor(settings.background)).clamp(0, 1)
            keep(name, view, color, image.alpha)
            if truth is None:
                truth = color, image.alpha
                if not shows(scene, camera, image.alpha):
                    blind.append(view)
            else:
                alphas = image.alpha, truth[1].to(image.alpha)
                against_full[name].append(metrics.compare(color, truth[0], alphas=alphas))
            if photograph is not None:
                found = metrics.compare(color, photograph)
                against_photographs[name].append(found)
            done += 1
            listener(ProgressEvent(stage=STAGE, done=done, total=total))
    if blind:
        warn(
            f"{len(blind)} of {len(cameras)} views show nothing of {reference_name}, so they do "
            f"not count in mean scores."
        )
    return Evaluation(
        reference=reference_name,
        reference_count=len(reference),
        views=tuple(map(printable_name, cameras.view_names)),  # JSON is UTF-8
        blind=tuple(blind),
        width=cameras.width,
        height=cameras.height,
        backend=choose_backend(settings.backend, reference.device)[0],
        lpips_network=metrics.lpips.network if metrics.lpips else None,
        lpips_note=metrics.note,
        scenes=tuple(
            scene_scores(name, len(scenes[name]), rows, blind=blind)
            for name, rows in against_full.items()
        ),
        photographs=tuple(
            scene_scores(name, len(scenes[name]), rows)
            for name, rows in against_photographs.items()
        ),
    )
