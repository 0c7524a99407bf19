"""Read a SOG, version 1 or 2: ``meta.json`` and the values in images, in a zip or a folder."""

import io
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import AfterValidator, Field

from cvtgs.errors import FileFormatError, is_out_of_memory
from cvtgs.io.arrays import HALF_RANGE, Arrays, logits_of_bytes, restore_largest
from cvtgs.io.files import (
    LONGEST_NAME,
    Document,
    FourNumbers,
    Number,
    Text,
    Vector,
    Whole,
    check_expansion,
    is_file,
    is_within,
    open_input,
    parse_json,
    validated,
)
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from cvtgs.text import shown

META = "meta.json"
QUAT_TAG = 252  # the last byte of a rotation is this plus the number of its omitted component
PALETTE_COLUMNS = 64  # entries of the SH palette per row of its image
_MOST_META_BYTES = 1 << 20  # real ones have about ten thousand bytes
_PNG = b"\x89PNG\r\n\x1a\n"
_MOST_COUNT = 16383**2  # pixels of the largest WebP image
_LABELS = 1 << 16
_SPARE_PIXELS = 1 << 16

_Reader = Callable[[str, int], bytes]  # of a file by its name, with the most bytes it may have


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


class _Tables(NamedTuple):
    """The value of each byte of a channel."""

    scales: Float[np.ndarray, "3 256"]
    colors: Float[np.ndarray, "3 256"]
    opacities: Float[np.ndarray, "256"] | None = None  # of logits; None where bytes are opacities
    rest: Float[np.ndarray, "256"] | None = None


class _Version2(_Root):
    """Bytes index a codebook of at most 256 numbers, shared by all channels."""

    count: Whole
    means: _Means
    scales: _Codebook
    quats: _OneImage
    sh0: _Codebook
    shN: _Palette | None = None  # noqa: N815 (the name in the file)

    def tables(self) -> _Tables:
        scales, colors = (_table(part.codebook) for part in (self.scales, self.sh0))
        rest = None if self.shN is None else _table(self.shN.codebook)
        return _Tables(np.tile(scales, (3, 1)), np.tile(colors, (3, 1)), rest=rest)


def _table(codes: list[float | None]) -> Float[np.ndarray, "256"]:
    values = np.array(codes, np.float64)
    if codes[0] is None:  # some writers left it out; PlayCanvas' engine extrapolates it
        values[0] = values[1] + (values[1] - values[-1]) / 255
    return np.pad(values, (0, 256 - len(values)), "edge").astype(np.float32)


class _ShapedMeans(_Means):
    shape: list[Whole] = Field(
        min_length=1, description="a list that starts with the number of Gaussians"
    )


class _ThreeRanges(_OneImage):
    mins: Vector
    maxs: Vector


class _FourRanges(_OneImage):
    mins: FourNumbers
    maxs: FourNumbers


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

    @property
    def count(self) -> int:
        return self.means.shape[0]

    def tables(self) -> _Tables:
        scales, sh0 = (_steps(part.mins, part.maxs) for part in (self.scales, self.sh0))
        rest = None if self.shN is None else _steps([self.shN.mins], [self.shN.maxs])[0]
        return _Tables(scales, sh0[:3], sh0[3], rest)


def _steps(mins: Sequence[float], maxs: Sequence[float]) -> Float[np.ndarray, "k 256"]:
    low, high = np.array(mins)[:, None], np.array(maxs)[:, None]
    return np.asarray(low + (high - low) * (np.arange(256) / 255), np.float32)


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
    is_index = path.suffix.lower() == ".json"
    where = str(path) if is_index else f"{path}: {META}"
    # A damaged file may hold numbers beyond float32.
    with _opened(path, is_index=is_index) as read, np.errstate(all="ignore"):
        meta = _read_meta(parse_json(read(META, _MOST_META_BYTES), where), where)
        if not trust_sizes:
            _check_expansion(meta, path, is_index=is_index)
        tables, images = meta.tables(), _Images(read=read, count=meta.count, path=path)
        means = _means(images, meta.means)
        quats = _quats(images.rows(meta.quats.files[0]))
        log_scales = _decoded(tables.scales, images.rows(meta.scales.files[0]))
        colors = images.rows(meta.sh0.files[0])
        opacities = colors[:, 3]
        arrays = Arrays(
            means=means,
            quats=quats,
            log_scales=log_scales,
            logit_opacities=logits_of_bytes(opacities)
            if tables.opacities is None
            else tables.opacities[opacities],
            sh0=_decoded(tables.colors, colors),
            shN=_rest(images, meta.shN, tables.rest),
        )
    is_smooth = meta.model == "antialiased" or meta.antialias is True
    comments = [ANTIALIASED.text] if is_smooth else []
    comments += [TWO_SCALES.text] if meta.model == "2dgs" else []
    return arrays.scene(comments=comments)


def _read_meta(content: Any, where: str) -> _Version1 | _Version2:
    is_second = validated(_Root, content, where).version == 2
    model: type[_Version1 | _Version2] = _Version2 if is_second else _Version1
    meta = validated(model, content, where)
    if not 0 < meta.count <= _MOST_COUNT:
        raise FileFormatError(
            f"{where}: must state 1 to {_MOST_COUNT:,} Gaussians, found {meta.count:,}."
        )
    return meta


