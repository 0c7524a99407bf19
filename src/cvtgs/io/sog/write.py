"""Write a SOG."""

import json
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from cvtgs.errors import InvalidSceneError
from cvtgs.io.arrays import (
    HALF_RANGE,
    Arrays,
    arrays_of,
    drop_largest,
    morton_rows,
    opacity_bytes,
    to_bytes,
)
from cvtgs.io.sog.codebook import codebook, palette
from cvtgs.io.sog.container import META, PALETTE_COLUMNS, encode_webp
from cvtgs.math.spherical_harmonics import degree_of
from cvtgs.scene import GaussianScene

_TIME = (1980, 1, 1, 0, 0, 0)  # the same scene gives the same bytes
_QUAT_TAG = 252

Images = dict[str, UInt8[np.ndarray, "h w 4"]]


class EncodedSog(NamedTuple):
    """The files of a SOG before they are written: ``meta.json`` and images by their stems."""

    meta: dict[str, Any]
    images: Images

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Return names and contents, the images first; one is encoded at a time."""
        for name, pixels in self.images.items():
            yield f"{name}.webp", encode_webp(pixels)
        yield META, json.dumps(self.meta).encode()


def write_sog(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a bundled SOG of version 2."""
    arrays = arrays_of(scene)
    encoded = _encoded(arrays, morton_rows(arrays.means), antialiased=scene.antialiased)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(META, _TIME), json.dumps(encoded.meta))
        for name, pixels in encoded.images.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _TIME), encode_webp(pixels))


def encode_sog(scene: GaussianScene) -> EncodedSog:
    """Encode an unbundled SOG of version 2 whose rows are in the order of the scene.

    Args:
        scene: The scene, on any device, of rows that a SOG can hold.

    Returns:
        What to write.

    Raises:
        InvalidSceneError: A Gaussian of the scene is not finite.
    """
    arrays = arrays_of(scene)
    if len(arrays.means) < len(scene):
        raise InvalidSceneError(
            f"every Gaussian must be finite to be written in the order of the scene, found "
            f"{len(scene) - len(arrays.means):,} of {len(scene):,} that are not."
        )
    return _encoded(arrays, np.arange(len(scene)), antialiased=scene.antialiased)


def _encoded(arrays: Arrays, order: Int[np.ndarray, "n"], *, antialiased: bool) -> EncodedSog:
    scales = codebook(arrays.log_scales[order])
    colors = codebook(arrays.sh0[order])
    opacities = opacity_bytes(arrays.logit_opacities)[order]
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "cvtgs"}, "count": len(order)}
    if antialiased:
        meta |= {"model": "antialiased", "antialias": True}
    images, ranges = _means(arrays.means[order])
    images |= {
        "scales": _image(scales.labels),
        "quats": _image(*_quats(arrays.quats[order])),
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


def _quats(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[UInt8[np.ndarray, "n 3"], UInt8[np.ndarray, "n"]]:
    largest, others = drop_largest(quats)
    return to_bytes(np.float32(127.5) * (others / HALF_RANGE + 1)), to_bytes(_QUAT_TAG + largest)


def _rest(rest: Float[np.ndarray, "n k 3"]) -> tuple[Images, dict[str, Any]]:
    n, k, _ = rest.shape
    entries, labels = palette(rest.reshape(n, 3 * k))
    codes = codebook(entries)
    lines = -(-len(entries) // PALETTE_COLUMNS)
    centroids = np.full((lines * PALETTE_COLUMNS * k, 4), 255, np.uint8)
    centroids[: len(entries) * k, :3] = codes.labels.reshape(-1, 3)
    images = {
        "shN_centroids": centroids.reshape(lines, PALETTE_COLUMNS * k, 4),
        "shN_labels": _image(_two_bytes(labels)),
    }
    meta = {
        "count": len(entries),
        "bands": degree_of(k),
        "codebook": _numbers(codes.codes),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    return images, meta


def _numbers(codes: Float[np.ndarray, "256"]) -> list[float]:
    """Return numbers of float32 with no more digits than tell them apart."""
    return [float(str(code)) for code in codes]


def _two_bytes(labels: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    return np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)


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
