"""Differentiable rendering of scenes, and the contribution of each Gaussian to the images."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras, checked_cameras
from cvtgs.clock import check_listener
from cvtgs.counts import whole_number
from cvtgs.devices import full_precision
from cvtgs.errors import InvalidArgumentError, memory_errors
from cvtgs.math import parameters
from cvtgs.progress import ProgressListener, silent
from cvtgs.rendering.backends import (
    BackendName,
    BlendingWeights,
    choose_backend,
    differentiable_once,
    without_invalid_colors,
)
from cvtgs.scene import GaussianScene, SceneLike, as_scene, check_scene
from cvtgs.text import counted, short_repr, shown

LEAST_COVER = 1e-4  # mean alpha from which on an image shows something


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendering:
    """Images of a scene.

    Attributes:
        rgb: ``(c, h, w, 3)`` red, green, blue over the background; at least 0 if that is, and
            above 1 where the scene's colours are.
        alpha: ``(c, h, w)`` share of the background that the Gaussians hide, 0 to 1.
        depth: ``(c, h, w)`` mean depth along the view axis, weighted by ``alpha * T``, scene
            units; 0 in empty pixels; None unless requested.
        backend: Name of the backend that rendered.
    """

    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    depth: Float[Tensor, "c h w"] | None
    backend: str

    def __repr__(self) -> str:
        """Return number, size, renderer and device of the images, not their values."""
        count, height, width = self.alpha.shape
        size = f"{counted(count, 'image')} of {width} x {height} pixels"
        return f"Rendering({size}, {self.backend}, {self.alpha.device})"


@full_precision()
def render(
    scene: SceneLike,
    cameras: Cameras,
    *,
    backend: BackendName = "auto",
    background: Float[Tensor, "3"] | Float[Tensor, "c 3"] | Sequence[float] | None = None,
    sh_degree: int | None = None,
    depth: bool = False,
    listener: ProgressListener = silent,
) -> Rendering:
    """Render a scene by the rules of 3DGS (Kerbl et al. 2023).

    EWA projection dilates Gaussians by 0.3 squared pixels. Alpha is at most 0.99 (0.999 by
    gsplat), alpha under 1/255 is skipped, and blending runs front to back until the transmittance
    would fall under 1e-4. Scenes tagged ``SplatRenderMode: mip`` get the opacity compensation of
    Mip-Splatting (Yu et al. 2024). 3DGS cuts Gaussians at three standard deviations, rounded up to
    tiles; here they end where alpha falls under 1/255, so images do not depend on tiles.

    Images are differentiable, once, with respect to means, quats, log scales, opacity logits, sh0,
    shN and the background; cameras are constants. Gaussians with a non-finite position, shape,
    opacity or colour contribute nothing. Autocast of torch has no effect.

    Memory: each backend's ``rasterize`` states its formula. Cameras are rendered one by one, by
    ``numba`` without gradients up to four at a time, by ``gsplat`` as many as have four million
    pixels together.

    Args:
        scene: The Gaussians, or a file or folder of them. Images get the scene's device and dtype.
        cameras: The cameras, any dtype and device.
        backend: ``torch``, ``numba`` (CPU), ``gsplat`` (CUDA) or ``auto``, the fastest of them
            that works on the scene's device.
        background: Background colour, as three numbers or a tensor, or a tensor with one for each
            camera; black if None.
        sh_degree: Highest SH degree to evaluate; that of the scene if None.
        depth: Whether to return depths too.
        listener: Called before the first camera and after each.

    Returns:
        The images.

    Raises:
        InvalidArgumentError: A camera is no pinhole camera, the background has another shape or
            is not finite, the scene has no such SH degree, there is no such backend, or the
            listener cannot be called.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.
        OutOfMemoryError: There is not enough memory for the images.

    Example:
        >>> from cvtgs.cameras import look_at
        >>> from cvtgs.synthetic import demo_scene
        >>> viewmats = look_at(
        ...     torch.tensor([[0.0, -2, -8]]), torch.zeros(1, 3), torch.tensor([0.0, -1, 0])
        ... )
        >>> Ks = torch.tensor([[[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]])
        >>> cameras = Cameras(viewmats=viewmats, Ks=Ks, width=64, height=48)
        >>> render(demo_scene(1000), cameras, backend="torch").rgb.shape
        torch.Size([1, 48, 64, 3])
    """
    scene = as_scene(scene)
    checked_cameras(cameras)
    check_listener(listener)
    degree = _degree(scene, sh_degree)
    behind = _background(scene, cameras, background)
    name, chosen = choose_backend(backend, scene.device)
    size = f"{len(cameras):,} x {cameras.width:,} x {cameras.height:,} pixels"
    with memory_errors(f"rendering {size}", "render fewer or smaller images"):
        once = differentiable_once(scene)
        output = chosen.rasterize(once, cameras, sh_degree=degree, listener=listener)
    if behind is None:
        rgb = output.rgb.contiguous()
    else:
        rgb = output.rgb + (1 - output.alpha)[..., None] * behind[:, None, None]
    depths = None
    if depth:
        divisor = torch.where(output.alpha > 0, output.alpha, 1)
        depths = parameters.divide(output.depth, divisor)
    return Rendering(rgb=rgb, alpha=output.alpha, depth=depths, backend=name)


@full_precision()
def contributions(
    scene: GaussianScene, cameras: Cameras, *, backend: BackendName = "auto"
) -> Float[Tensor, "n"]:
    """Sum each Gaussian's blending weights ``alpha * T`` over all pixels of some images.

    ``T`` is the transmittance in front of the Gaussian (Kerbl et al. 2023, equation 3). Colours do
    not matter. The contributions of all Gaussians add up to the summed alpha of the images.

    Memory: that of rendering up to four images with ``numba``, else of one with its gradient; with
    ``gsplat`` of as many as have four million pixels together.

    Args:
        scene: The Gaussians.
        cameras: The cameras.
        backend: The backend, as in :func:`cvtgs.rendering.render`.

    Returns:
        Contributions in pixels, float64; 0 for Gaussians that no image shows.

    Raises:
        InvalidArgumentError: A camera is no pinhole camera, or there is no such backend.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> seen = contributions(scene, automatic_views(scene, 2, width=32, height=32))
        >>> tuple(seen.shape), bool((seen >= 0).all()), bool(seen.sum() <= 2 * 32 * 32)
        ((500,), True, True)
    """
    check_scene(scene)
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    for found in contributions_to_each(scene, cameras, backend=backend):
        total += found
    return total


def contributions_to_each(
    scene: GaussianScene, cameras: Cameras, *, backend: BackendName = "auto"
) -> Iterator[Float[Tensor, "n"]]:
    """Yield what :func:`contributions` adds up: the contributions to every single image."""
    chosen = choose_backend(backend, scene.device)[1]
    return chosen.contributions(without_invalid_colors(scene), checked_cameras(cameras))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedViews:
    """Images of a scene, and the contribution of each Gaussian to them.

    Attributes:
        cameras: The cameras of the images.
        rgb: ``(c, h, w, 3)`` colours over black.
        alpha: ``(c, h, w)`` share of a background that the Gaussians hide, 0 to 1.
        contributions: ``(n,)`` summed weights ``alpha * T`` over all images, pixels, float64.
        backend: Name of the backend that rendered.
    """

    cameras: Cameras
    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    contributions: Float[Tensor, "n"]
    backend: str

    __repr__ = short_repr


def showing_rows(alpha: Float[Tensor, "c h w"]) -> Sequence[int]:
    """Return the rows of images that show something; all if none does.

    An image of nothing would look perfect from the start, so it must not decide on a result.
    """
    found: list[int] = (alpha.flatten(1).mean(dim=1) >= LEAST_COVER).nonzero()[:, 0].tolist()
    return found or range(len(alpha))


def check_observed(views: object, name: str) -> None:
    """Raise unless a value holds observed views."""
    if not isinstance(views, ObservedViews):
        raise InvalidArgumentError(
            f"{name} must be ObservedViews, as cvtgs.rendering.observe returns them; "
            f"found {type(views).__name__}."
        )


@torch.no_grad()
@full_precision()
def observe(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    backend: BackendName = "auto",
    on_image: Callable[[int], None] = lambda done: None,
) -> ObservedViews:
    """Render a scene and sum each Gaussian's contribution, in one pass where the backend can.

    Args:
        scene: The Gaussians.
        cameras: The cameras, at least one.
        backend: The backend, as in :func:`cvtgs.rendering.render`.
        on_image: Called with the number of finished images.

    Returns:
        The results of :func:`cvtgs.rendering.render` and :func:`cvtgs.rendering.contributions`,
        without gradients.

    Raises:
        InvalidArgumentError: There is no camera, one is no pinhole camera, or there is no such
            backend.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> views = observe(scene, automatic_views(scene, 2, width=32, height=32))
        >>> views.rgb.shape, bool((views.alpha.sum() - views.contributions.sum()).abs() < 1e-2)
        (torch.Size([2, 32, 32, 3]), True)
    """
    check_scene(scene)
    if len(checked_cameras(cameras)) == 0:
        raise InvalidArgumentError("cameras must hold at least one camera, found none.")
    name, chosen = choose_backend(backend, scene.device)
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    outputs = []
    drawn = without_invalid_colors(scene)
    for output, found in chosen.observe(drawn, cameras, sh_degree=scene.sh_degree):
        total += found
        outputs.append(output)
        on_image(len(outputs))
    return ObservedViews(
        cameras=cameras,
        rgb=torch.cat([output.rgb for output in outputs]),
        alpha=torch.cat([output.alpha for output in outputs]),
        contributions=total,
        backend=name,
    )


@full_precision()
def blending_weights(
    scene: GaussianScene, camera: Cameras, *, backend: BackendName = "auto"
) -> BlendingWeights:
    """Compute the weights ``alpha * T`` of every Gaussian in every pixel of one image.

    Memory: 5 bytes per pair of a Gaussian and a pixel that it reaches with ``numba``, else 40.

    Args:
        scene: The Gaussians.
        camera: A single camera.
        backend: The backend, as in :func:`cvtgs.rendering.render`; gsplat falls back to torch.

    Returns:
        The weights, as a matrix to multiply with.

    Raises:
        InvalidArgumentError: There is not one camera, it is no pinhole camera, or there is no such
            backend.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> weights = blending_weights(scene, automatic_views(scene, 1, width=32, height=32))
        >>> weights.paint(torch.ones(500, 3)).shape
        torch.Size([32, 32, 3])
    """
    check_scene(scene)
    if len(checked_cameras(camera)) != 1:
        raise InvalidArgumentError(f"camera must be a single camera, found {len(camera)}.")
    chosen = choose_backend(backend, scene.device)[1]
    return chosen.blending_weights(without_invalid_colors(scene), camera)


def _degree(scene: GaussianScene, sh_degree: int | None) -> int:
    if sh_degree is None:
        return scene.sh_degree
    degree = whole_number(sh_degree)
    if not 0 <= degree <= scene.sh_degree:
        raise InvalidArgumentError(
            f"sh_degree must be from 0 to {scene.sh_degree}, the degree of the scene, "
            f"found {sh_degree!r}."
        )
    return degree


def _background(
    scene: GaussianScene, cameras: Cameras, background: Tensor | Sequence[float] | None
) -> Float[Tensor, "c_or_1 3"] | None:
    if background is None:
        return None
    device = background.device if isinstance(background, Tensor) else "cpu"
    try:
        colors = torch.as_tensor(background, dtype=scene.dtype, device=device)
        found = f"shape {tuple(colors.shape)}"
    except (TypeError, ValueError, OverflowError):
        colors, found = None, shown(background)
    if colors is None or colors.shape not in ((3,), (len(cameras), 3)):
        raise InvalidArgumentError(
            f"background must be three numbers, or a tensor of shape (3,) or ({len(cameras)}, 3), "
            f"found {found}."
        )
    if colors.device.type == "cpu" and not bool(colors.isfinite().all()):
        raise InvalidArgumentError("background must be finite, found NaN or infinite numbers.")
    return colors.to(scene.device).reshape(-1, 3)
