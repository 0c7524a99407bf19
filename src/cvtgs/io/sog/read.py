"""Read a SOG."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from cvtgs.errors import FileFormatError
from cvtgs.io.arrays import Arrays, logits_of_bytes, scene_of
from cvtgs.io.files import parse_json
from cvtgs.io.smallest_three import restore_largest
from cvtgs.io.sog.container import META, Reader, open_container, read_meta
from cvtgs.io.sog.meta import Meta, parse_meta
from cvtgs.io.webp import decode_webp
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene

PALETTE_COLUMNS = 64
"""Entries of the SH palette in a row of its image."""

_FIRST_TAG = 252
_LABELS = 1 << 16
_SPARE_PIXELS = 1 << 16


def read_sog(path: Path) -> GaussianScene:
    """Read a SOG, version 1 or 2, bundled or not.

    Args:
        path: The ``.sog`` file, or the ``meta.json`` that lies beside its images.

    Returns:
        The scene.

    Raises:
        InputNotFoundError: There is no such file, or an image is missing.
        InputError: A file cannot be opened or read.
        FileFormatError: It is not a SOG, or damaged.
    """
    with open_container(path) as read:
        where = str(path) if path.name == META else f"{path}: {META}"
        meta = parse_meta(parse_json(read_meta(read), where), where)
        images = _Images(read, meta, path)
        arrays = Arrays(
            means=_means(images, meta),
            quats=_quats(images.rows("quats")),
            log_scales=_looked_up(meta.scales, images.rows("scales")),
            logit_opacities=_logits(images.rows("sh0")[:, 3], meta),
            sh0=_looked_up(meta.colors, images.rows("sh0")),
            shN=_rest(images, meta, path),
        )
    return scene_of(arrays, antialiased=meta.antialiased)


class _Images:
    """The images of a SOG; none may have many more pixels than there are Gaussians."""

    def __init__(self, read: Reader, meta: Meta, path: Path) -> None:
        self._read = read
        self._meta = meta
        self._path = path
        self._last: tuple[str, UInt8[np.ndarray, "n 4"]] | None = None

    def pixels(self, purpose: str, most: int) -> UInt8[np.ndarray, "h w 4"]:
        """Decode an image."""
        name = self._meta.files[purpose]
        content = self._read(name, 5 * most + _SPARE_PIXELS)
        return decode_webp(content, f"{self._path}: {name}", most_pixels=most)

    def rows(self, purpose: str) -> UInt8[np.ndarray, "n 4"]:
        """Return the pixel of every Gaussian."""
        if self._last is None or self._last[0] != purpose:
            count = self._meta.count
            pixels = self.pixels(purpose, 4 * count + _SPARE_PIXELS).reshape(-1, 4)
            if len(pixels) < count:
                raise FileFormatError(
                    f"{self._path}: {self._meta.files[purpose]} must have a pixel for each of "
                    f"{count:,} Gaussians, found {len(pixels):,}."
                )
            self._last = purpose, pixels[:count]
        return self._last[1]


def _means(images: _Images, meta: Meta) -> Float[np.ndarray, "n 3"]:
    """Read 16 bits per axis, two bytes in two images, of ``sign(x) log(1 + |x|)``."""
    low = images.rows("means_l")[:, :3].astype(np.uint16)
    whole = low | images.rows("means_u")[:, :3].astype(np.uint16) << np.uint16(8)
    least, largest = meta.means.T
    squeezed = least + (largest - least) * (whole / 65535)
    means: Float[np.ndarray, "n 3"] = np.copysign(np.expm1(np.abs(squeezed)), squeezed)
    return means.astype(np.float32)


def _quats(stored: UInt8[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Decode three components; the last byte says which is missing. Others mean no rotation."""
    tags = stored[:, 3].astype(np.int64) - _FIRST_TAG
    others = (stored[:, :3].astype(np.float32) / np.float32(127.5) - 1) * np.sqrt(np.float32(0.5))
    quats = restore_largest(np.maximum(tags, 0), others)
    quats[tags < 0] = (1, 0, 0, 0)
    return quats


def _logits(stored: UInt8[np.ndarray, "n"], meta: Meta) -> Float[np.ndarray, "n"]:
    if meta.opacities is None:
        return logits_of_bytes(stored)
    logits: Float[np.ndarray, n] = meta.opacities.astype(np.float32)[stored]
    return logits


def _looked_up(
    table: Float[np.ndarray, "3 256"], stored: UInt8[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 3"]:
    values: Float[np.ndarray, "n 3"] = table.astype(np.float32)[np.arange(3), stored[:, :3]]
    return values


def _rest(images: _Images, meta: Meta, path: Path) -> Float[np.ndarray, "n k 3"]:
    """Look labels up in the palette, and its bytes in the codebook; a label beyond it is 0."""
    if meta.palette is None:
        return np.empty((meta.count, 0, 3), np.float32)
    stored = images.rows("shN_labels")[:, :2].astype(np.uint16)
    labels = stored[:, 0] | stored[:, 1] << np.uint16(8)
    pixels = images.pixels("shN_centroids", _LABELS * REST_COUNTS[-1])
    k = pixels.shape[1] // PALETTE_COLUMNS
    allowed = REST_COUNTS[1:] if meta.bands is None else (REST_COUNTS[meta.bands],)
    if k not in allowed or pixels.shape[1] != PALETTE_COLUMNS * k:
        wanted = " or ".join(str(PALETTE_COLUMNS * count) for count in allowed)
        raise FileFormatError(
            f"{path}: {meta.files['shN_centroids']} must be {wanted} pixels wide, "
            f"found {pixels.shape[1]}."
        )
    entries = meta.palette.astype(np.float32)[pixels[:, :, :3]].reshape(-1, k, 3)
    there = len(entries) if meta.palette_count is None else min(meta.palette_count, len(entries))
    known = labels < there
    rest: Float[np.ndarray, "n k 3"] = entries[np.where(known, labels, 0)]
    rest[~known] = 0
    return rest
