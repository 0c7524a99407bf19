"""How far rendered images are from the images that they should be."""

from cvtgs.losses.gradient import gradient_loss
from cvtgs.losses.image import image_loss
from cvtgs.losses.l1 import l1_loss
from cvtgs.losses.relative import relative_loss
from cvtgs.losses.ssim import ssim_loss

__all__ = ["gradient_loss", "image_loss", "l1_loss", "relative_loss", "ssim_loss"]
