"""What two stacks of images must be to be compared."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError


def check_pair(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"], *, least: int = 1
) -> None:
    """Check that two stacks of images can be compared."""
    for images in (prediction, target):
        if not isinstance(images, Tensor) or not images.is_floating_point():
            raise InvalidArgumentError(
                f"images must be tensors of floats, "
                f"found {getattr(images, 'dtype', type(images).__name__)}."
            )
        if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
            raise InvalidArgumentError(
                f"images must have shape (c, h, w, 3) with nothing empty, "
                f"found {tuple(images.shape)}."
            )
    if prediction.shape != target.shape:
        raise InvalidArgumentError(
            f"both stacks of images must have one shape, "
            f"found {tuple(prediction.shape)} and {tuple(target.shape)}."
        )
    if prediction.dtype != target.dtype or prediction.device != target.device:
        raise InvalidArgumentError(
            f"both stacks of images must share dtype and device, found {prediction.dtype} on "
            f"{prediction.device} and {target.dtype} on {target.device}."
        )
    height, width = prediction.shape[1:3]
    if min(height, width) < least:
        raise InvalidArgumentError(
            f"images must have at least {least} x {least} pixels here, found {width} x {height}."
        )
