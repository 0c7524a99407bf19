"""Write a SOG: its codebooks, its SH palette and its images."""

import io
import json
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.devices import HOST, in_threads
from cvtgs.errors import InvalidSceneError
from cvtgs.io.arrays import HALF_RANGE, Arrays, drop_largest, morton_rows, to_bytes
from cvtgs.io.sog.read import META, PALETTE_COLUMNS, QUAT_TAG
from cvtgs.math.spherical_harmonics import degree_of
from cvtgs.scene import GaussianScene

_TIME = (1980, 1, 1, 0, 0, 0)  # fixed, so that the same scene gives the same bytes
_CODES = 256
_PALETTE = 1 << 16
_ITERATIONS = 30
_KNOTS = 4096
_WIDEST_GAP = 1 / 64  # most of the first codes between two knots, such as a value and an outlier
_LARGEST_SHIFTED = 1e15  # from the median; beyond it, values are not told apart in a palette
_RELATIVE_ROUNDING = 1e-5  # smaller variances, relative to mean squares, may be rounding errors

Images = dict[str, UInt8[np.ndarray, "h w 4"]]


class EncodedSog(NamedTuple):
    """The files of a SOG before they are written: ``meta.json``, and images by file stem."""

    meta: dict[str, Any]
    images: Images

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Yield names and contents, the images first."""
        yield from self.encoded_images()
        yield META, json.dumps(self.meta).encode()

    def encoded_images(self) -> Iterator[tuple[str, bytes]]:
        """Yield names and contents of the images, a few of which are encoded at a time."""
        contents = in_threads(encode_webp, self.images.values(), HOST)
        yield from zip((f"{name}.webp" for name in self.images), contents, strict=True)


def write_sog(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a bundled SOG of version 2."""
    arrays = Arrays.of(scene)
    encoded = _encoded(arrays, morton_rows(arrays.means), scene)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(META, _TIME), json.dumps(encoded.meta))
        for name, content in encoded.encoded_images():
            archive.writestr(zipfile.ZipInfo(name, _TIME), content)


def encode_sog(scene: GaussianScene) -> EncodedSog:
    """Encode an unbundled SOG of version 2 whose rows are in the order of the scene.

    Args:
        scene: The scene, on any device; a SOG must be able to hold all its rows.

    Returns:
        The encoded files.

    Raises:
        InvalidSceneError: A Gaussian of the scene is not finite.
    """
    arrays = Arrays.of(scene)
    if len(arrays.means) < len(scene):
        raise InvalidSceneError(
            f"every Gaussian must be finite to be written in the order of the scene, found "
            f"{len(scene) - len(arrays.means):,} of {len(scene):,} that are not."
        )
    return _encoded(arrays, np.arange(len(scene)), scene)


def _encoded(arrays: Arrays, order: Int[np.ndarray, "n"], scene: GaussianScene) -> EncodedSog:
    scales = codebook(arrays.log_scales[order])
    colors = codebook(arrays.sh0[order])
    opacities = arrays.opacity_bytes[order]
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "cvtgs"}, "count": len(order)}
    if scene.antialiased:
        meta |= {"model": "antialiased", "antialias": True}
    elif scene.has_two_scales:
        meta["model"] = "2dgs"
    largest, others = drop_largest(arrays.quats[order])
    tags = QUAT_TAG + largest
    images, ranges = _means(arrays.means[order])
    images |= {
        "scales": _image(scales.labels),
        "quats": _image(to_bytes(np.float32(127.5) * (others / HALF_RANGE + 1)), to_bytes(tags)),
        "sh0": _image(colors.labels, opacities),
    }
    meta |= {
        "means": {**ranges, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _numbers(scales.codes), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _numbers(colors.codes), "files": ["sh0.webp"]},
    }
    if arrays.shN.shape[1]:
        more, meta["shN"] = _rest(arrays.shN[order])
        images |= more
    return EncodedSog(meta, images)


