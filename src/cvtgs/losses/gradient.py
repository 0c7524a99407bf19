"""Edges that differ between images."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.losses.pairs import check_pair


def gradient_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Return the mean of ``|dx|`` plus the mean of ``|dy|`` of the image difference.

    The derivatives are differences of neighbouring pixels, inside the image only: ``w - 1`` of
    them in a row and ``h - 1`` in a column. A constant offset costs nothing, a shifted or
    blurred edge does.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` what they should be.

    Returns:
        A scalar, at least 0; differentiable in both. An image of one column (row) has no
        ``dx`` (``dy``), which then counts 0.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> import torch
        >>> edge = torch.tensor([0.0, 0.5])[None, None, :, None].expand(1, 2, 2, 3)
        >>> gradient_loss(edge, torch.zeros(1, 2, 2, 3)).item()
        0.5
    """
    check_pair(prediction, target)
    difference = prediction - target
    return _mean_step(difference, 2) + _mean_step(difference, 1)


def _mean_step(difference: Float[Tensor, "c h w 3"], axis: int) -> Float[Tensor, ""]:
    steps = difference.diff(dim=axis).abs()
    return steps.sum() / max(steps.numel(), 1)
