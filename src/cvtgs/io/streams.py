"""Open binary files as input and output: pipes, sockets, zip members, bytes in memory."""

import re
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import SpooledTemporaryFile, TemporaryDirectory
from typing import BinaryIO, Protocol, cast

from cvtgs.errors import CvtgsError, FileFormatError, InputError, OutputError

MEMORY_BYTES = 1 << 26
"""A file is built in memory up to this size, and on disk beyond it."""

_FIRST_BYTES = {b"ply": ".ply", b"\x1f\x8b": ".spz", b"NGSP": ".spz", b"glTF": ".glb"}
_TORCH_MEMBER = re.compile(r"[^/]+/data\.pkl")


class ByteSource(Protocol):
    """An open binary file to read."""

    def read(self, size: int = -1, /) -> bytes:
        """Return the next bytes; empty at the end."""
        ...


class ByteSink(Protocol):
    """An open binary file to write to."""

    def write(self, data: bytes, /) -> object:
        """Write bytes."""
        ...


@contextmanager
def file_of(
    stream: ByteSource,
    format: str | None = None,
    *,
    name: str | None = None,
    advice: str = "give format= for other formats, such as '.splat'",
) -> Iterator[Path]:
    """Copy the rest of a stream to a temporary file, which exists while the context is open.

    Errors in the context that name the file name the stream instead, by ``name`` or its own name.
    ``advice`` ends the error message if the first bytes match no format.
    """
    name = name or name_of(stream)
    with TemporaryDirectory(prefix="cvtgs-") as folder:
        path = Path(folder) / "stream"
        with _opened(path) as file:
            try:
                first = stream.read(1 << 16)
                if not isinstance(first, bytes):
                    raise InputError(
                        f"{name}: must be open in binary mode, found text; open it with 'rb'."
                    )
                file.write(first)
                shutil.copyfileobj(stream, file)
            except OSError as error:
                if isinstance(error, InputError):
                    raise
                raise InputError(f"{name}: must be readable to its end, found: {error}.") from error
        suffix = format or format_of(path)
        if suffix is None:
            raise FileFormatError(
                f"{name}: the first bytes must be those of a .ply, .spz, .sog, .glb or .pt, found "
                f"{first[:4]!r}; {advice}."
            )
        path = path.rename(path.with_suffix(suffix))
        try:
            yield path
        except CvtgsError as error:
            text = str(error)
            if str(path) not in text:
                raise
            raise type(error)(text.replace(str(path), name)) from error


@contextmanager
def written_to(stream: ByteSink) -> Iterator[BinaryIO]:
    """Open a seekable file, and copy it to a stream when it is complete."""
    with SpooledTemporaryFile(max_size=MEMORY_BYTES) as file:
        yield cast(BinaryIO, file)
        file.seek(0)
        try:
            shutil.copyfileobj(file, stream)
            getattr(stream, "flush", lambda: None)()
        except (OSError, TypeError) as error:
            raise OutputError(
                f"{name_of(stream)}: must be open for writing in binary mode, found: {error}."
            ) from error


def format_of(path: Path) -> str | None:
    """Return the suffix of the format that the content of a file shows; None if unknown."""
    with path.open("rb") as file:
        first = file.read(4)
    for start, suffix in _FIRST_BYTES.items():
        if first.startswith(start):
            return suffix
    if not first.startswith(b"PK"):
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError):
        return ".sog"  # the SOG reader reports the damage
    return ".pt" if any(map(_TORCH_MEMBER.fullmatch, names)) else ".sog"


def name_of(stream: ByteSource | ByteSink) -> str:
    """Return the name of a stream for messages."""
    name = getattr(stream, "name", None)
    return name if isinstance(name, str) else f"the {type(stream).__name__}"


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file; failure to create it is an OutputError that names its folder."""
    try:
        file = path.open("xb")
    except OSError as error:
        raise OutputError(f"{path.parent}: must be writable, found: {error}.") from error
    with file:
        yield file