def _check_expansion(meta: _Version1 | _Version2, path: Path, *, is_index: bool) -> None:
    rest = meta.shN
    parts = (meta.means, meta.scales, meta.quats, meta.sh0, rest)
    names = {name for part in parts if part is not None for name in part.files}
    degree = 0 if rest is None else rest.bands if isinstance(rest, _Palette) else 3
    files = [path.parent / name for name in names] if is_index else [path]
    stored = sum(file.stat().st_size for file in files if is_file(file))
    check_expansion(path, count=meta.count, sh_degree=degree, stored=stored)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Images:
    """The images of a SOG; none may have many more pixels than there are Gaussians."""

    read: _Reader
    count: int
    path: Path

    def pixels(self, name: str, most: int) -> UInt8[np.ndarray, "h w 4"]:
        if PurePosixPath(name).name != name or not is_within(name) or len(name) > LONGEST_NAME:
            raise FileFormatError(
                f"{self.path}: the files of a SOG must have names of at most {LONGEST_NAME} "
                f"characters without folders, found {shown(name)}."
            )
        content = self.read(name, 5 * most + _SPARE_PIXELS)
        return decode_webp(content, f"{self.path}: {name}", most_pixels=most)

    def rows(self, name: str) -> UInt8[np.ndarray, "n 4"]:
        pixels = self.pixels(name, 4 * self.count + _SPARE_PIXELS).reshape(-1, 4)
        if len(pixels) < self.count:
            raise FileFormatError(
                f"{self.path}: {name} must have {self.count:,} pixels, found {len(pixels):,}."
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
    return np.asarray(table[np.arange(3), stored[:, :3]])


def _rest(
    images: _Images, part: _Palette | _PaletteRange | None, table: Float[np.ndarray, "256"] | None
) -> Float[np.ndarray, "n k 3"]:
    """Look labels up in the palette, and its bytes in the table; unknown labels give 0."""
    if part is None or table is None:
        return np.empty((images.count, 0, 3), np.float32)
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
    entries = table[pixels[:, :, :3]].reshape(-1, k, 3)
    count = min(part.count, len(entries)) if isinstance(part, _Palette) else len(entries)
    known = numbers < count
    rest: Float[np.ndarray, "n k 3"] = entries[np.where(known, numbers, 0)]
    rest[~known] = 0
    return rest


@contextmanager
def _opened(path: Path, *, is_index: bool) -> Iterator[_Reader]:
    """Open the zip of a bundled SOG; the files of another lie beside its index."""
    if is_index:
        yield partial(_read_beside, path)
        return
    with open_input(path) as file:
        with _damage_named(f"{path}: a .sog must be a zip of meta.json and images, found no zip"):
            archive = zipfile.ZipFile(file)
        with archive:
            yield partial(_read_inside, archive, path)


def _read_beside(path: Path, name: str, most: int) -> bytes:
    part = path if name == META else path.with_name(name)
    with open_input(part) as file:
        _check_length(os.fstat(file.fileno()).st_size, most, str(part))
        return file.read()


def _read_inside(archive: zipfile.ZipFile, path: Path, name: str, most: int) -> bytes:
    where = f"{path}: {name}"
    with _damage_named(f"{where} must be intact, found damage"):
        if name not in archive.namelist():
            raise FileFormatError(f"{path}: must contain {name}, found none.")
        entry = archive.getinfo(name)
        # of other methods, zipfile unpacks blocks whole
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileFormatError(
                f"{where} must be stored or deflated, found method {entry.compress_type}; zip it "
                f"again."
            )
        _check_length(entry.file_size, most, where)
        with archive.open(entry) as member:
            return member.read(most)


def _check_length(found: int, most: int, where: str) -> None:
    if found > most:
        raise FileFormatError(f"{where} must have at most {most:,} bytes, found {found:,}.")


@contextmanager
def _damage_named(text: str) -> Iterator[None]:
    """Convert any error of zipfile or Pillow, which pass on those of their parts and codecs."""
    try:
        yield
    except FileFormatError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        reason = shown(str(error).lower().rstrip(".") or type(error).__name__)[1:-1]
        raise FileFormatError(f"{text}: {reason}.") from error


def decode_webp(content: bytes, where: str, *, most_pixels: int) -> UInt8[np.ndarray, "h w 4"]:
    """Decode an image that stores numbers in its channels."""
    from PIL.PngImagePlugin import PngImageFile  # noqa: PLC0415 (loads in its time)
    from PIL.WebPImagePlugin import WebPImageFile  # noqa: PLC0415

    is_webp = content.startswith(b"RIFF") and content[8:12] == b"WEBP"
    if not is_webp and not content.startswith(_PNG):
        raise FileFormatError(f"{where} must be a WebP image, found something else.")
    kind = WebPImageFile if is_webp else PngImageFile  # `Image.open` would warn of large images
    with (
        _damage_named(f"{where} must be an intact image, found"),
        kind(io.BytesIO(content)) as image,
    ):
        if image.width * image.height > most_pixels:
            raise FileFormatError(
                f"{where} must have at most {most_pixels:,} pixels, "
                f"found {image.width} x {image.height}."
            )
        return np.asarray(image.convert("RGBA"))
