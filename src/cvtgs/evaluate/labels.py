"""How numbers are written under pictures."""

import math


def decibels(value: float) -> str:
    """Write a PSNR.

    Args:
        value: dB, maybe infinite.

    Returns:
        For example ``29.12 dB``, or ``equal``.

    Example:
        >>> decibels(29.123), decibels(float("inf"))
        ('29.12 dB', 'equal')
    """
    return "equal" if math.isinf(value) else f"{value:.2f} dB"


def megabytes(count: int | None) -> str:
    """Write the size of a file in decimal units.

    Args:
        count: Bytes, None if unknown.

    Returns:
        For example ``4.7 MB``; empty if unknown.

    Example:
        >>> megabytes(4_700_000), megabytes(None)
        ('4.7 MB', '')
    """
    if count is None:
        return ""
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"


def times_fewer(ratio: float) -> str:
    """Write how many times fewer Gaussians there are.

    Args:
        ratio: Gaussians before, divided by Gaussians after.

    Returns:
        For example ``100 times fewer``.

    Example:
        >>> times_fewer(100.0), times_fewer(2.5), times_fewer(1.0)
        ('100 times fewer', '2.5 times fewer', 'as many')
    """
    if abs(ratio - 1) < 0.005:
        return "as many"
    return f"{ratio:,.0f} times fewer" if ratio >= 10 else f"{ratio:.3g} times fewer"
