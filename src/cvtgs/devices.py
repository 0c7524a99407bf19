"""The device to compute on, by name."""

import torch

from cvtgs.errors import DeviceError


def resolve_device(device: str | torch.device) -> torch.device | None:
    """Turn the name of a device into a device that is there.

    Args:
        device: ``auto``, ``cpu``, ``cuda``, or any torch device.

    Returns:
        The device; None for ``auto``.

    Raises:
        DeviceError: There is no such device.

    Example:
        >>> resolve_device("cpu")
        device(type='cpu')
    """
    if device == "auto":
        return None
    try:
        resolved = torch.device(device)
        torch.empty(0, device=resolved)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).split("\n")[0].rstrip(".")
        raise DeviceError(f"device {str(device)!r} cannot be used here: {reason}.") from None
    return resolved
