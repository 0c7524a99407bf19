"""A loss that makes every image count alike, the near-perfect ones and the poor ones."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.losses.image import image_loss
from cvtgs.losses.ssim import ssim_loss
from cvtgs.math.activations import positive_log

FAINTEST_SQUARED = 1e-5
FAINTEST_IMAGE = 1e-3
"""What is added to errors before their logarithm, so that near-perfect images count less."""


def relative_loss(
    prediction: Float[Tensor, "c h w 3"],
    target: Float[Tensor, "c h w 3"],
    *,
    squared_weight: float = 0.5,
    image_weight: float = 0.5,
    ssim_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """Return ``w_s log(mse) + w_i log(image_loss) + w_d log(1 - SSIM)``.

    It falls with the PSNR of the images by as much whether they are good or poor.

    A term of weight 0 is not computed.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` what they should be.
        squared_weight: ``w_s``, at least 0.
        image_weight: ``w_i``, at least 0.
        ssim_weight: ``w_d``, at least 0.

    Returns:
        A scalar, negative for good images; differentiable in both.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit, or the images are smaller than
            the SSIM window of 11 pixels.

    Example:
        >>> import torch
        >>> grey, white = torch.full((1, 11, 11, 3), 0.5), torch.ones(1, 11, 11, 3)
        >>> round(relative_loss(grey, white, image_weight=0.0).item(), 3)
        -0.693
    """
    loss = prediction.new_zeros(())
    if squared_weight:
        squared = (prediction - target).square().mean()
        loss = loss + squared_weight * positive_log(squared + FAINTEST_SQUARED)
    if image_weight:
        loss = loss + image_weight * positive_log(image_loss(prediction, target) + FAINTEST_IMAGE)
    if ssim_weight:
        loss = loss + ssim_weight * positive_log(ssim_loss(prediction, target) + FAINTEST_IMAGE)
    return loss
