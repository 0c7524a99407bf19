"""Choose, once and by name, what searches the nearest site."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from cvtgs.cvt.nearest_scipy import nearest_scipy
from cvtgs.cvt.nearest_torch import nearest_torch
from cvtgs.errors import DeviceError

NearestSite = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes points ``(n, d)`` and sites ``(m, d)``, gives labels and squared distances ``(n,)``."""


def nearest_backend(
    name: Literal["auto", "scipy", "torch"], device: torch.device
) -> tuple[str, NearestSite]:
    """Resolve the name of a backend for a device.

    Args:
        name: ``scipy``, ``torch``, or ``auto``: scipy on a CPU, torch elsewhere.
        device: Where the points are.

    Returns:
        The resolved name and the function.

    Raises:
        DeviceError: scipy was asked for and the points are not on the CPU.

    Example:
        >>> nearest_backend("auto", torch.device("cpu"))[0]
        'scipy'
    """
    if name == "auto":
        name = "scipy" if device.type == "cpu" else "torch"
    if name == "scipy" and device.type != "cpu":
        raise DeviceError(
            f"cvt.backend 'scipy' works on the CPU only, found device {device}; "
            f"use 'torch' or 'auto'."
        )
    return name, nearest_scipy if name == "scipy" else nearest_torch
