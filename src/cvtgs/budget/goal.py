"""What quality is to be reached."""

from typing import Literal, NamedTuple

from cvtgs.budget.judge import MOST_PSNR, Quality
from cvtgs.errors import InvalidArgumentError


class Goal(NamedTuple):
    """What is to be reached.

    Attributes:
        metric: ``psnr`` or ``ssim``.
        wanted: Its value, dB or similarity.
    """

    metric: Literal["psnr", "ssim"]
    wanted: float

    def of(self, quality: Quality) -> float:
        """Return the value of the metric."""
        return quality.psnr if self.metric == "psnr" else quality.ssim

    def text(self, value: float) -> str:
        """Write a value of the metric."""
        return f"{value:.2f} dB" if self.metric == "psnr" else f"SSIM {value:.4f}"


def check_target(psnr: float | None, *, ssim: float | None) -> Goal:
    """Refuse qualities that nothing can have."""
    if (psnr is None) == (ssim is None):
        raise InvalidArgumentError("give either psnr or ssim, not both and not neither.")
    if psnr is not None:
        if not 0 < psnr <= MOST_PSNR:
            raise InvalidArgumentError(
                f"the PSNR to reach must be above 0 and at most {MOST_PSNR:g} dB, found {psnr!r}."
            )
        return Goal("psnr", psnr)
    if not 0 < (ssim or 0.0) < 1:
        raise InvalidArgumentError(
            f"the SSIM to reach must be above 0 and below 1, found {ssim!r}."
        )
    return Goal("ssim", ssim or 0.0)
