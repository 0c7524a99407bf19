"""Image metrics by formula: PSNR and SSIM."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.losses import SSIM_WINDOW, check_pair, mean_ssim


@torch.no_grad()
def psnr(a: Float[Tensor, "c h w 3"], b: Float[Tensor, "c h w 3"]) -> Float[Tensor, "c"]:
    """Return the peak signal-to-noise ratio of each pair of images, ``10 log10(1 / mse)``.

    Args:
        a: ``(c, h, w, 3)`` images, clipped to [0, 1].
        b: ``(c, h, w, 3)`` images, clipped to [0, 1].

    Returns:
        ``(c,)`` decibels, at least 0, without gradient. Images that are equal after clipping
        have ``inf``: a mean over views that holds one is ``inf`` too.

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
def ssim(a: Float[Tensor, "c h w 3"], b: Float[Tensor, "c h w 3"]) -> Float[Tensor, "c"]:
    """Return the structural similarity of each pair of images.

    :func:`cvtgs.losses.mean_ssim` of clipped images: Gaussian window of 11 x 11 pixels and
    1.5 pixels, border "valid" (only windows inside the image count), mean over places and
    channels; what scikit-image gives with ``gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False``. In float32 it is within 1e-4 of float64, mostly within 1e-5.
    Memory: about 12 copies of one image.

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
    return torch.cat([mean_ssim(one, other) for one, other in pairs])


def pair_psnr(one: Float[Tensor, "1 h w 3"], other: Float[Tensor, "1 h w 3"]) -> Float[Tensor, ""]:
    """Compute the PSNR of two images; the mean of the squares is taken in float64."""
    errors = one.clamp(0, 1) - other.clamp(0, 1)
    return -10 * torch.log10(errors.double().square().mean())
