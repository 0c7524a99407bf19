"""Choose, once and by name, what renders."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Literal, Protocol, get_args

import torch

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, InvalidArgumentError, MissingDependencyError
from cvtgs.progress import ProgressListener
from cvtgs.render.painting import Painting
from cvtgs.scene import GaussianScene

BackendName = Literal["auto", "torch", "numba", "gsplat"]
"""The names that :func:`choose_backend` takes."""


class Rasterizer(Protocol):
    """What every backend module offers under the name ``rasterize``."""

    def __call__(
        self,
        scene: GaussianScene,
        cameras: Cameras,
        *,
        sh_degree: int,
        listener: ProgressListener,
    ) -> Painting:
        """Render pictures on black."""
        ...


def choose_backend(name: BackendName, device: torch.device) -> tuple[str, Rasterizer]:
    """Resolve the name of a backend for a device.

    Args:
        name: ``torch``, ``numba`` (CPU), ``gsplat`` (CUDA), or ``auto``: gsplat on CUDA when it
            works there, numba on the CPU when it is installed, else torch.
        device: Where the scene is.

    Returns:
        The resolved name and the function.

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
    if name == "auto":
        name = _best(device)
    wanted = {"numba": "cpu", "gsplat": "cuda"}.get(name, device.type)
    if device.type != wanted:
        raise DeviceError(
            f"backend {name!r} works on {wanted} only, found a scene on {device}; "
            f"use 'torch' or 'auto', or move the scene."
        )
    if name == "gsplat":
        _gsplat_probe()()
    return name, _module(name).rasterize


def _best(device: torch.device) -> BackendName:
    if device.type == "cpu":
        return "numba" if find_spec("numba") else "torch"
    if device.type == "cuda":
        return "gsplat"
    return "torch"
