"""Read and write scenes in the format that the suffix of the file name selects."""

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from inspect import signature
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, BinaryIO, Literal

import numpy as np
import torch

from cvtgs.counts import checked_whole
from cvtgs.devices import threads_for_chunks, usable_device
from cvtgs.errors import (
    BLOCKS_ADVICE,
    DroppedDataWarning,
    FileFormatError,
    InvalidArgumentError,
    check_path,
    memory_errors,
    warn,
)
from cvtgs.io.atomic import atomic_output, check_output
from cvtgs.io.axes import SCENE_AXES, change_axes, checked_axes
from cvtgs.io.files import is_file, scene_file
from cvtgs.io.limits import FORMAT_LIMITS, SPZ_2, Losses, losses_within
from cvtgs.io.streams import ByteSink, ByteSource, file_of, name_of, written_to
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene, check_scene
from cvtgs.tags import TWO_SCALES
from cvtgs.text import shown

# Readers by suffix, imported when needed; the first suffix that fits counts. Each takes the options
# of :func:`load` that its format has.
_READERS: Mapping[str, str] = {
    ".compressed.ply": "cvtgs.io.compressed_ply:read_compressed_ply",
    ".ply": "cvtgs.io.ply:read_ply",
    ".spz": "cvtgs.io.spz:read_spz",
    ".ksplat": "cvtgs.io.splat:read_ksplat",
    ".splat": "cvtgs.io.splat:read_splat",
    ".sog": "cvtgs.io.sog:read_sog",
    "lod-meta.json": "cvtgs.io.sog:read_lod_sog",
    "meta.json": "cvtgs.io.sog:read_sog",
    ".glb": "cvtgs.io.gltf.read:read_gltf",
    ".gltf": "cvtgs.io.gltf.read:read_gltf",
    ".ckpt": "cvtgs.io.dicts:read_checkpoint",
    ".pt": "cvtgs.io.dicts:read_checkpoint",
}
_WRITERS: Mapping[str, str] = {
    ".compressed.ply": "cvtgs.io.compressed_ply:write_compressed_ply",
    ".ply": "cvtgs.io.ply:write_ply",
    ".spz": "cvtgs.io.spz:write_spz",
    ".splat": "cvtgs.io.splat:write_splat",
    ".sog": "cvtgs.io.sog:write_sog",
    ".spz.glb": "cvtgs.io.gltf.write:write_spz_glb",
    ".glb": "cvtgs.io.gltf.write:write_glb",
    ".gltf": "cvtgs.io.gltf.write:write_gltf",
    ".usda": "cvtgs.io.usd:write_usda",
}
_FILE_AXES = {".spz.glb": "luf", ".glb": "luf", ".gltf": "luf", ".usda": "rub"}  # of formats
READABLE_SUFFIXES = tuple(name for name in _READERS if name.startswith("."))
WRITABLE_SUFFIXES = tuple(_WRITERS)


