"""The interface and output types that all backends share, and the choice of one by name."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, Protocol, cast, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.checks import check_kinds
from cvtgs.errors import DeviceError, InvalidArgumentError, MissingDependencyError
from cvtgs.math import segments
from cvtgs.progress import ProgressEvent, ProgressListener
from cvtgs.scene import GaussianScene

BackendName = Literal["auto", "torch", "numba", "gsplat"]
"""The names that :func:`choose_backend` accepts."""

STAGE = "render"  # stage name in progress events; one step per camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RasterOutput:
    """Images on black, before any background is added."""

    rgb: Float[Tensor, "c h w 3"]  # sums of the colours, weighted by alpha * T
    alpha: Float[Tensor, "c h w"]  # sums of the weights, 0 to 1
    depth: Float[Tensor, "c h w"]  # sums of the depths, weighted by alpha * T, scene units


class BlendingWeights(Protocol):
    """The weights ``alpha * T`` of every Gaussian in every pixel of one image.

    The image is linear in the colours; the methods multiply by the matrix of these weights.
    """

    def paint(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        """Return the image on black for these colours of the Gaussians."""

    def collect(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Return, for every Gaussian, the sum of the pixels times its weights."""

    def normal(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return ``collect(paint(colors))``."""
        return self.collect(self.paint(colors))

    def powers(self) -> Float[Tensor, "n 2"]:
        """Return, for every Gaussian, the sum of its weights and of their squares."""


class Backend(Protocol):
    """The functions that every backend module defines."""

    def require(self, device: torch.device) -> None:
        """Raise DeviceError or MissingDependencyError unless the backend works on the device."""

    def rasterize(
        self, scene: GaussianScene, cameras: Cameras, *, sh_degree: int, listener: ProgressListener
    ) -> RasterOutput:
        """Render images on black, on the device of the scene; cameras may be on any."""

    def contributions(self, scene: GaussianScene, cameras: Cameras) -> Iterator[Tensor]:
        """Yield the sum of each Gaussian's weights ``alpha * T`` over every image."""

    def observe(
        self, scene: GaussianScene, cameras: Cameras, *, sh_degree: int
    ) -> Iterator[tuple[RasterOutput, Tensor]]:
        """Yield every image on black, and the contributions to it."""

    def blending_weights(self, scene: GaussianScene, camera: Cameras) -> BlendingWeights:
        """Return the weights of every Gaussian in the pixels of one image."""


def choose_backend(name: BackendName, device: torch.device) -> tuple[str, Backend]:
    """Resolve the name of a backend for a device.

    Args:
        name: ``torch``, ``numba`` (CPU), ``gsplat`` (CUDA), or ``auto``: gsplat on CUDA if it
            works there, numba on the CPU if it is installed, else torch.
        device: Device of the scene.

    Returns:
        The resolved name and the backend.

    Raises:
        InvalidArgumentError: There is no backend of that name.
        MissingDependencyError: The backend's package is missing or does not work.
        DeviceError: The backend cannot work on that device.

    Example:
        >>> choose_backend("torch", torch.device("cpu"))[0]
        'torch'
    """
    if name not in get_args(BackendName):
        names = ", ".join(get_args(BackendName))
        raise InvalidArgumentError(f"backend must be one of {names}, found {name!r}.")
    if name != "auto":
        return name, _backend(name, device)
    for fast in ("gsplat", "numba"):
        try:
            return fast, _backend(fast, device)
        except (DeviceError, MissingDependencyError):
            continue
    return "torch", _backend("torch", device)


def _backend(name: str, device: torch.device) -> Backend:
    backend = cast("Backend", import_module(f"cvtgs.rendering.{name}_backend"))
    backend.require(device)
    return backend


def differentiable_once(scene: GaussianScene) -> GaussianScene:
    """Return the scene; second derivatives, which backends lack, raise instead of being 0."""
    if not torch.is_grad_enabled():
        return scene
    leaves = {name: tensor for name, tensor in scene.tensors().items() if tensor.requires_grad}
    guarded = {name: _Once.apply(tensor) for name, tensor in leaves.items()}  # type: ignore[no-untyped-call]
    return scene.with_tensors(guarded, {}) if guarded else scene


class _Once(torch.autograd.Function):
    """The identity; its gradient is followed by :class:`_Twice` if a graph is made of it."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:
        ctx.save_for_backward(tensor)
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return grad
        found: Tensor = _Twice.apply(grad, *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        return found


class _Twice(torch.autograd.Function):
    """Its first argument, which cannot be differentiated by any."""

    @staticmethod
    def forward(_: Any, grad: Tensor, tensor: Tensor) -> Tensor:
        del tensor
        return grad.view_as(grad)

    @staticmethod
    def backward(_: Any, *grads: Tensor) -> None:
        raise InvalidArgumentError(
            "images of render have first derivatives only, found a derivative of a gradient."
        )


def collect_images(
    images: Generator[Float[Tensor, "h w 5"], None, None],
    scene: GaussianScene,
    cameras: Cameras,
    *,
    listener: ProgressListener,
) -> RasterOutput:
    """Collect the images of all cameras, which hold colours, depth and transmittance."""
    listener(ProgressEvent(stage=STAGE, done=0, total=len(cameras)))
    found = [scene.means.new_zeros(0, cameras.height, cameras.width, 5)]
    with closing(images):  # an error in `listener` ends their threads
        for number, image in enumerate(images, start=1):
            found.append(image[None])
            listener(ProgressEvent(stage=STAGE, done=number, total=len(cameras)))
    layers = torch.cat(found)
    return RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=1 - layers[..., 4])


def check_colors(colors: Tensor, count: int) -> None:
    """Raise unless there is a colour for each Gaussian; kernels would read beyond the array."""
    check_kinds({"colors": Float[Tensor, f"{count} 3"]}, {"colors": colors})


def check_image(image: Tensor, size: tuple[int, int]) -> None:
    """Raise unless an image has a width and height."""
    check_kinds({"image": Float[Tensor, f"{size[1]} {size[0]} 3"]}, {"image": image})


def without_invalid_colors(scene: GaussianScene) -> GaussianScene:
    """Let Gaussians with view-dependent colours that are not finite draw nothing, in any degree."""
    if scene.sh_degree == 0:
        return scene
    valid = scene.shN.isfinite().flatten(1).all(dim=1)
    if scene.device.type == "cpu" and bool(valid.all()):
        return scene  # elsewhere, the host would wait to learn this
    return scene.with_tensors(logit_opacities=scene.logit_opacities.where(valid, torch.nan))


def without_gradients(scene: GaussianScene) -> GaussianScene:
    """Return a scene of constants that autograd takes, also in inference mode."""
    with torch.inference_mode(mode=False):
        tensors = {
            name: tensor.clone() if tensor.is_inference() else tensor.detach()
            for name, tensor in scene.tensors().items()
        }
        return scene.with_tensors(tensors, {})


def observe_in_two_passes(
    rasterize: Callable[..., RasterOutput],
    contributions: Callable[[GaussianScene, Cameras], Iterator[Tensor]],
    scene: GaussianScene,
    cameras: Cameras,
    sh_degree: int,
) -> Iterator[tuple[RasterOutput, Float[Tensor, "n"]]]:
    """Render images, and each once more for the contributions to it."""
    for camera, sums in zip(cameras.singles(), contributions(scene, cameras), strict=True):
        yield rasterize(scene, camera, sh_degree=sh_degree), sums


class PixelWeights(BlendingWeights):
    """The weights of one image; 24 bytes per pair of splat and pixel, twice that in products."""

    def __init__(
        self,
        pixels: Int[Tensor, "k"],
        rows: Int[Tensor, "k"],
        weights: Float[Tensor, "k"],
        *,
        size: tuple[int, int],
        count: int,
    ) -> None:
        self._size, self._count = size, count
        by_pixel, self._pixel_starts = segments.sort_by_label(pixels, size[0] * size[1])
        self._row_of, self._weight_of = rows[by_pixel], weights[by_pixel]
        by_row, self._row_starts = segments.sort_by_label(rows, count)
        self._pixels, self._weights = pixels[by_row], weights[by_row]

    def paint(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        """Return the image for these colours of the Gaussians."""
        check_colors(colors, self._count)
        colors = colors.to(self._weights.dtype)
        image = segments.segment_sum_of(colors, self._row_of, self._pixel_starts, self._weight_of)
        return image.reshape(self._size[1], self._size[0], 3)

    def collect(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Return, for every Gaussian, the sum of the pixels times its weights."""
        check_image(image, self._size)
        flat = image.reshape(-1, 3).to(self._weights.dtype)
        return segments.segment_sum_of(flat, self._pixels, self._row_starts, self._weights)

    def powers(self) -> Float[Tensor, "n 2"]:
        """Return, for every Gaussian, the sum of its weights and of their squares."""
        both = torch.stack([self._weights, self._weights.square()], dim=1)
        return segments.segment_sum(both, self._row_starts)