def _means(means: Float[np.ndarray, "n 3"]) -> tuple[Images, dict[str, list[float]]]:
    squeezed = np.copysign(np.log1p(np.abs(means.astype(np.float64))), means)
    low, high = squeezed.min(axis=0), squeezed.max(axis=0)
    width = np.where(high > low, high - low, 1)
    steps = np.rint(65535 * (squeezed - low) / width).astype(np.uint16)
    images = {
        "means_l": _image((steps & np.uint16(255)).astype(np.uint8)),
        "means_u": _image((steps >> np.uint16(8)).astype(np.uint8)),
    }
    return images, {"mins": low.tolist(), "maxs": high.tolist()}


def _rest(rest: Float[np.ndarray, "n k 3"]) -> tuple[Images, dict[str, Any]]:
    n, k, _ = rest.shape
    entries, labels = palette(rest.reshape(n, 3 * k))
    codes = codebook(entries)
    lines = -(-len(entries) // PALETTE_COLUMNS)
    centroids = np.full((lines * PALETTE_COLUMNS * k, 4), 255, np.uint8)
    centroids[: len(entries) * k, :3] = codes.labels.reshape(-1, 3)
    bytes_of_labels = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    images = {
        "shN_centroids": centroids.reshape(lines, PALETTE_COLUMNS * k, 4),
        "shN_labels": _image(bytes_of_labels.astype(np.uint8)),
    }
    meta = {
        "count": len(entries),
        "bands": degree_of(k),
        "codebook": _numbers(codes.codes),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    return images, meta


def _numbers(codes: Float[np.ndarray, "256"]) -> list[float]:
    """Return float32 numbers with as few digits as distinguish them."""
    return [float(str(code)) for code in codes]


def _image(
    colors: UInt8[np.ndarray, "n 3"], opacities: UInt8[np.ndarray, "n"] | None = None
) -> UInt8[np.ndarray, "h w 4"]:
    """Lay rows out as pixels, line by line; sides are multiples of 4."""
    count = len(colors)
    width = 4 * int(np.ceil(np.sqrt(count) / 4))
    height = 4 * int(np.ceil(count / width / 4))
    pixels: NDArray[np.uint8] = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[:count, :3] = colors
    if opacities is not None:
        pixels[:count, 3] = opacities
    return pixels.reshape(height, width, 4)


def encode_webp(numbers: UInt8[np.ndarray, "h w 4"]) -> bytes:
    """Write numbers to a lossless image, including those of pixels with opacity 0."""
    from PIL import Image  # noqa: PLC0415

    file = io.BytesIO()
    Image.fromarray(numbers).save(file, format="webp", lossless=True, exact=True, quality=80)
    return file.getvalue()


class Codebook(NamedTuple):
    """Codes in ascending order, and the index of the code that replaces each value."""

    codes: Float[np.ndarray, "256"]
    labels: UInt8[np.ndarray, "*n"]


def codebook(values: Float[np.ndarray, "*n"]) -> Codebook:
    """Find 256 codes to round values to, by one-dimensional k-means (Lloyd 1982)."""
    ordered = np.sort(values, axis=None).astype(np.float64)
    codes = _first_codes(ordered)
    for _ in range(_ITERATIONS):
        inner = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2)
        starts = np.concatenate([[0], inner])
        counts = np.diff(starts, append=len(ordered))
        # not differences of running sums, in which an outlier would absorb the others
        sums = np.add.reduceat(ordered, np.minimum(starts, len(ordered) - 1))
        codes = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), codes))
    codes = codes.astype(np.float32)
    labels = np.searchsorted(codes[1:] / 2 + codes[:-1] / 2, values).astype(np.uint8)
    return Codebook(codes, labels)


