"""How good a simplified scene looks next to the full one."""

from cvtgs.evaluate.lpips_distance import lpips
from cvtgs.evaluate.lpips_weights import LPIPS_VARIABLE, LpipsWeights, load_lpips
from cvtgs.evaluate.metrics import psnr, ssim

__all__ = ["LPIPS_VARIABLE", "LpipsWeights", "load_lpips", "lpips", "psnr", "ssim"]
