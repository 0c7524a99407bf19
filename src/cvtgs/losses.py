"""Losses between rendered images and their targets; of 16-bit images, they are float32."""

from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.checks import check_kinds
from cvtgs.counts import check_not_negative, real_number
from cvtgs.devices import full_precision
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.parameters import positive_log
from cvtgs.text import counted

__all__ = ["gradient_loss", "image_loss", "l1_loss", "relative_loss", "ssim_loss"]

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # side and standard deviation of the Gaussian window, pixels
SSIM_K1, SSIM_K2 = 0.01, 0.03  # stabilise the comparisons of means and of contrasts
SSIM_WEIGHT = GRADIENT_WEIGHT = 0.2  # weights in the loss of CVT-GS
SQUARED_FLOOR = 1e-5
IMAGE_FLOOR = 1e-3  # added to errors before the logarithm, so near-perfect images count less


def l1_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Return the mean absolute difference over images, pixels and channels.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` target images.

    Returns:
        A scalar, 0 for equal images; differentiable in both.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> import torch
        >>> l1_loss(torch.zeros(1, 2, 2, 3), torch.full((1, 2, 2, 3), 0.25)).item()
        0.25
    """
    return _l1(*_checked(prediction, target)).mean()


def _l1(prediction: Tensor, target: Tensor) -> Float[Tensor, "c"]:
    return (prediction - target).abs().mean(dim=(1, 2, 3))


def ssim_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Return 1 minus the mean structural similarity; see :func:`cvtgs.losses.mean_ssim`.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images, not clipped.
        target: ``(c, h, w, 3)`` target images.

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

    Window 11 x 11, Gaussian of 1.5 pixels, K1 = 0.01, K2 = 0.03, values from 0 to 1, each channel
    separately. Border "valid", as in the paper (section III-C, equation 13): only windows inside
    the image count, so the mean is over ``(h - 10) * (w - 10)`` positions. Memory: about 23 copies
    of one stack of images, 32 with the gradient.
    """
    prediction, target = _checked(prediction, target, least=SSIM_WINDOW)
    center = target.detach().mean(dim=(1, 2), keepdim=True)
    return _ssim(prediction - center, target - center, center=center.permute(0, 3, 1, 2))


@full_precision()
def _ssim(
    prediction: Tensor, target: Tensor, *, center: Tensor | float = 0.0
) -> Float[Tensor, "c"]:
    """Return the SSIM of images, from which a colour, ``center``, may have been subtracted.

    Variances are differences of squares: without it, rounding changes bright images by up to 1e-3.
    """
    from kornia.filters import filter2d_separable  # noqa: PLC0415 (slow)

    x, y = (images.permute(0, 3, 1, 2) for images in (prediction, target))
    kernel = _ssim_kernel(x.device, x.dtype)
    # One convolution of 15 channels is twice as fast as five of three, as in `kornia.metrics.ssim`.
    maps = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    filtered = filter2d_separable(maps, kernel, kernel, padding="valid")
    mean_x, mean_y, xx, yy, xy = filtered.split(3, dim=1)
    square_x, square_y, product = mean_x.square(), mean_y.square(), mean_x * mean_y
    variances = (xx - square_x) + (yy - square_y)  # the sums of both would lose a digit
    covariance = xy - product
    if isinstance(center, Tensor):
        mean_x, mean_y = mean_x + center, mean_y + center
        square_x, square_y, product = mean_x.square(), mean_y.square(), mean_x * mean_y
    low, high = SSIM_K1**2, SSIM_K2**2
    similarity: Tensor = (2 * product + low) * (2 * covariance + high)
    similarity = similarity / ((square_x + square_y + low) * (variances + high))
    return similarity.mean(dim=(1, 2, 3))


@cache
def _ssim_kernel(device: torch.device, dtype: torch.dtype) -> Float[Tensor, "1 k"]:
    from kornia.filters import get_gaussian_kernel1d  # noqa: PLC0415 (slow)

    with torch.inference_mode(mode=False):
        return get_gaussian_kernel1d(SSIM_WINDOW, SSIM_SIGMA, device=device, dtype=dtype)


def gradient_loss(
    prediction: Float[Tensor, "c h w 3"], target: Float[Tensor, "c h w 3"]
) -> Float[Tensor, ""]:
    """Return the mean of ``|dx|`` plus the mean of ``|dy|`` of the image difference.

    The derivatives are differences of neighbouring pixels, inside the image only: ``w - 1`` of
    them in a row and ``h - 1`` in a column. A constant offset has no cost; a shifted or blurred
    edge has.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` target images.

    Returns:
        A scalar, at least 0; differentiable in both. For images of one column (row), ``dx``
        (``dy``) counts as 0.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> import torch
        >>> edge = torch.tensor([0.0, 0.5])[None, None, :, None].expand(1, 2, 2, 3)
        >>> gradient_loss(edge, torch.zeros(1, 2, 2, 3)).item()
        0.5
    """
    return _gradient(*_checked(prediction, target)).mean()


def _gradient(prediction: Tensor, target: Tensor) -> Float[Tensor, "c"]:
    difference = prediction - target  # once: gradients of both axes are summed first
    steps = [difference.diff(dim=axis).abs() for axis in (2, 1)]
    dx, dy = (step.sum(dim=(1, 2, 3)) / max(step[0].numel(), 1) for step in steps)
    return dx + dy


def image_loss(
    prediction: Float[Tensor, "c h w 3"],
    target: Float[Tensor, "c h w 3"],
    *,
    ssim_weight: float = SSIM_WEIGHT,
    gradient_weight: float = GRADIENT_WEIGHT,
) -> Float[Tensor, ""]:
    """Return ``(1 - l) L1 + l (1 - SSIM) + l_g (|dx| + |dy|)``, the loss of CVT-GS.

    The first two terms are those of 3DGS (Kerbl et al. 2023, equation 7); the third is
    :func:`gradient_loss`. A term of weight 0 is not computed.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` target images, in [0, 1].
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
    if not 0 <= real_number(ssim_weight) <= 1:
        raise InvalidArgumentError(f"ssim_weight must be from 0 to 1, found {ssim_weight!r}.")
    check_not_negative(gradient_weight, "gradient_weight")
    prediction, target = _checked(prediction, target, least=SSIM_WINDOW if ssim_weight else 1)
    dissimilarity = 1 - _ssim(prediction, target) if ssim_weight else 0.0
    return _image_loss(prediction, target, dissimilarity, ssim_weight, gradient_weight).mean()


def relative_loss(
    prediction: Float[Tensor, "c h w 3"],
    target: Float[Tensor, "c h w 3"],
    *,
    mse_weight: float = 0.5,
    image_weight: float = 0.5,
    ssim_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """Return the mean over images of ``w_s log(mse) + w_i log(image_loss) + w_d log(1 - SSIM)``.

    A gain in PSNR lowers it by the same amount whether the images are good or poor, until the
    floors count: 1e-5 is added to the mse and 1e-3 to the others. A term of weight 0 is not
    computed.

    Args:
        prediction: ``(c, h, w, 3)`` rendered images.
        target: ``(c, h, w, 3)`` target images.
        mse_weight: ``w_s``, at least 0.
        image_weight: ``w_i``, at least 0.
        ssim_weight: ``w_d``, at least 0.

    Returns:
        A scalar, negative for good images; differentiable in both.

    Raises:
        InvalidArgumentError: A weight is out of range, shape, dtype or device do not fit, or the
            images are smaller than the SSIM window of 11 pixels.

    Example:
        >>> import torch
        >>> grey, white = torch.full((1, 11, 11, 3), 0.5), torch.ones(1, 11, 11, 3)
        >>> round(relative_loss(grey, white, image_weight=0.0).item(), 3)
        -0.693
    """
    check_not_negative(mse_weight, "mse_weight")
    check_not_negative(image_weight, "image_weight")
    check_not_negative(ssim_weight, "ssim_weight")
    uses_ssim = bool(image_weight or ssim_weight)
    prediction, target = _checked(prediction, target, least=SSIM_WINDOW if uses_ssim else 1)
    loss = prediction.new_zeros(len(prediction))
    if mse_weight:
        squared = (prediction - target).square().mean(dim=(1, 2, 3))
        loss = loss + mse_weight * positive_log(squared + SQUARED_FLOOR)
    if not uses_ssim:
        return loss.mean()
    dissimilarity = 1 - _ssim(prediction, target)  # once: it takes longest
    if image_weight:
        image = _image_loss(prediction, target, dissimilarity, SSIM_WEIGHT, GRADIENT_WEIGHT)
        loss = loss + image_weight * positive_log(image + IMAGE_FLOOR)
    if ssim_weight:
        loss = loss + ssim_weight * positive_log(dissimilarity + IMAGE_FLOOR)
    return loss.mean()


def _image_loss(
    prediction: Tensor,
    target: Tensor,
    dissimilarity: Tensor | float,
    ssim_weight: float,
    gradient_weight: float,
) -> Float[Tensor, "c"]:
    loss = (1 - ssim_weight) * _l1(prediction, target) + ssim_weight * dissimilarity
    if gradient_weight:
        loss = loss + gradient_weight * _gradient(prediction, target)
    return loss


def _checked(prediction: Tensor, target: Tensor, *, least: int = 1) -> tuple[Tensor, Tensor]:
    """Check images; return them with at least 32 bits per number, in which no sum overflows."""
    check_pair(prediction, target, least=least)
    wide = torch.promote_types(prediction.dtype, torch.float32)
    return prediction.to(wide), target.to(wide)


def check_pair(
    prediction: Tensor, target: Tensor, *, least: int = 1, kind: Any = Float[Tensor, "c h w 3"]
) -> None:
    """Check that two stacks of images of one kind can be compared."""
    stacks = {"the first stack of images": prediction, "the second one": target}
    check_kinds(dict.fromkeys(stacks, kind), stacks)
    if prediction.dtype != target.dtype or prediction.device != target.device:
        raise InvalidArgumentError(
            f"both stacks of images must share dtype and device, found {prediction.dtype} on "
            f"{prediction.device} and {target.dtype} on {target.device}."
        )
    height, width = prediction.shape[1:3]
    if len(prediction) == 0 or min(height, width) < least:
        raise InvalidArgumentError(
            f"there must be images of at least {least} x {least} pixels, found "
            f"{counted(len(prediction), 'image')} of {width} x {height}."
        )
