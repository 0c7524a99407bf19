"""Closed-form image metrics: PSNR, SSIM, alpha error and alpha bias."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.devices import full_precision
from cvtgs.losses import SSIM_WINDOW, check_pair, mean_ssim


@torch.no_grad()
def psnr(a: Float[Tensor, "c h w 3"], b: Float[Tensor, "c h w 3"]) -> Float[Tensor, "c"]:
    """Return the peak signal-to-noise ratio of each pair of images, ``10 log10(1 / mse)``.

    Args:
        a: ``(c, h, w, 3)`` images, clipped to [0, 1].
        b: ``(c, h, w, 3)`` images, clipped to [0, 1].

    Returns:
        ``(c,)`` decibels, at least 0, without gradient. It is ``inf`` for images that are equal
        after clipping; a mean over views with such a pair is ``inf`` too.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> psnr(torch.full((1, 4, 4, 3), 0.4), torch.full((1, 4, 4, 3), 0.5)).tolist()
        [20.0]
    """
    check_pair(a, b)
    pairs = zip(a.split(1), b.split(1), strict=True)
    return torch.stack([pair_psnr(one, other) for one, other in pairs]).to(a.dtype)


@torch.no_grad()
@full_precision()
def ssim(a: Float[Tensor, "c h w 3"], b: Float[Tensor, "c h w 3"]) -> Float[Tensor, "c"]:
    """Return the structural similarity of each pair of images.

    :func:`cvtgs.losses.mean_ssim` of clipped images: a Gaussian window of 11 x 11 pixels with a
    sigma of 1.5, border "valid" (only windows inside the image), mean over positions and channels.
    This is scikit-image's result with ``gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False``. In float32 it is within 1e-4 of float64, mostly within 1e-5.
    Memory: about 26 copies of one image, and one of both stacks.

    Args:
        a: ``(c, h, w, 3)`` images, clipped to [0, 1].
        b: ``(c, h, w, 3)`` images, clipped to [0, 1].

    Returns:
        ``(c,)`` similarities from -1 to 1, 1 for equal images, without gradient.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit, or the images are smaller than
            the window.

    Example:
        >>> image = torch.linspace(0, 1, 12 * 13 * 3).reshape(1, 12, 13, 3)
        >>> [round(value, 5) for value in ssim(image, image).tolist()]
        [1.0]
    """
    check_pair(a, b, least=SSIM_WINDOW)
    pairs = zip(a.clamp(0, 1).split(1), b.clamp(0, 1).split(1), strict=True)
    return torch.cat([mean_ssim(one, other) for one, other in pairs]).clamp(max=1).to(a.dtype)


@torch.no_grad()
def alpha_error(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"]) -> Float[Tensor, "c"]:
    """Return the mean absolute difference of accumulated alpha of each pair of images.

    Accumulated alpha is the share of a pixel that the scene covers; the rest is background. The
    error does not depend on the background, so it also reveals holes over a similar background.

    Args:
        a: ``(c, h, w)`` alpha, clipped to [0, 1].
        b: ``(c, h, w)`` alpha, clipped to [0, 1].

    Returns:
        ``(c,)`` values from 0 to 1, without gradient; 0 for equal alpha.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> alpha_error(torch.tensor([[[0.5, 1.0]]]), torch.tensor([[[1.0, 0.75]]])).tolist()
        [0.375]
    """
    return _alpha_differences(a, b).abs().mean(dim=(1, 2)).to(a.dtype)


@torch.no_grad()
def alpha_bias(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"]) -> Float[Tensor, "c"]:
    """Return the mean of ``a - b`` of each pair of images of accumulated alpha.

    It is negative if ``a`` lets more of the background through than ``b``: -0.01 means an
    additional 1 % of its light. The mean over holes alone is ``(error - bias) / 2``, with the
    error of :func:`alpha_error`.

    Args:
        a: ``(c, h, w)`` alpha of the simplified scene, clipped to [0, 1].
        b: ``(c, h, w)`` alpha of the full scene, clipped to [0, 1].

    Returns:
        ``(c,)`` values from -1 to 1, without gradient.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit.

    Example:
        >>> alpha_bias(torch.tensor([[[0.5, 1.0]]]), torch.tensor([[[1.0, 0.75]]])).tolist()
        [-0.125]
    """
    return _alpha_differences(a, b).mean(dim=(1, 2)).to(a.dtype)


def _alpha_differences(
    a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"]
) -> Float[Tensor, "c h w"]:
    """Check two images of alpha and return ``a - b`` in float64."""
    check_pair(a, b, kind=Float[Tensor, "c h w"])
    return a.clamp(0, 1).double() - b.clamp(0, 1).double()


def pair_psnr(one: Float[Tensor, "1 h w 3"], other: Float[Tensor, "1 h w 3"]) -> Float[Tensor, ""]:
    """Compute the PSNR of two images, with the mean of squares in float64."""
    errors = one.clamp(0, 1) - other.clamp(0, 1)
    return -10 * torch.log10(errors.double().square().mean())
