"""Scores of simplified scenes against the full one, and against photographs."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.judge import Tally, make_judge
from cvtgs.evaluation.scores import Evaluation
from cvtgs.evaluation.settings import EvaluationSettings
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene

STAGE = "evaluate"
"""The stage of the progress events; a step is an image."""

ImageListener = Callable[[int, str, Tensor], None]
"""Told the number of the view, the name of the scene and its image, ``(h, w, 3)``, clipped."""


def ignore_image(view: int, name: str, image: Float[Tensor, "h w 3"]) -> None:
    """Ignore an image; the default listener."""


@torch.no_grad()
def evaluate(
    reference: GaussianScene,
    small: Mapping[str, GaussianScene],
    cameras: Cameras,
    *,
    reference_name: str = "full",
    photographs: Float[Tensor, "c h w 3"] | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    listener: ProgressListener = silent,
    on_image: ImageListener = ignore_image,
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
        listener: Told about each image.
        on_image: Given each image; those of the reference come first in each view.

    Returns:
        The scores, per view and on average.

    Raises:
        InvalidArgumentError: There is no camera, two scenes share a name, or the photographs
            have another shape than the images.
        DeviceError: The backend does not work on a scene's device.
        MissingDependencyError: The backend's package or the LPIPS asked for is missing.

    Example:
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 500, sh_degree=0)
        >>> cameras = automatic_views(scene, 2, width=32, height=24)
        >>> settings = EvaluationSettings(lpips="off")
        >>> evaluate(scene, {"same": scene}, cameras, settings=settings).scenes[0].psnr.mean
        inf
    """
    _check(small, cameras, reference_name, photographs=photographs)
    judge = make_judge(settings.lpips, (cameras.width, cameras.height))
    scenes = {reference_name: reference, **small}
    tallies = {name: Tally(name=name, count=len(scene)) for name, scene in small.items()}
    taken = {name: Tally(name=name, count=len(scene)) for name, scene in scenes.items()}
    total, done = len(cameras) * len(scenes), 0
    backend_used = ""
    listener(ProgressEvent(stage=STAGE, done=0, total=total))
    for view in range(len(cameras)):
        camera = cameras.select(torch.tensor([view]))
        truth = reference.means.new_zeros(0)
        for name, scene in scenes.items():
            image, backend_used = _image(scene, camera, settings)
            on_image(view, name, image)
            if name == reference_name:
                truth = image
            else:
                tallies[name].rows.append(judge.compare(image, truth))
            if photographs is not None:
                taken[name].rows.append(judge.compare(image, photographs[view]))
            done += 1
            listener(ProgressEvent(stage=STAGE, done=done, total=total))
    return Evaluation(
        reference=reference_name,
        reference_count=len(reference),
        views=cameras.view_names,
        width=cameras.width,
        height=cameras.height,
        backend=backend_used,
        lpips_network=judge.weights.network if judge.weights else None,
        lpips_note=judge.note,
        scenes=tuple(tally.scores() for tally in tallies.values()),
        photographs=()
        if photographs is None
        else tuple(tally.scores() for tally in taken.values()),
    )


def _image(
    scene: GaussianScene, camera: Cameras, settings: EvaluationSettings
) -> tuple[Float[Tensor, "h w 3"], str]:
    behind = torch.tensor(settings.background) if any(settings.background) else None
    rendering = render(scene, camera, backend=settings.backend, background=behind)
    return rendering.rgb[0].clamp(0, 1), rendering.backend


def _check(
    small: Mapping[str, GaussianScene],
    cameras: Cameras,
    reference_name: str,
    *,
    photographs: Tensor | None,
) -> None:
    if len(cameras) == 0:
        raise InvalidArgumentError("an evaluation needs at least one camera, found none.")
    if reference_name in small:
        raise InvalidArgumentError(
            f"the scenes must have different names; {reference_name!r} is that of the full scene."
        )
    wanted = (len(cameras), cameras.height, cameras.width, 3)
    if photographs is not None and tuple(photographs.shape) != wanted:
        raise InvalidArgumentError(
            f"photographs must have shape {wanted}, found {tuple(photographs.shape)}."
        )
