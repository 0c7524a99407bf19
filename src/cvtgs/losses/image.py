"""The loss that a rendered image is trained with."""

import math

from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.losses.gradient import gradient_loss
from cvtgs.losses.l1 import l1_loss
from cvtgs.losses.ssim import ssim_loss


def image_loss(
    prediction: Float[Tensor, "c h w 3"],
    target: Float[Tensor, "c h w 3"],
    *,
    ssim_weight: float = 0.2,
    gradient_weight: float = 0.2,
) -> Float[Tensor, ""]:
    """Return ``(1 - l) L1 + l (1 - SSIM) + l_g (|dx| + |dy|)``, the loss of CVT-GS.

    The first two terms are those of 3DGS (Kerbl et al. 2023, equation 7); the third is
    :func:`gradient_loss`. A term of weight 0 is not computed.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` what they should be, in [0, 1].
        ssim_weight: ``l``, from 0 to 1.
        gradient_weight: ``l_g``, at least 0.

    Returns:
        A scalar, 0 for equal images; differentiable in both.

    Raises:
        InvalidArgumentError: A weight is out of range, shape, dtype or device do not fit, or the
            images are smaller than the SSIM window of 11 pixels.

    Example:
        >>> import torch
        >>> grey, white = torch.full((1, 11, 11, 3), 0.5), torch.ones(1, 11, 11, 3)
        >>> round(image_loss(grey, white, ssim_weight=0.0).item(), 4)
        0.5
    """
    if not 0 <= ssim_weight <= 1:
        raise InvalidArgumentError(f"ssim_weight must be from 0 to 1, found {ssim_weight!r}.")
    if not 0 <= gradient_weight < math.inf:
        raise InvalidArgumentError(
            f"gradient_weight must be a finite number of at least 0, found {gradient_weight!r}."
        )
    loss = (1 - ssim_weight) * l1_loss(prediction, target)
    if ssim_weight:
        loss = loss + ssim_weight * ssim_loss(prediction, target)
    if gradient_weight:
        loss = loss + gradient_weight * gradient_loss(prediction, target)
    return loss
