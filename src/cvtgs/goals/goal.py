"""What quality is to be reached."""

from typing import Literal, NamedTuple

from cvtgs.errors import InvalidArgumentError
from cvtgs.goals.judge import MOST_PSNR, Quality


class Goal(NamedTuple):
    """What is to be reached.

    Attributes:
        metric: ``psnr`` or ``ssim``.
        wanted: Its value, dB or similarity.
    """

    metric: Literal["psnr", "ssim"]
    wanted: float

    def of(self, quality: Quality) -> float:
        """Give the value of the metric.

        Args:
            quality: What was reached.

        Returns:
            dB, or a similarity.
        """
        return quality.psnr if self.metric == "psnr" else quality.ssim

    def text(self, value: float) -> str:
        """Write a value of the metric.

        Args:
            value: The value.

        Returns:
            For example ``30.00 dB``.
        """
        return f"{value:.2f} dB" if self.metric == "psnr" else f"SSIM {value:.4f}"


def check_target(psnr: float | None, *, ssim: float | None) -> Goal:
    """Refuse qualities that nothing can have.

    Args:
        psnr: Mean PSNR to reach, dB, or None.
        ssim: Mean SSIM to reach, or None.

    Returns:
        What is to be reached.

    Raises:
        InvalidArgumentError: Both or neither are given, or one is out of range.

    Example:
        >>> check_target(30.0, ssim=None).metric
        'psnr'
    """
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
