"""Access to the files of a SOG (in a zip, or beside ``meta.json``) and its WebP images."""

import io
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8

from cvtgs.errors import FileFormatError, is_out_of_memory
from cvtgs.io.files import LONGEST_NAME, is_file, is_within, open_input
from cvtgs.text import shown

META = "meta.json"
MOST_META_BYTES = 1 << 20  # largest size of ``meta.json``; real ones have about ten thousand bytes

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods whose output zipfile bounds; it unpacks blocks of bzip2 or LZMA whole."""

_PNG = b"\x89PNG\r\n\x1a\n"

QUAT_TAG = 252  # the last byte of a rotation is this plus the number of its omitted component
PALETTE_COLUMNS = 64  # entries of the SH palette per row of its image

Reader = Callable[[str, int], bytes]
"""Reads a file by its name; a file of more than the given number of bytes is an error."""


def open_container(path: Path) -> AbstractContextManager[Reader]:
    """Open a bundled or an unbundled SOG."""
    return nullcontext(partial(_read_beside, path)) if is_index(path) else _inside(path)


def stored_bytes(path: Path, names: Sequence[str]) -> int:
    """Return the size of the images of a SOG on disk, as compressed."""
    if not is_index(path):
        return path.stat().st_size
    for name in names:
        _check_name(name, path)
    parts = [path.with_name(name) for name in names]
    return sum(part.stat().st_size for part in parts if is_file(part))


def is_index(path: Path) -> bool:
    """Return whether a path is the ``meta.json`` of an unbundled SOG, whatever its exact name."""
    return path.suffix.lower() == ".json"


def _read_beside(path: Path, name: str, most: int) -> bytes:
    _check_name(name, path)
    part = path if name == META else path.with_name(name)
    with open_input(part) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise _too_long(str(part), most, size)
        return file.read()


@contextmanager
def _inside(path: Path) -> Iterator[Reader]:
    with open_input(path) as file:
        no_zip = f"{path}: a .sog file must be a zip of meta.json and images, found no zip"
        with _damage_named(no_zip):
            archive = zipfile.ZipFile(file)

        def read(name: str, most: int) -> bytes:
            _check_name(name, path)
            with _damage_named(f"{path}: {name} must be intact, found damage"):
                try:
                    entry = archive.getinfo(name)
                except KeyError as error:
                    raise FileFormatError(f"{path}: must contain {name}, found none.") from error
                if entry.compress_type not in _METHODS:
                    raise FileFormatError(
                        f"{path}: {name} must be stored or deflated in the zip, found method "
                        f"{entry.compress_type}; zip the images again."
                    )
                if entry.file_size > most:
                    raise _too_long(f"{path}: {name}", most, entry.file_size)
                with archive.open(entry) as member:
                    return member.read(most)

        with archive:
            yield read


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


def _check_name(name: str, path: Path) -> None:
    if PurePosixPath(name).name != name or not is_within(name) or len(name) > LONGEST_NAME:
        raise FileFormatError(
            f"{path}: the files of a SOG must have names of at most {LONGEST_NAME} characters "
            f"without folders, found {shown(name)}."
        )


def _too_long(where: str, most: int, found: int) -> FileFormatError:
    return FileFormatError(f"{where} must have at most {most:,} bytes, found {found:,}.")


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


def encode_webp(numbers: UInt8[np.ndarray, "h w 4"]) -> bytes:
    """Write numbers to a lossless image, including those of pixels with opacity 0."""
    from PIL import Image  # noqa: PLC0415

    file = io.BytesIO()
    Image.fromarray(numbers).save(file, format="webp", lossless=True, exact=True, quality=80)
    return file.getvalue()