def load(
    path: str | os.PathLike[str] | ByteSource,
    *,
    format: str | None = None,
    device: str | torch.device = "cpu",
    sh_degree: int | None = None,
    extras: bool = True,
    axes: str | None = None,
    trust_sizes: bool = False,
    lod: int | None = None,
) -> GaussianScene:
    """Read a scene from a file or the folder of a trained model.

    PLY files of any encoding, property order and number type are read, with SH degree 0 to 3.
    Unknown columns become extras; NaN and infinite values are returned as they are.

    Args:
        path: The file; its suffix selects the format: ``.ply`` (plain, or compressed by
            PlayCanvas' tools), ``.spz``, ``.splat``, ``.ksplat``, ``.sog`` or the ``meta.json`` of
            a SOG, the ``lod-meta.json`` of a streamed SOG, ``.glb`` or ``.gltf`` with
            ``KHR_gaussian_splatting``, ``.ckpt`` of nerfstudio's Splatfacto, ``.pt`` of gsplat's
            trainer. In a folder, :func:`cvtgs.io.scene_file` finds the file. A file that is open
            in binary mode is read to its end; it need not be seekable.
        format: The suffix of the format, ``".splat"`` or ``"splat"``, which overrides the name of
            the file. None detects it by the name, or by the first bytes of an open file.
        device: The device of the tensors.
        sh_degree: SH bands above this degree are set to zero; None keeps all. For plain PLY files
            their columns are not even copied. The scene keeps the degree of the file, which
            :meth:`cvtgs.scene.GaussianScene.with_sh_degree` lowers.
        extras: Whether columns beyond the standard ones are kept; only plain PLY files have any.
        axes: The axes of the file, for example ``"rub"``, as :func:`cvtgs.io.change_axes` names
            them; the scene is converted to ``"rdf"``, the axes of PLY files. None uses those that
            the file states (``.spz`` files can) or its format prescribes (``"luf"`` for glTF), and
            ``"rdf"`` for other files.
        trust_sizes: Whether a compressed file may unpack to any size. By default, one that claims
            far more Gaussians than its bytes can hold is refused before it takes memory.
        lod: Level of a streamed SOG; None for 0, the finest. Other files have no other level.

    Returns:
        The scene: float32, or float64 if the file has double coordinates.

    Raises:
        InputError: The file does not exist or cannot be read, or the folder holds no scene.
        FileFormatError: The format is unknown, or the file does not conform to it.
        MissingDependencyError: Reading this file needs an optional package.
        DeviceError: The device is not available.
        InvalidArgumentError: The SH degree, the axes or the level do not exist.
        OutOfMemoryError: The scene does not fit into memory.

    Example:
        >>> import tempfile
        >>> from cvtgs.synthetic import scene
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(scene("object", 2, sh_degree=0), Path(folder) / "two.ply")
        ...     load(Path(folder) / "two.ply")
        GaussianScene(2 Gaussians, SH degree 0, float32, cpu)
    """
    usable_device(device)
    if sh_degree is not None:
        checked_whole(sh_degree, "sh_degree", least=0, most=3)
    given: dict[str, Any] = {"sh_degree": sh_degree, "extras": extras, "trust_sizes": trust_sizes}
    given["axes"] = axes = None if axes is None else checked_axes(axes)
    given["lod"] = 0 if lod is None else lod
    if not isinstance(path, str | os.PathLike):
        if not hasattr(path, "read"):
            raise InvalidArgumentError(
                f"a scene is read from a path or an open binary file (io.BytesIO of bytes), "
                f"found {shown(path)}."
            )
        if format is not None:
            format = _suffix_of(_dotted(format) or "", _READERS, format=format)
        with file_of(path, format) as copy:
            return load(copy, device=device, **given)
    source = scene_file(path)
    named = _dotted(format) or source
    # the PLY reader raises if there is no file
    suffix = _suffix_of(named, _READERS, format=format) if is_file(source) else ".ply"
    if suffix.endswith(".ply"):
        from cvtgs.io.ply.header import is_compressed_ply  # noqa: PLC0415 (loaded as readers are)

        suffix = ".compressed.ply" if is_compressed_ply(source) else ".ply"
    with memory_errors(f"{source}: reading the scene", BLOCKS_ADVICE):
        read: Callable[..., GaussianScene] = resolve_name(_READERS[suffix])
        options = {name: given[name] for name in signature(read).parameters if name in given}
        if lod not in (None, 0) and "lod" not in options:
            raise InvalidArgumentError(
                f"lod must be 0 unless for a streamed SOG (lod-meta.json), found {lod!r} for "
                f"{source}."
            )
        scene = read(source, **options)
        if axes is not None and "axes" not in options:
            scene = change_axes(scene, axes, SCENE_AXES)
        if "sh_degree" not in options and sh_degree is not None and sh_degree < scene.sh_degree:
            rest = scene.shN.clone()
            rest[:, REST_COUNTS[sh_degree] :] = 0.0
            scene = scene.with_tensors({"shN": rest})
        return scene.to(device)


@threads_for_chunks()
def save(
    scene: GaussianScene,
    path: str | os.PathLike[str] | ByteSink,
    *,
    format: str | None = None,
    overwrite: bool = False,
    axes: str | None = None,
    spz_version: Literal[2, 3, 4] = 3,
) -> None:
    """Write a scene to a file, completely or not at all.

    A scene that was loaded from a PLY file is written to a PLY file with the same properties,
    order, types and comments, so that loading it again gives the same bits. Other formats round.
    If a format cannot hold some data at all, there is a warning before anything is written
    (:class:`cvtgs.errors.DroppedDataWarning`); :func:`cvtgs.io.losses` reports it without writing.

    Args:
        scene: The scene, on any device.
        path: The file to write; its suffix selects the format: ``.ply``, ``.compressed.ply``,
            ``.spz``, ``.splat``, ``.sog``, ``.glb``, ``.gltf``, ``.spz.glb`` (a glTF with an SPZ
            inside) or ``.usda`` (OpenUSD). A file that is open for writing in binary mode gets all
            bytes once the scene is encoded.
        format: The suffix of the format, ``".spz"`` or ``"spz"``, which overrides the name of the
            file. None detects it by the name, and writes a ``.ply`` to an open file.
        overwrite: Whether an existing file may be replaced.
        axes: The axes of the file, as :func:`cvtgs.io.change_axes` names them; the scene, whose
            axes are ``"rdf"``, is converted to them. None uses those of the format: ``"luf"`` for
            glTF, ``"rub"`` for OpenUSD, ``"rdf"`` for the others. ``.spz`` files of version 4
            state their axes.
        spz_version: Version of ``.spz`` files: 3, 4, which many viewers cannot read yet, or 2 for
            older readers.

    Raises:
        FileFormatError: The format is unknown or cannot be written.
        OutputExistsError: The file exists and may not be replaced.
        OutputError: The file cannot be written (directory missing, no permission, disk full).
        InvalidSceneError: The format cannot represent the scene.
        InvalidArgumentError: The axes or the version do not exist, a version is given for another
            format, or an argument has another type.

    Example:
        >>> import tempfile
        >>> from cvtgs.synthetic import scene
        >>> two = scene("object", 2, sh_degree=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(two, Path(folder) / "two.ply")
        ...     save(two, Path(folder) / "two.ply", overwrite=True)
    """
    output: AbstractContextManager[BinaryIO]
    check_scene(scene)
    if isinstance(path, str | os.PathLike):
        check_path(path)
        name, named = os.fspath(path), _dotted(format) or path
        output = atomic_output(path, overwrite=overwrite)
    else:
        if not hasattr(path, "write"):
            raise InvalidArgumentError(
                f"a scene is saved to a path or an open binary file, found {shown(path)}."
            )
        name, named = name_of(path), _dotted(format) or ".ply"
        output = written_to(path)
    suffix = _suffix_of(named, _WRITERS, format=format)
    if spz_version != 3 and suffix != ".spz":
        raise InvalidArgumentError(f"spz_version needs an .spz to write, found {named}.")
    if isinstance(path, str | os.PathLike):
        check_output(path, overwrite=overwrite)
    axes = _FILE_AXES.get(suffix, SCENE_AXES) if axes is None else axes
    scene = change_axes(scene, SCENE_AXES, axes)
    scene = scene if suffix == ".ply" else tagged_if_flat(scene)
    dropped = losses(scene, named).dropped
    if dropped:
        left_out = "left out" if suffix == ".ply" else "files of this format do not hold"
        warn(f"{name}: {left_out} {'; '.join(dropped)}.", DroppedDataWarning)
    options = {"version": spz_version, "axes": axes} if suffix == ".spz" else {}
    write: Callable[..., None] = resolve_name(_WRITERS[suffix])
    # Values that a format cannot hold are clamped; numpy would warn of their overflow.
    with np.errstate(over="ignore"), memory_errors(f"writing {name}", "free some"), output as file:
        write(scene, file, **options)


