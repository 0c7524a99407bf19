"""The ``meta.json`` of a SOG, version 1 or 2, checked."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from cvtgs.errors import FileFormatError
from cvtgs.io.fields import Fields

_MOST_COUNT = 16383**2
"""Pixels of the largest WebP image."""

SH_BANDS = (1, 2, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta:
    """What the images of a SOG mean.

    Attributes:
        count: Number of Gaussians.
        antialiased: Whether the scene was trained with anti-aliasing.
        means: ``(3, 2)`` least and largest of ``sign(x) log(1 + |x|)`` per axis.
        scales: ``(3, 256)`` what the bytes of the three channels stand for.
        colors: ``(3, 256)`` the same of the constant SH band.
        opacities: ``(256,)`` logits, or None where bytes are opacities.
        palette: ``(256,)`` the same of the view-dependent SH bands; None if there are none.
        palette_count: Entries of the palette; None if the image says it.
        bands: View-dependent SH bands; None if the image says it.
        files: Names of images by purpose.
    """

    count: int
    antialiased: bool
    means: Float[np.ndarray, "3 2"]
    scales: Float[np.ndarray, "3 256"]
    colors: Float[np.ndarray, "3 256"]
    opacities: Float[np.ndarray, "256"] | None
    palette: Float[np.ndarray, "256"] | None
    palette_count: int | None
    bands: int | None
    files: dict[str, str]


def parse_meta(document: Any, where: str) -> Meta:
    """Check a ``meta.json``."""
    root = Fields.of(document, where)
    version = root.whole("version") if "version" in root else 1
    if version not in (1, 2):
        raise root.wrong("version", "1 or 2")
    parts = {
        name: Fields.of(root.values.get(name), f"{where}: {name!r}")
        for name in ("means", "scales", "quats", "sh0", "shN")
        if name != "shN" or "shN" in root
    }
    count = root.whole("count") if version > 1 else _count_of_shape(parts["means"])
    if not 0 < count <= _MOST_COUNT:
        raise FileFormatError(
            f"{where}: a SOG must hold 1 to {_MOST_COUNT:,} Gaussians, found {count:,}."
        )
    rest = parts.get("shN")
    tables = _codebooks(parts) if version > 1 else _ranges(parts)
    return Meta(
        count=count,
        antialiased=_antialiased(root),
        means=np.stack([parts["means"].array("mins", (3,)), parts["means"].array("maxs", (3,))], 1),
        scales=tables["scales"],
        colors=tables["sh0"][:3],
        opacities=tables["sh0"][3] if version == 1 else None,
        palette=tables["shN"][0] if rest else None,
        palette_count=rest.whole("count") if rest and version > 1 else None,
        bands=_bands(rest) if rest and version > 1 else None,
        files=_files(parts),
    )


def _antialiased(root: Fields) -> bool:
    """Read what splat-transform writes, and what the first description of the format has."""
    return root.values.get("model") == "antialiased" or root.values.get("antialias") is True


def _count_of_shape(means: Fields) -> int:
    shape = means.items("shape")
    if not shape or not isinstance(shape[0], int):
        raise means.wrong("shape", "a list that starts with the number of Gaussians")
    return shape[0]


def _bands(rest: Fields) -> int:
    bands = rest.whole("bands")
    if bands not in SH_BANDS:
        raise rest.wrong("bands", "1, 2 or 3")
    return bands


def _codebooks(parts: dict[str, Fields]) -> dict[str, NDArray[np.float64]]:
    """Return what bytes stand for in version 2: all channels share at most 256 numbers."""
    tables = {}
    for name in {"scales", "sh0", "shN"} & parts.keys():
        count = len(parts[name].items("codebook"))
        codes = parts[name].array("codebook", (min(max(count, 1), 256),))
        tables[name] = np.tile(np.pad(codes, (0, 256 - len(codes)), "edge"), (3, 1))
    return tables


def _ranges(parts: dict[str, Fields]) -> dict[str, NDArray[np.float64]]:
    """Return what bytes stand for in version 1: equal steps from a least to a largest number."""
    steps = np.arange(256) / 255
    tables = {}
    for name, channels in (("scales", 3), ("sh0", 4)):
        low, high = (parts[name].array(key, (channels,))[:, None] for key in ("mins", "maxs"))
        tables[name] = low + (high - low) * steps
    if "shN" in parts:
        least, largest = parts["shN"].number("mins"), parts["shN"].number("maxs")
        tables["shN"] = (least + (largest - least) * steps)[None]
    return tables


def _files(parts: dict[str, Fields]) -> dict[str, str]:
    purposes = {
        "means": ("means_l", "means_u"),
        "scales": ("scales",),
        "quats": ("quats",),
        "sh0": ("sh0",),
        "shN": ("shN_centroids", "shN_labels"),
    }
    files: dict[str, str] = {}
    for name, part in parts.items():
        names = part.items("files")
        if len(names) != len(purposes[name]) or not all(isinstance(one, str) for one in names):
            raise part.wrong("files", f"{len(purposes[name])} file names")
        files |= dict(zip(purposes[name], names, strict=True))
    return files
