"""Where the weights of LPIPS come from: a file, a folder or the ``lpips`` package."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import torch
from torch import Tensor

from cvtgs.errors import (
    FileFormatError,
    InputNotFoundError,
    InvalidArgumentError,
    MissingDependencyError,
)
from cvtgs.evaluation.lpips_network import LPIPS_NETWORKS, NETWORKS, LpipsNetwork
from cvtgs.evaluation.lpips_package import package_files
from cvtgs.io.files import open_input

LPIPS_VARIABLE = "CVTGS_LPIPS_WEIGHTS"
"""Environment variable with the path of a weights file, or of a folder of them."""

_OTHER_NAMES = (
    (re.compile(r"net\.slice\d+\.(\d+)\.(weight|bias)"), r"features.\1.\2"),
    (re.compile(r"lin(\d+)\.model\.\d+\.weight"), r"lin\1.weight"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LpipsWeights:
    """The weights of one LPIPS network, read once.

    Attributes:
        network: Which network they are for.
        tensors: ``features.<i>.weight``, ``features.<i>.bias`` and ``lin0.weight`` to
            ``lin4.weight``, float32 on the CPU.
        source: The files that they came from.
    """

    network: LpipsNetwork
    tensors: Mapping[str, Tensor]
    source: str


def load_lpips(
    network: LpipsNetwork = "vgg", path: str | os.PathLike[str] | None = None
) -> LpipsWeights:
    """Read the weights of LPIPS, from the first of these that there is.

    1. ``path``; 2. the path in the environment variable ``CVTGS_LPIPS_WEIGHTS``; 3. the installed
    package ``lpips``, with the backbone that torchvision has downloaded before. A path is that of
    a state dict, or of a folder with ``lpips_vgg*.pth`` or ``lpips_alex*.pth``. A state dict
    has torchvision's names (``features.0.weight``, ``lin0.weight``) or those of
    ``lpips.LPIPS(net="vgg").state_dict()``, in any precision. Nothing is downloaded.

    Args:
        network: ``"vgg"`` or ``"alex"``.
        path: A weights file or a folder of them.

    Returns:
        The weights.

    Raises:
        InvalidArgumentError: There is no such network.
        MissingDependencyError: No path was given and the package is not installed or incomplete.
        InputNotFoundError: There is no such file.
        InputError: It cannot be read.
        FileFormatError: It does not hold the weights of this network.

    Example:
        >>> import tempfile
        >>> layers = NETWORKS["alex"].convolutions
        >>> zeros = {f"features.{layer.index}.weight": torch.zeros(layer.shape) for layer in layers}
        >>> zeros |= {f"features.{l.index}.bias": torch.zeros(l.shape[0]) for l in layers}
        >>> zeros |= {f"lin{k}.weight": torch.zeros(1, l.shape[0], 1, 1)
        ...           for k, l in enumerate(layers)}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.save(zeros, Path(folder) / "lpips_alex.pth")
        ...     load_lpips("alex", folder).network
        'alex'
    """
    if network not in LPIPS_NETWORKS:
        raise InvalidArgumentError(
            f"network must be {' or '.join(map(repr, LPIPS_NETWORKS))}, found {network!r}."
        )
    given = os.fspath(path) if path is not None else os.environ.get(LPIPS_VARIABLE, "")
    files = (_find(Path(given), network),) if given else _installed(network)
    tensors: dict[str, Tensor] = {}
    for file in files:
        tensors |= _read(file)
    source = " and ".join(map(str, files))
    return LpipsWeights(
        network=network, tensors=_checked(tensors, network, source=source), source=source
    )


def _find(path: Path, network: LpipsNetwork) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob(f"lpips_{network}*.pth"))
    if not found:
        raise InputNotFoundError(
            f"{path}: the folder must hold a file lpips_{network}*.pth, found none."
        )
    return found[0]


def _installed(network: LpipsNetwork) -> tuple[Path, ...]:
    files = package_files(network)
    if files is None:
        raise MissingDependencyError(
            f"LPIPS needs weights: set {LPIPS_VARIABLE} to a file of them, or in Python pass "
            f"weights=, or install the extra with: pip install 'cvtgs[lpips]'; found none."
        )
    for file in files:
        if not file.is_file():
            raise MissingDependencyError(
                f"LPIPS needs {file}, found none; fetch it once with: "
                f"python -c \"import lpips; lpips.LPIPS(net='{network}')\"."
            )
    return files


def _read(path: Path) -> dict[str, Tensor]:
    """Read a state dict and give its tensors torchvision's names."""
    with open_input(path) as file:
        state = _unpickled(file, path)
    if not isinstance(state, Mapping):
        raise FileFormatError(
            f"{path}: must hold a state dict, found an object of type {type(state).__name__}."
        )
    return {_renamed(key): value for key, value in state.items()}


def _unpickled(file: BinaryIO, path: Path) -> Any:
    """Unpickle tensors and containers, and nothing that runs code."""
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file makes torch.load raise nearly anything
        raise FileFormatError(
            f"{path}: must be a state dict that torch.load(weights_only=True) reads, "
            f"found none; the file may be damaged."
        ) from error


def _renamed(key: Any) -> str:
    for pattern, name in _OTHER_NAMES:
        if match := pattern.fullmatch(str(key)):
            return match.expand(name)
    return str(key)


def _checked(
    tensors: Mapping[str, Any], network: LpipsNetwork, *, source: str
) -> Mapping[str, Tensor]:
    """Take what the network needs, and nothing that does not fit."""
    taken: dict[str, Tensor] = {}
    for name, shape in _shapes(network).items():
        tensor = tensors.get(name)
        if tensor is None or not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
            found = getattr(tensor, "shape", None)
            raise FileFormatError(
                f"{source}: the LPIPS network {network!r} must have {name} of shape {shape}, "
                f"found {'none' if found is None else tuple(found)}; are these its weights?"
            )
        if not tensor.is_floating_point() or not bool(tensor.isfinite().all()):
            raise FileFormatError(f"{source}: {name} must hold finite floats, found others.")
        taken[name] = tensor.float()
    return MappingProxyType(taken)


def _shapes(network: LpipsNetwork) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in NETWORKS[network].convolutions:
        shapes[f"features.{layer.index}.weight"] = layer.shape
        shapes[f"features.{layer.index}.bias"] = layer.shape[:1]
    for number, channels in enumerate(NETWORKS[network].tap_channels):
        shapes[f"lin{number}.weight"] = (1, channels, 1, 1)
    return shapes
