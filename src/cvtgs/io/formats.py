"""Load and save scenes; the suffix of the file says which format it is."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import torch

from cvtgs.errors import DeviceError, FileFormatError
from cvtgs.io.atomic import atomic_output, check_output
from cvtgs.io.ply import read_ply, write_ply
from cvtgs.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True)
class _Format:
    read: Callable[[Path], GaussianScene]
    write: Callable[[GaussianScene, BinaryIO], None]


_FORMATS: Mapping[str, _Format] = MappingProxyType(
    {".ply": _Format(read=read_ply, write=write_ply)}
)


def load(path: str | os.PathLike[str], *, device: str | torch.device = "cpu") -> GaussianScene:
    """Read a scene from a file.

    PLY files of any encoding, property order and number type are read, with SH degree 0 to 3.
    Unknown columns become extras; NaN and infinite values are returned as they are.

    Args:
        path: The file; its suffix says the format (``.ply``).
        device: Where the tensors are to be.

    Returns:
        The scene: float32, or float64 if the file has double coordinates.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: The format is unknown, or the file is not what its format promises.
        DeviceError: The device is not there.

    Example:
        >>> import tempfile
        >>> scene = GaussianScene(
        ...     means=torch.zeros(2, 3), quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        ...     log_scales=torch.zeros(2, 3), logit_opacities=torch.zeros(2),
        ...     sh0=torch.zeros(2, 1, 3), shN=torch.zeros(2, 0, 3),
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(scene, Path(folder) / "two.ply")
        ...     load(Path(folder) / "two.ply")
        GaussianScene(2 Gaussians, SH degree 0, float32, cpu)
    """
    source = Path(path)
    _check_device(device)
    if not os.path.isfile(source):  # noqa: PTH113 (Path.is_file raises without permission)
        return read_ply(source)  # says what is wrong, whatever the suffix
    return _format_of(source).read(source).to(device)


def save(scene: GaussianScene, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a scene to a file, completely or not at all.

    A scene that was loaded is written with the properties, their order, types and comments that
    it came with, so that ``load(save(scene))`` gives the same bits.

    Args:
        scene: The scene, on any device.
        path: The file to write; its suffix says the format (``.ply``).
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileFormatError: The format is unknown.
        OutputExistsError: The file exists and may not be replaced.
        OutputError: The file cannot be written (directory missing, no permission, disk full).
        InvalidSceneError: Something in the scene has no place in the format.

    Example:
        >>> import tempfile
        >>> scene = GaussianScene(
        ...     means=torch.zeros(2, 3), quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        ...     log_scales=torch.zeros(2, 3), logit_opacities=torch.zeros(2),
        ...     sh0=torch.zeros(2, 1, 3), shN=torch.zeros(2, 0, 3),
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(scene, Path(folder) / "two.ply")
        ...     save(scene, Path(folder) / "two.ply", overwrite=True)
    """
    write = _format_of(Path(path)).write
    with atomic_output(path, overwrite=overwrite) as file:
        write(scene, file)


def check_save(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that :func:`save` could write a file, before the long work that comes first.

    Args:
        path: The file to write.
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileFormatError: The format is unknown.
        OutputExistsError: The file exists and may not be replaced.
        OutputError: It is not a regular file, or its directory is missing or not writable.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     check_save(Path(folder) / "new.ply")
    """
    _format_of(Path(path))
    check_output(path, overwrite)


def _format_of(path: Path) -> _Format:
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise FileFormatError(
            f"{path}: the file name must end in {' or '.join(_FORMATS)}, "
            f"found {f'the suffix {path.suffix!r}' if suffix else 'no suffix'}."
        )
    return _FORMATS[suffix]


def _check_device(device: str | torch.device) -> None:
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise DeviceError(
            f"the device must be one of this machine, {device!s} is not: {reason}."
        ) from error
