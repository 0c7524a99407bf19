"""Find views that show nothing of a scene, in which every result would look perfect."""

from collections.abc import Iterable, Sequence

from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import CameraWarning, InvalidArgumentError, InvalidSceneError, warn
from cvtgs.evaluation.scorer import render_views
from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.rendering import BackendName
from cvtgs.rendering.projection import to_matrices, warn_of_near_plane
from cvtgs.rendering.render import LEAST_COVER
from cvtgs.scene import GaussianScene
from cvtgs.views.own import FEW, LEAST_FILLED, MOST_TRIED, in_images

PREVIEW = 96  # longer side of images that only tell whether they show anything, pixels
SAMPLED = 4096  # about how many Gaussians tell whether a camera sees anything of a scene


def check_seen(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    name: str,
    backend: BackendName = "auto",
    parts: Iterable[GaussianScene] | None = None,
    refines: bool = False,
) -> None:
    """Raise if too few cameras see anything of a scene, or one is no pinhole camera.

    Warn if few see anything, or the near plane hides much. If parts are given, the scene is a
    sample of them, which cannot tell how many cameras see something; parts are read only as long
    as too few see the sample.
    """
    if len(scene) == 0:
        raise InvalidSceneError(f"{name} must have at least one Gaussian, found none.")
    to_matrices(cameras)  # alone, each would be "camera 0" in errors
    warn_of_near_plane(scene, cameras.singles(), name=name)
    inside, filled = in_images(cameras.spread(MOST_TRIED), scene)
    if len(scene) >= FEW and float(((inside > 0) & (filled < LEAST_FILLED)).double().mean()) > 0.5:
        warn(
            f"{name} spans less than {LEAST_FILLED:.0%} of most images, so they show mostly "
            f"background; give cameras of this scene, in its units.",
            CameraWarning,
        )
    enough = 2 if refines else 1
    if parts is None:
        empty = _count_blind(scene, cameras, enough=enough, backend=backend)
    else:
        empty = _count_blind_in_parts(scene, parts, cameras, enough=enough)
    if empty == len(cameras):
        raise InvalidArgumentError(
            f"the cameras must see {name}, found nothing of it in any of {len(cameras)} "
            f"views; give cameras of this scene, in its axes and units."
        )
    if refines and empty == len(cameras) - 1:
        raise InvalidArgumentError(
            f"a refinement needs at least 2 cameras that see {name}, one of them to be held out; "
            f"found 1 of {len(cameras)}."
        )
    if parts is None:
        _warn_of_blind(empty, len(cameras), name)


def _count_blind_in_parts(
    sample: GaussianScene, parts: Iterable[GaussianScene], cameras: Cameras, *, enough: int
) -> int:
    """Count cameras that see nothing of a sample, nor of parts, which are read while few see."""
    blind, most = _missing(_drawn(sample), cameras.singles()), len(cameras) - enough
    if len(blind) > most:
        blind = [camera for camera in blind if _is_empty(sample, camera)]
    rest = iter(parts)
    while len(blind) > most and (part := next(rest, None)) is not None:
        blind = _missing(_drawn(part), blind)
    return len(blind)


def _missing(points: Float[Tensor, "n 3"], cameras: Sequence[Cameras]) -> list[Cameras]:
    """Return the cameras with none of the points in their images."""
    exact = points.double()
    return [camera for camera in cameras if not camera.shows_any(exact)]


def warn_of_blind(scene: GaussianScene, cameras: Cameras, *, name: str) -> None:
    """Warn if most cameras see nothing of a scene."""
    _warn_of_blind(_count_blind(scene, cameras), len(cameras), name)


def _warn_of_blind(blind: int, count: int, name: str) -> None:
    if 2 * blind > count:
        warn(
            f"{blind} of {count} cameras see nothing of {name}; give cameras of this scene, in "
            f"its axes and units.",
            CameraWarning,
        )


def _count_blind(
    scene: GaussianScene, cameras: Cameras, *, enough: int = 1, backend: BackendName = "auto"
) -> int:
    """Count cameras that see nothing; 0 if at least half of them, and ``enough``, see a centre."""
    points = _drawn(scene)
    blind = cameras.to("cpu").singles()
    for some in (points[:: -(-len(points) // SAMPLED)].cpu(), points):  # all only in doubt
        blind = _missing(some, blind)
        seeing = len(cameras) - len(blind)
        if seeing >= max(len(blind), enough):
            return 0
    return sum(_is_empty(scene, camera, backend=backend) for camera in blind)


def _is_empty(scene: GaussianScene, camera: Cameras, *, backend: BackendName = "auto") -> bool:
    """Return whether an image shows nothing; Gaussians beside it may reach into it."""
    image = render_views(scene, camera.fitted(PREVIEW), backend=backend)
    return float(image.alpha.mean()) < LEAST_COVER


def shows(scene: GaussianScene, camera: Cameras, alpha: Float[Tensor, "1 h w"]) -> bool:
    """Return whether an image has alpha of a scene, or at least the centre of a drawn Gaussian."""
    return float(alpha.mean()) >= LEAST_COVER or camera.shows_any(_drawn(scene).double())


def seeing_rows(scene: GaussianScene, cameras: Cameras) -> Sequence[int]:
    """Return the rows of cameras with a drawn Gaussian in the image; all if fewer than two."""
    points = _drawn(scene).double()
    some = points[:: -(-len(points) // SAMPLED)].cpu()
    found = [
        row
        for row, camera in enumerate(cameras.singles())
        if camera.shows_any(some) or camera.shows_any(points)
    ]
    return found if len(found) > 1 else range(len(cameras))


def _drawn(scene: GaussianScene) -> Float[Tensor, "n 3"]:
    """Return the positions of the Gaussians that renderers draw; all, if they draw none."""
    is_drawn = scene.opacities >= MIN_ALPHA
    return scene.means[is_drawn] if bool(is_drawn.any()) else scene.means
