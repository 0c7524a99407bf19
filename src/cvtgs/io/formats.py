"""Load and save scenes; the end of the file name says which format it is."""

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, TypeVar

import torch

from cvtgs.devices import usable_device
from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidArgumentError
from cvtgs.io.atomic import atomic_output, check_output
from cvtgs.io.checkpoints import read_checkpoint
from cvtgs.io.compressed_ply import (
    COMPRESSED_PLY_HOLDS,
    is_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from cvtgs.io.folders import scene_file
from cvtgs.io.limits import Holds, Losses, losses_of
from cvtgs.io.ply import read_ply, write_ply
from cvtgs.io.sog import SOG_HOLDS, read_sog, write_sog
from cvtgs.io.splat import SPLAT_HOLDS, read_splat, write_splat
from cvtgs.io.spz import SPZ_HOLDS, read_spz, write_spz
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene

Read = Callable[[Path], GaussianScene]
Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Output:
    """How a format is written; ``holds`` is None where nothing is lost."""

    write: Callable[[GaussianScene, BinaryIO], None]
    holds: Holds | None = None


# By the end of the file name; the first that fits counts.
_READERS: Mapping[str, Read] = MappingProxyType(
    {
        ".compressed.ply": read_ply,
        ".ply": read_ply,
        ".spz": read_spz,
        ".splat": read_splat,
        ".sog": read_sog,
        "meta.json": read_sog,
        ".ckpt": read_checkpoint,
        ".pt": read_checkpoint,
    }
)
_OUTPUTS: Mapping[str, _Output] = MappingProxyType(
    {
        ".compressed.ply": _Output(write=write_compressed_ply, holds=COMPRESSED_PLY_HOLDS),
        ".ply": _Output(write=write_ply),
        ".spz": _Output(write=write_spz, holds=SPZ_HOLDS),
        ".splat": _Output(write=write_splat, holds=SPLAT_HOLDS),
        ".sog": _Output(write=write_sog, holds=SOG_HOLDS),
    }
)


def load(
    path: str | os.PathLike[str],
    *,
    device: str | torch.device = "cpu",
    sh_degree: int | None = None,
    extras: bool = True,
) -> GaussianScene:
    """Read a scene from a file or the folder of a trained model.

    PLY files of any encoding, property order and number type are read, with SH degree 0 to 3.
    Unknown columns become extras; NaN and infinite values are returned as they are.

    Args:
        path: The file; the end of its name says the format: ``.ply`` (plain, or compressed by
            PlayCanvas' tools), ``.spz``, ``.splat``, ``.sog`` or the ``meta.json`` of a SOG,
            ``.ckpt`` of nerfstudio's Splatfacto, ``.pt`` of gsplat's trainer. Of a folder, the
            scene that :func:`cvtgs.io.scene_file` finds.
        device: Where the tensors are to be.
        sh_degree: SH bands above this degree are zeros, whatever the file holds; None for all. Of
            plain PLY files their columns are not even copied.
        extras: Whether columns beyond the standard ones are carried; only plain PLY files have any.

    Returns:
        The scene: float32, or float64 if the file has double coordinates.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read, or the folder holds no scene.
        FileFormatError: The format is unknown, or the file is not what its format promises.
        MissingDependencyError: Reading this file needs an optional package.
        DeviceError: The device is not there.
        InvalidArgumentError: There is no such SH degree.

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
    usable_device(device)
    _check_degree(sh_degree)
    source = scene_file(path)
    if not os.path.isfile(source):  # noqa: PTH113 (Path.is_file raises without permission)
        return read_ply(source)  # says what is wrong, whatever the suffix
    read = _by_name(source, _READERS)
    if read is read_ply and is_compressed_ply(source):
        read = read_compressed_ply
    if read is read_ply:
        return read_ply(source, sh_degree=sh_degree, extras=extras).to(device)
    return _reduced(read(source), sh_degree).to(device)


def save(scene: GaussianScene, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a scene to a file, completely or not at all.

    A scene that was loaded from a PLY is written to one with the properties, their order, types
    and comments that it came with, so that ``load(save(scene))`` gives the same bits. The other
    formats round. What they cannot hold at all is warned about before anything is written
    (:class:`cvtgs.errors.DroppedDataWarning`); :func:`cvtgs.io.losses` says it without writing.

    Args:
        scene: The scene, on any device.
        path: The file to write; the end of its name says the format: ``.ply``,
            ``.compressed.ply``, ``.spz``, ``.splat`` or ``.sog``.
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileFormatError: The format is unknown or cannot be written.
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
    write = _by_name(Path(path), _OUTPUTS).write
    check_output(path, overwrite)
    dropped = losses(scene, path).dropped
    if dropped:
        warnings.warn(
            f"{os.fspath(path)}: files of this format do not hold {'; '.join(dropped)}.",
            DroppedDataWarning,
            stacklevel=2,
        )
    with atomic_output(path, overwrite=overwrite) as file:
        write(scene, file)


def losses(scene: GaussianScene, path: str | os.PathLike[str]) -> Losses:
    """Report what of a scene a file would not hold, before it is written.

    Args:
        scene: The scene.
        path: The file; only its name is looked at.

    Returns:
        What would be dropped, what rounded or reordered (nothing for a ``.ply``), how many
        Gaussians are left, and of which SH degree.

    Raises:
        FileFormatError: The format is unknown or cannot be written.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> losses(scene("object", 10, sh_degree=1, seed=0), "small.splat").dropped
        ('SH bands above degree 0 (the scene has degree 1)',)
    """
    holds = _by_name(Path(path), _OUTPUTS).holds
    if holds is None:
        return Losses(dropped=(), changed=(), count=len(scene), sh_degree=scene.sh_degree)
    return losses_of(scene, holds)


def check_save(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that :func:`save` could write a file, before the long work that comes first.

    Args:
        path: The file to write.
        overwrite: Whether an existing file may be replaced.

    Raises:
        FileFormatError: The format is unknown or cannot be written.
        OutputExistsError: The file exists and may not be replaced.
        OutputError: It is not a regular file, or its directory is missing or not writable.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     check_save(Path(folder) / "new.ply")
    """
    _by_name(Path(path), _OUTPUTS)
    check_output(path, overwrite)


def _check_degree(sh_degree: int | None) -> None:
    if sh_degree is not None and not 0 <= sh_degree < len(REST_COUNTS):
        raise InvalidArgumentError(f"sh_degree must be from 0 to 3, found {sh_degree!r}.")


def _reduced(scene: GaussianScene, sh_degree: int | None) -> GaussianScene:
    if sh_degree is None or sh_degree >= scene.sh_degree:
        return scene
    rest = scene.shN.clone()
    rest[:, REST_COUNTS[sh_degree] :] = 0.0
    return scene.with_tensors({"shN": rest}, scene.extras)


def _by_name(path: Path, formats: Mapping[str, Entry]) -> Entry:
    name = path.name.lower()
    for end, one in formats.items():
        if name.endswith(end):
            return one
    *ends, last = formats
    raise FileFormatError(
        f"{path}: the file name must end in {', '.join(ends)} or {last}, "
        f"found {f'the suffix {path.suffix!r}' if path.suffix else 'no suffix'}."
    )
