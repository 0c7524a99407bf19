"""Mean absolute difference of images."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.losses.pairs import check_pair


def l1_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Return the mean absolute difference over images, pixels and channels.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` what they should be.

    Returns:
        A scalar, 0 for equal images; differentiable in both.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> import torch
        >>> l1_loss(torch.zeros(1, 2, 2, 3), torch.full((1, 2, 2, 3), 0.25)).item()
        0.25
    """
    check_pair(prediction, target)
    return (prediction - target).abs().mean()
