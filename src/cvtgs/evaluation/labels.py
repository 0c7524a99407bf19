"""How numbers are written under images."""

import math


def decibels(value: float) -> str:
    """Write a PSNR."""
    return "equal" if math.isinf(value) else f"{value:.2f} dB"


def megabytes(count: int | None) -> str:
    """Write the size of a file in decimal units."""
    if count is None:
        return ""
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"


def times_fewer(ratio: float) -> str:
    """Write how many times fewer Gaussians there are."""
    if abs(ratio - 1) < 0.005:
        return "as many"
    return f"{ratio:,.0f} times fewer" if ratio >= 10 else f"{ratio:.3g} times fewer"
