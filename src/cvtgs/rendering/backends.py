"""Choose, once and by name, what renders."""

from importlib import import_module
from typing import Literal, Protocol, cast, get_args

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, InvalidArgumentError, MissingDependencyError
from cvtgs.progress import ProgressListener
from cvtgs.rendering.output import RasterOutput
from cvtgs.scene import GaussianScene

BackendName = Literal["auto", "torch", "numba", "gsplat"]
"""The names that :func:`choose_backend` takes."""


class Backend(Protocol):
    """What every backend's module offers."""

    def require(self, device: torch.device) -> None:
        """Raise a DeviceError or MissingDependencyError unless it works on that device."""
        ...

    def rasterize(
        self,
        scene: GaussianScene,
        cameras: Cameras,
        *,
        sh_degree: int,
        listener: ProgressListener,
    ) -> RasterOutput:
        """Render images on black; scene and cameras share a device."""
        ...

    def contributions(self, scene: GaussianScene, camera: Cameras) -> Tensor:
        """Return the pixels that every Gaussian paints of one image."""
        ...


def choose_backend(name: BackendName, device: torch.device) -> tuple[str, Backend]:
    """Resolve the name of a backend for a device.

    Args:
        name: ``torch``, ``numba`` (CPU), ``gsplat`` (CUDA), or ``auto``: gsplat on CUDA if it
            works there, numba on the CPU if it is installed, else torch.
        device: Where the scene is.

    Returns:
        The resolved name and the backend.

    Raises:
        InvalidArgumentError: There is no backend of that name.
        MissingDependencyError: The backend's package is missing or does not work here.
        DeviceError: The backend cannot work on that device.

    Example:
        >>> choose_backend("torch", torch.device("cpu"))[0]
        'torch'
    """
    if name not in get_args(BackendName):
        names = ", ".join(get_args(BackendName))
        raise InvalidArgumentError(f"backend must be one of {names}, found {name!r}.")
    if name != "auto":
        return name, _backend(name, device)
    for fast in ("gsplat", "numba"):
        try:
            return fast, _backend(fast, device)
        except (DeviceError, MissingDependencyError):
            continue
    return "torch", _backend("torch", device)


def _backend(name: str, device: torch.device) -> Backend:
    backend = cast("Backend", import_module(f"cvtgs.rendering.{name}_backend"))
    backend.require(device)
    return backend
