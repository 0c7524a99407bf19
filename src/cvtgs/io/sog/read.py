"""Read a SOG, version 1 or 2: its ``meta.json`` and the values in its images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import AfterValidator, Field

from cvtgs.errors import FileFormatError
from cvtgs.io.arrays import HALF_RANGE, Arrays, logits_of_bytes, restore_largest, scene_of
from cvtgs.io.files import (
    Document,
    Number,
    Text,
    Vector,
    Whole,
    check_expansion,
    parse_json,
    validated,
)
from cvtgs.io.sog.container import (
    META,
    MOST_META_BYTES,
    PALETTE_COLUMNS,
    QUAT_TAG,
    Reader,
    decode_webp,
    is_index,
    open_container,
    stored_bytes,
)
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene
from cvtgs.tags import TWO_SCALES

_MOST_COUNT = 16383**2  # pixels of the largest WebP image

_LABELS = 1 << 16
_SPARE_PIXELS = 1 << 16


class _OneImage(Document):
    files: tuple[Text] = Field(description="1 file name")


class _TwoImages(Document):
    files: tuple[Text, Text] = Field(description="2 file names")


class _Means(_TwoImages):
    """Minimum and maximum of ``sign(x) log(1 + |x|)`` per axis."""

    mins: Vector
    maxs: Vector


class _Root(Document):
    version: Annotated[Whole, Field(ge=1, le=2, description="1 or 2")] | None = None
    model: Any = None  # written by splat-transform
    antialias: Any = None  # from the first description of the format


def _lacks_at_most_the_first(codes: list[float | None]) -> list[float | None]:
    if None in codes[1:] or (codes[0] is None and len(codes) < 256):
        raise ValueError
    return codes


_Codes = Annotated[
    list[Number | None],
    Field(min_length=1, max_length=256, description="1 to 256 finite numbers"),
    AfterValidator(_lacks_at_most_the_first),
]


class _Codebook(_OneImage):
    codebook: _Codes


class _Palette(_TwoImages):
    count: Whole
    bands: Annotated[Whole, Field(ge=1, le=3, description="1, 2 or 3")]
    codebook: _Codes


class _Version2(_Root):
    """Bytes index a codebook of at most 256 numbers, shared by all channels."""

    count: Whole
    means: _Means
    scales: _Codebook
    quats: _OneImage
    sh0: _Codebook
    shN: _Palette | None = None  # noqa: N815 (the name in the file)


class _ShapedMeans(_Means):
    shape: list[Whole] = Field(
        min_length=1, description="a list that starts with the number of Gaussians"
    )


class _ThreeRanges(_OneImage):
    mins: Vector
    maxs: Vector


class _FourRanges(_OneImage):
    mins: tuple[Number, Number, Number, Number] = Field(description="4 finite numbers")
    maxs: tuple[Number, Number, Number, Number] = Field(description="4 finite numbers")


class _PaletteRange(_TwoImages):
    mins: Number
    maxs: Number


class _Version1(_Root):
    """Bytes are equal steps from a minimum to a maximum per channel."""

    means: _ShapedMeans
    scales: _ThreeRanges
    quats: _OneImage
    sh0: _FourRanges
    shN: _PaletteRange | None = None  # noqa: N815 (the name in the file)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Meta:
    """A checked ``meta.json``; tables give the value of each byte of a channel."""

    document: _Version1 | _Version2
    count: int
    scales: Float[np.ndarray, "3 256"]
    colors: Float[np.ndarray, "3 256"]
    opacities: Float[np.ndarray, "256"] | None = None  # of logits; None where bytes are opacities
    palette: Float[np.ndarray, "256"] | None = None


def read_sog(path: Path, *, trust_sizes: bool = False) -> GaussianScene:
    """Read a SOG, version 1 or 2, bundled or not.

    Args:
        path: The ``.sog`` file, or the ``meta.json`` that lies beside its images.
        trust_sizes: Whether the images may unpack to any size.

    Returns:
        The scene.

    Raises:
        InputNotFoundError: The file does not exist, or an image is missing.
        InputError: A file cannot be opened or read.
        FileFormatError: It is not a SOG, or damaged.
    """
    # A damaged file may hold numbers beyond float32.
    with open_container(path) as read, np.errstate(all="ignore"):
        where = str(path) if is_index(path) else f"{path}: {META}"
        meta = _read_meta(parse_json(read(META, MOST_META_BYTES), where), where)
        document = meta.document
        if not trust_sizes:
            _check_expansion(meta, path)
        images = _Images(read=read, count=meta.count, path=path)
        means = _means(images, document.means)
        quats = _quats(images.rows(document.quats.files[0]))
        log_scales = _decoded(meta.scales, images.rows(document.scales.files[0]))
        colors = images.rows(document.sh0.files[0])
        opacities = colors[:, 3]
        arrays = Arrays(
            means=means,
            quats=quats,
            log_scales=log_scales,
            logit_opacities=logits_of_bytes(opacities)
            if meta.opacities is None
            else meta.opacities.astype(np.float32)[opacities],
            sh0=_decoded(meta.colors, colors),
            shN=_rest(images, meta),
        )
    antialiased = document.model == "antialiased" or document.antialias is True
    scene = scene_of(arrays, antialiased=antialiased)
    if document.model == "2dgs":
        return replace(scene, comments=(*scene.comments, TWO_SCALES.text))
    return scene


def _check_expansion(meta: _Meta, path: Path) -> None:
    document, rest = meta.document, meta.document.shN
    parts = (document.means, document.scales, document.quats, document.sh0, rest)
    names = {name for part in parts if part is not None for name in part.files}
    degree = 0 if rest is None else rest.bands if isinstance(rest, _Palette) else 3
    stored = stored_bytes(path, sorted(names))
    check_expansion(path, count=meta.count, sh_degree=degree, stored=stored)


def _read_meta(content: Any, where: str) -> _Meta:
    is_first = (validated(_Root, content, where).version or 1) == 1
    meta = (_meta_of_version_1 if is_first else _meta_of_version_2)(content, where)
    if not 0 < meta.count <= _MOST_COUNT:
        raise FileFormatError(
            f"{where}: a SOG must hold 1 to {_MOST_COUNT:,} Gaussians, found {meta.count:,}."
        )
    return meta


def _meta_of_version_1(content: Any, where: str) -> _Meta:
    document = validated(_Version1, content, where)

    def tables(mins: Sequence[float], maxs: Sequence[float]) -> Float[np.ndarray, "k 256"]:
        low, high = np.array(mins)[:, None], np.array(maxs)[:, None]
        values: Float[np.ndarray, "k 256"] = low + (high - low) * (np.arange(256) / 255)
        return values

    sh0, rest = tables(document.sh0.mins, document.sh0.maxs), document.shN
    return _Meta(
        document=document,
        count=document.means.shape[0],
        scales=tables(document.scales.mins, document.scales.maxs),
        colors=sh0[:3],
        opacities=sh0[3],
        palette=None if rest is None else tables([rest.mins], [rest.maxs])[0],
    )


def _meta_of_version_2(content: Any, where: str) -> _Meta:
    document = validated(_Version2, content, where)

    def table(codes: list[float | None]) -> Float[np.ndarray, "256"]:
        values = np.array(codes, np.float64)
        if codes[0] is None:  # some writers left it out; PlayCanvas' engine extrapolates it
            values[0] = values[1] + (values[1] - values[-1]) / 255
        return np.pad(values, (0, 256 - len(values)), "edge")

    return _Meta(
        document=document,
        count=document.count,
        scales=np.tile(table(document.scales.codebook), (3, 1)),
        colors=np.tile(table(document.sh0.codebook), (3, 1)),
        palette=None if document.shN is None else table(document.shN.codebook),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Images:
    """The images of a SOG; none may have many more pixels than there are Gaussians."""

    read: Reader
    count: int
    path: Path

    def pixels(self, name: str, most: int) -> UInt8[np.ndarray, "h w 4"]:
        """Decode an image."""
        content = self.read(name, 5 * most + _SPARE_PIXELS)
        return decode_webp(content, f"{self.path}: {name}", most_pixels=most)

    def rows(self, name: str) -> UInt8[np.ndarray, "n 4"]:
        """Return the pixel of every Gaussian."""
        pixels = self.pixels(name, 4 * self.count + _SPARE_PIXELS).reshape(-1, 4)
        if len(pixels) < self.count:
            raise FileFormatError(
                f"{self.path}: {name} must have a pixel for each of {self.count:,} Gaussians, "
                f"found {len(pixels):,}."
            )
        return pixels[: self.count]


def _means(images: _Images, part: _Means) -> Float[np.ndarray, "n 3"]:
    """Decode 16 bits per axis, with the low and high bytes in two images."""
    low, high = (images.rows(name)[:, :3].astype(np.uint16) for name in part.files)
    whole = low | high << np.uint16(8)
    least, largest = np.array(part.mins), np.array(part.maxs)
    squeezed = least + (largest - least) * (whole / 65535)
    means: Float[np.ndarray, "n 3"] = np.copysign(np.expm1(np.abs(squeezed)), squeezed)
    return means.astype(np.float32)


def _quats(stored: UInt8[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Decode three components; a last byte below the tags stands for the identity."""
    tags = stored[:, 3].astype(np.int64) - QUAT_TAG
    others = (stored[:, :3].astype(np.float32) / np.float32(127.5) - 1) * HALF_RANGE
    quats = restore_largest(np.maximum(tags, 0), others)
    quats[tags < 0] = (1, 0, 0, 0)
    return quats


