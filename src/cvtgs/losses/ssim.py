"""Structural similarity, the one definition that losses and metrics share."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.losses.pairs import check_pair

SSIM_WINDOW = 11
"""Side of the Gaussian window in pixels; its standard deviation is 1.5 pixels."""

SSIM_BORDER = "valid"
"""Only windows that lie inside the image count; nothing is padded."""


def ssim_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Give 1 minus the mean structural similarity; see :func:`cvtgs.losses.ssim.mean_ssim`.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images, not clipped.
        target: ``(c, h, w, 3)`` what they should be.

    Returns:
        A scalar from 0 (equal images) to 2; differentiable in both.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit, or the images are smaller than
            the window.

    Example:
        >>> import torch
        >>> image = torch.linspace(0, 1, 12 * 13 * 3).reshape(1, 12, 13, 3)
        >>> round(ssim_loss(image, image).item(), 5)
        0.0
    """
    return 1 - mean_ssim(prediction, target).mean()


def mean_ssim(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, "c"]:
    """Return the structural similarity (SSIM) of each image (Wang, Bovik, Sheikh, Simoncelli 2004).

    Window 11 x 11, Gaussian of 1.5 pixels, K1 = 0.01, K2 = 0.03, range of values 1, each channel
    by itself. Border "valid", as in the paper (section III-C, equation 13): only windows inside
    the image count, so the mean is over ``(h - 10) * (w - 10)`` places. Memory: about 12 copies
    of one stack of images, and as much again for the gradient.
    """
    check_pair(prediction, target, least=SSIM_WINDOW)
    from kornia.metrics import ssim  # noqa: PLC0415 (half a second)

    similarity = ssim(
        prediction.permute(0, 3, 1, 2),
        target.permute(0, 3, 1, 2),
        SSIM_WINDOW,
        max_val=1.0,
        eps=0.0,
        padding=SSIM_BORDER,
    )
    return similarity.mean(dim=(1, 2, 3))