def tagged_if_flat(scene: GaussianScene) -> GaussianScene:
    """Return a scene of two scales with their tag, for formats that keep no layout."""
    if not scene.has_two_scales or TWO_SCALES.is_in(scene.comments):
        return scene
    return replace(scene, comments=(*scene.comments, TWO_SCALES.text))


def losses(scene: GaussianScene, path: str | os.PathLike[str], *, spz_version: int = 3) -> Losses:
    """Report which data of a scene a file would not hold, without writing it.

    Args:
        scene: The scene.
        path: The file, of which only the name is used, or the suffix of a format.
        spz_version: Version of a ``.spz``, as in :func:`save`.

    Returns:
        The data that would be dropped, and rounded or reordered, and the number and SH degree of
        the Gaussians in the file. A ``.ply`` holds all but a third scale that the layout lacks.

    Raises:
        FileFormatError: The format is unknown or cannot be written.
        InvalidArgumentError: An argument has another type.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> losses(scene("object", 10, sh_degree=1, seed=0), "small.splat").dropped
        ('SH bands above degree 0 (the scene has degree 1)',)
    """
    check_scene(scene)
    check_path(path)
    dotted = f".{os.fspath(path)}"
    named = dotted if dotted.lower() in _WRITERS else path
    suffix = _suffix_of(named, _WRITERS)
    if suffix == ".ply":
        from cvtgs.io.ply.write import lost_scales  # noqa: PLC0415 (only where written)

        lost = lost_scales(scene)
        dropped = (lost,) if lost else ()
        return Losses(dropped=dropped, changed=(), count=len(scene), sh_degree=scene.sh_degree)
    limits = SPZ_2 if suffix == ".spz" and spz_version == 2 else FORMAT_LIMITS[suffix]
    return losses_within(scene, limits)


def check_save(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that :func:`save` could write a file, before the scene is computed.

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
    check_path(path)
    _suffix_of(path, _WRITERS)
    check_output(path, overwrite=overwrite)


def _dotted(suffix: str | None) -> str | None:
    """Return the suffix of a format with a leading dot: ``ply`` means ``.ply``."""
    if not isinstance(suffix, str | None):
        raise FileFormatError(f"format must be a suffix such as '.ply', found {shown(suffix)}.")
    if suffix and ("." not in suffix or f".{suffix.lower()}" in (*_READERS, *_WRITERS)):
        return f".{suffix}"
    return suffix


def _suffix_of(
    path: str | os.PathLike[str], known: Iterable[str], *, format: str | None = None
) -> str:
    """Return the suffix, or the whole file name, that selects the format."""
    path = Path(path)
    for suffix in known:
        if path.name.lower().endswith(suffix):
            return suffix
    *others, last = known
    if format is not None:
        raise FileFormatError(
            f"format must be {', '.join(others)} or {last}, found {shown(format)}."
        )
    found = f"the suffix {path.suffix!r}" if path.suffix else "no suffix"
    if path.suffix.lower() == ".pth":
        found += "; of a model of INRIA's code, give its folder or its point_cloud.ply"
    raise FileFormatError(
        f"{path}: the name must end in {', '.join(others)} or {last}, found {found}."
    )