def _decoded(
    table: Float[np.ndarray, "3 256"], stored: UInt8[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 3"]:
    values: Float[np.ndarray, "n 3"] = table.astype(np.float32)[np.arange(3), stored[:, :3]]
    return values


def _rest(images: _Images, meta: _Meta) -> Float[np.ndarray, "n k 3"]:
    """Look labels up in the palette, and its bytes in the codebook; unknown labels give 0."""
    part = meta.document.shN
    if part is None or meta.palette is None:
        return np.empty((meta.count, 0, 3), np.float32)
    centroids, labels = part.files
    stored = images.rows(labels)[:, :2].astype(np.uint16)
    numbers = stored[:, 0] | stored[:, 1] << np.uint16(8)
    pixels = images.pixels(centroids, _LABELS * REST_COUNTS[-1])
    k = pixels.shape[1] // PALETTE_COLUMNS
    allowed = (REST_COUNTS[part.bands],) if isinstance(part, _Palette) else REST_COUNTS[1:]
    if k not in allowed or pixels.shape[1] != PALETTE_COLUMNS * k:
        wanted = " or ".join(str(PALETTE_COLUMNS * count) for count in allowed)
        raise FileFormatError(
            f"{images.path}: {centroids} must be {wanted} pixels wide, found {pixels.shape[1]}."
        )
    entries = meta.palette.astype(np.float32)[pixels[:, :, :3]].reshape(-1, k, 3)
    count = min(part.count, len(entries)) if isinstance(part, _Palette) else len(entries)
    known = numbers < count
    rest: Float[np.ndarray, "n k 3"] = entries[np.where(known, numbers, 0)]
    rest[~known] = 0
    return rest