def _first_codes(ordered: Float[np.ndarray, "n"]) -> Float[np.ndarray, "256"]:
    """Return codes as dense as the cube root of the values' density (Panter and Dite 1951)."""
    different = np.flatnonzero(np.diff(ordered, prepend=-np.inf))
    if len(different) <= _CODES:
        few: Float[np.ndarray, 256] = ordered[different]
        return np.pad(few, (0, _CODES - len(few)), "edge")
    count = min(len(ordered), _KNOTS)
    knots = ordered[np.linspace(0, len(ordered) - 1, count).round().astype(np.int64)]
    steps = np.diff(knots) ** (2 / 3)
    usual = float(np.sort(steps)[: -max(1, len(steps) // 100)].sum())
    if usual > 0:
        steps = np.minimum(steps, _WIDEST_GAP * usual)
    passed = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(np.interp(np.linspace(0, passed[-1], _CODES), passed, knots))


class Palette(NamedTuple):
    """At most 65,536 rows, and the index of the entry that replaces each of the given rows."""

    entries: Float[np.ndarray, "p d"]
    labels: Int[np.ndarray, "n"]


def palette_size(count: int) -> int:
    """Return the palette size: as in splat-transform, at least half of the rows."""
    return min(_PALETTE, 1 << max(10, count.bit_length() - 1))


def palette(rows: Float[np.ndarray, "n d"], most: int | None = None) -> Palette:
    """Find the means of groups of rows that replace many rows; memory is three copies of the rows.

    Groups of large errors are split (after Wu 1991, but many at once), far faster than k-means.
    """
    most = palette_size(len(rows)) if most is None else most
    if len(rows) <= most:
        return Palette(rows, np.arange(len(rows)))
    some = rows[:: 1 + len(rows) // _KNOTS]
    # Centred, so that squares lose no digits. The mean of two large float32 values can overflow.
    middle = np.median(some.astype(np.float64), axis=0).astype(rows.dtype)
    with np.errstate(over="ignore"):
        away = np.clip(rows - middle, -_LARGEST_SHIFTED, _LARGEST_SHIFTED)
    shifted = torch.from_numpy(away)
    squares = shifted.square()
    order = torch.arange(len(rows), device="cpu")
    starts = torch.zeros(1, dtype=torch.int64, device="cpu")
    before = 0
    while before < len(starts) < most:
        before = len(starts)
        order, starts = _split(shifted, squares, order, starts, most=most)
    labels = np.empty(len(rows), np.int64)
    labels[order.numpy()] = _groups(starts, len(rows)).numpy()
    return Palette(_group_means(shifted, order, starts).numpy() + middle, labels)


def _split(
    rows: Tensor, squares: Tensor, order: Tensor, starts: Tensor, *, most: int
) -> tuple[Tensor, Tensor]:
    """Split the half of the groups with the largest errors, each at the mean of a column."""
    means, mean_squares = _group_means(rows, order, starts), _group_means(squares, order, starts)
    variances = mean_squares - means.square()
    variances = torch.where(variances > _RELATIVE_ROUNDING * mean_squares, variances, 0.0)
    errors = variances.sum(dim=1) * torch.diff(starts, append=starts.new_tensor([len(rows)]))
    count = min(most - len(starts), max(1, len(starts) // 2), int((errors > 0).sum()))
    chosen = torch.zeros(len(starts), dtype=torch.bool, device="cpu")
    chosen[torch.sort(errors, descending=True, stable=True).indices[:count]] = True
    column, groups = variances.argmax(dim=1), _groups(starts, len(rows))
    above = rows[order, column[groups]] > means.gather(1, column[:, None])[groups, 0]
    step = torch.sort(2 * groups + (above & chosen[groups]), stable=True)
    new_starts = torch.nn.functional.pad(step.values.diff(), (1, 0), value=1).nonzero()[:, 0]
    return order[step.indices], new_starts


def _groups(starts: Tensor, count: int) -> Tensor:
    """Return the group number of every position."""
    ends = torch.cat([starts[1:], starts.new_tensor([count])])
    return torch.repeat_interleave(ends - starts)


def _group_means(rows: Tensor, order: Tensor, starts: Tensor) -> Tensor:
    """Average the rows of every group, without copying them in group order."""
    return torch.nn.functional.embedding_bag(order, rows, starts, mode="mean")
