"""The ``.splat`` files of antimatter15's viewer and the ``.ksplat`` files of mkkellogg's."""

import os
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cvtgs.errors import FileFormatError
from cvtgs.io.arrays import (
    Arrays,
    log_scales_of,
    logits_of_bytes,
    sh0_of_colors,
    to_bytes,
    unit_quats,
)
from cvtgs.io.files import open_input
from cvtgs.scene import GaussianScene

_FLOATS = [("mean", "<f4", 3), ("scale", "<f4", 3)]
_ROW = np.dtype([*_FLOATS, ("rgb", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])
_OTHERS = (b"ply\n", b"ply\r", b"<!do", b"<htm", b"<?xm")  # starts of PLY files and web pages
_CHUNK_ROWS = 1 << 16
_HEADER_BYTES = 4096
_HEADER = struct.Struct("<BBxxIIIIHxx3fff")
_SECTION = struct.Struct("<IIIIfHxxIIIIH982x")
# Types of positions, of scales and rotations, and of SH, by compression level.
_NUMBERS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_RANGE = 32767  # quantised positions are centred on this number, unless the section states another
_SH_RANGE = (-1.5, 1.5)  # 0 in the header stands for the usual bound
_COMPONENTS = (0, 9, 24)  # view-dependent SH components of a Gaussian, by degree


def read_splat(path: Path) -> GaussianScene:
    """Read a ``.splat`` file; scales are no logarithms, quaternions (w first) ``128 + 128 q``."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(4)
        if size == 0 or size % _ROW.itemsize or start.lower() in _OTHERS:
            raise FileFormatError(
                f"{path}: a .splat file must hold one or more Gaussians of {_ROW.itemsize} bytes "
                f"each and no header, found {size:,} bytes that start with {start!r}."
            )
        file.seek(0)
        rows = np.fromfile(file, _ROW)
    return Arrays(
        means=rows["mean"],
        quats=unit_quats((rows["quat"].astype(np.float32) - 128) / np.float32(128)),
        log_scales=log_scales_of(rows["scale"]),
        logit_opacities=logits_of_bytes(rows["opacity"]),
        sh0=sh0_of_colors(rows["rgb"].astype(np.float32) / np.float32(255)),
        shN=np.empty((len(rows), 0, 3), np.float32),
    ).scene()


def write_splat(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a ``.splat`` file, in the order of the scene."""
    for part in Arrays.of(scene, sh_degree=0).chunks(_CHUNK_ROWS):
        rows = np.empty(len(part.means), _ROW)
        rows["mean"] = part.means
        rows["scale"] = part.scales
        rows["rgb"] = to_bytes(255 * part.colors)
        rows["opacity"] = part.opacity_bytes
        rows["quat"] = to_bytes(128 + 128 * part.quats)
        file.write(rows.tobytes())


class _Section(NamedTuple):
    """The header of a section."""

    used: int
    room: int  # number of Gaussians that the section has bytes for
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    scale_range: int
    stored_bytes: int
    full_buckets: int
    partial_buckets: int
    sh_degree: int

    @property
    def extra_bytes(self) -> int:
        """Bytes before the Gaussians."""
        return 4 * self.partial_buckets + self.bucket_bytes * self.buckets


def read_ksplat(path: Path) -> GaussianScene:
    """Read a ``.ksplat`` file: sections of buckets of Gaussians, in one of several precisions."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES:
            raise FileFormatError(
                f"{path}: must start with a header of {_HEADER_BYTES} bytes, found {len(head)}."
            )
        major, minor, most, _, _, count, level, *_, low, high = _HEADER.unpack_from(head)
        if (major, minor) != (0, 1) or level >= len(_NUMBERS):
            raise FileFormatError(
                f"{path}: must be a .ksplat of version 0.1 with compression 0, 1 or 2, found "
                f"version {major}.{minor} and compression {level}."
            )
        if _HEADER_BYTES + most * _SECTION.size > size:
            raise FileFormatError(
                f"{path}: must hold the headers of {most:,} sections, found {size:,} bytes."
            )
        headers = file.read(most * _SECTION.size)
        sections = [_Section(*fields) for fields in _SECTION.iter_unpack(headers)]
        sh_range = (low or _SH_RANGE[0], high or _SH_RANGE[1])
        degree = max((one.sh_degree for one in sections if one.used), default=0)
        parts = []
        for section in sections:
            row = _row_type(level, section.sh_degree, path)
            end = file.tell() + section.extra_bytes + row.itemsize * section.room
            if section.used:
                parts.append(_read_section(file, section, row, degree, sh_range, path))
            file.seek(end)
    found = sum(len(part.means) for part in parts)
    if found != count or not count:
        raise FileFormatError(
            f"{path}: must hold the {count:,} Gaussians of the header, at least 1, found {found:,}."
        )
    return Arrays(*map(np.concatenate, zip(*parts, strict=True))).scene()


def _row_type(level: int, degree: int, path: Path) -> np.dtype[Any]:
    if degree >= len(_COMPONENTS):
        raise FileFormatError(f"{path}: must have an SH degree of at most 2, found {degree}.")
    mean, half, sh = _NUMBERS[level]
    fields = [("mean", mean, 3), ("scale", half, 3), ("quat", half, 4)]
    return np.dtype([*fields, ("rgba", "u1", 4), ("sh", sh, _COMPONENTS[degree])])


def _read_section(
    file: BinaryIO,
    section: _Section,
    row: np.dtype[Any],
    degree: int,
    sh_range: tuple[float, float],
    path: Path,
) -> Arrays:
    left = os.fstat(file.fileno()).st_size - file.tell()
    needed = section.extra_bytes + row.itemsize * section.used
    if section.used > section.room or needed > left:
        raise FileFormatError(
            f"{path}: a section of {section.used:,} Gaussians must take {needed:,} bytes and have "
            f"room for all, found {left:,} bytes and room for {section.room:,}."
        )
    lengths = np.fromfile(file, "<u4", section.partial_buckets).astype(np.int64)
    extra = np.fromfile(file, np.uint8, section.bucket_bytes * section.buckets)
    rows = np.fromfile(file, row, section.used)
    means = rows["mean"].astype(np.float32)
    if rows["mean"].dtype != np.float32:
        bucket = _buckets(section, lengths)
        if section.bucket_bytes < 12 or bucket.max() >= section.buckets:
            raise FileFormatError(
                f"{path}: buckets of a section must hold {section.used:,} Gaussians, found others."
            )
        centers = extra.reshape(section.buckets, -1)[:, :12].copy().view("<f4")
        middle = section.scale_range or _RANGE
        step = np.float32(section.block_size / 2 / middle)
        means = (means - np.float32(middle)) * step + centers[bucket]
    stored = rows["sh"].astype(np.float32)
    if rows["sh"].dtype == np.uint8:
        stored = sh_range[0] + stored / np.float32(255) * np.float32(sh_range[1] - sh_range[0])
    return Arrays(
        means=means,
        quats=unit_quats(rows["quat"].astype(np.float32)),
        log_scales=log_scales_of(rows["scale"].astype(np.float32)),
        logit_opacities=logits_of_bytes(rows["rgba"][:, 3]),
        sh0=sh0_of_colors(rows["rgba"][:, :3].astype(np.float32) / np.float32(255)),
        shN=_rest(stored, degree),
    )


def _buckets(section: _Section, lengths: Int[np.ndarray, "p"]) -> Int[np.ndarray, "n"]:
    """Return the bucket of every Gaussian: full buckets first, then those of given lengths."""
    full = min(section.full_buckets * section.bucket_size, section.used)
    first = np.arange(full) // max(1, section.bucket_size)
    rest = np.searchsorted(np.cumsum(lengths), np.arange(section.used - full), side="right")
    rest[rest == len(lengths)] = section.buckets  # in none; the file is damaged
    return np.concatenate([first, section.full_buckets + rest])


def _rest(stored: Float[np.ndarray, "n c"], degree: int) -> Float[np.ndarray, "n k 3"]:
    """Reorder SH components, stored by band and then by channel; missing bands are 0."""
    rest = np.zeros((len(stored), _COMPONENTS[degree] // 3, 3), np.float32)
    for start, end in pairwise(_COMPONENTS):
        if stored.shape[1] >= end:
            part = stored[:, start:end].reshape(len(stored), 3, -1)
            rest[:, start // 3 : end // 3] = part.transpose(0, 2, 1)
    return rest
