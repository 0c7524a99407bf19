"""Open binary files as input and output: pipes, sockets, zip members, bytes in memory."""

import io
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from tempfile import SpooledTemporaryFile, TemporaryDirectory
from traceback import clear_frames
from typing import BinaryIO, Protocol, cast

from cvtgs.errors import RENAMINGS, CvtgsError, FileFormatError, InputError, OutputError, reason_of
from cvtgs.io.atomic import replace_file

MEMORY_BYTES = 1 << 26  # a file is built in memory up to this size, and on disk beyond it
CHUNK_BYTES = 1 << 16  # bytes of a stream that are read at once
_FIRST_BYTES = {b"ply": ".ply", b"\x1f\x8b": ".spz", b"NGSP": ".spz", b"glTF": ".glb"}
_MOST_FIRST_BYTES = max(map(len, _FIRST_BYTES))
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
    """Copy the rest of a stream to a temporary file; errors and warnings name the stream instead.

    ``advice`` ends the error message if the first bytes match no format.
    """
    name = name or name_of(stream)
    chunks, start = _chunks(stream, name), b""
    while len(start) < _MOST_FIRST_BYTES and (chunk := next(chunks, b"")):
        start += chunk
    if format is None and not start.startswith((b"PK", *_FIRST_BYTES)):
        found = repr(start[:_MOST_FIRST_BYTES]) if start else "no bytes at all"
        raise FileFormatError(
            f"{name}: the first bytes must be those of a .ply, .spz, .sog, .glb or .pt, found "
            f"{found}; {advice}."
        )
    with ExitStack() as stack:
        try:
            temporary = TemporaryDirectory(prefix="cvtgs-", ignore_cleanup_errors=True)
            folder = stack.enter_context(temporary)
            path = Path(folder) / "stream"
            with path.open("xb") as file:
                file.write(start)
                for chunk in chunks:
                    file.write(chunk)
        except InputError:
            raise
        except OSError as error:
            raise _no_room(f"of {name}", error) from error
        suffix = format or _format_of(path, start)
        copy, path = path, path.with_name(f"stream{suffix}")
        replace_file(copy, path)
        stack.enter_context(named_in_warnings(path, name))
        try:
            yield path
        except CvtgsError as error:
            part: BaseException | None = error
            while part is not None:  # Windows does not remove files that finished calls mapped
                clear_frames(part.__traceback__)
                part = part.__cause__ or part.__context__
            text = str(error)
            if folder not in text:
                raise
            raise type(error)(_renamed(text, path, name)) from error


def _no_room(what: str, error: OSError) -> OutputError:
    return OutputError(
        f"the folder of temporary files must be writable and have room for a copy {what}, found: "
        f"{reason_of(error)}; TMPDIR sets another folder."
    )


@contextmanager
def named_in_warnings(path: Path, name: str) -> Iterator[None]:
    """Let warnings of cvtgs in the context name a stream instead of its temporary file."""
    token = RENAMINGS.set((*RENAMINGS.get(), partial(_renamed, path=path, name=name)))
    try:
        yield
    finally:
        RENAMINGS.reset(token)


def _renamed(text: str, path: Path, name: str) -> str:
    """Replace the temporary file and its folder in a message."""
    return text.replace(str(path), name).replace(f"{path.parent}{os.sep}", "")


def _not_binary(name: str) -> InputError:
    return InputError(f"{name}: must be open in binary mode, found text; open it with 'rb'.")


def _chunks(stream: ByteSource, name: str) -> Iterator[bytes]:
    """Yield the rest of a stream, in pieces."""
    while True:
        try:
            chunk = stream.read(CHUNK_BYTES)
        except MemoryError:
            raise
        except UnicodeDecodeError as error:  # a file that was opened as text
            raise _not_binary(name) from error
        except Exception as error:  # archives and connections raise their own kinds
            raise InputError(
                f"{name}: must be readable to its end, found: {error or type(error).__name__}."
            ) from error
        if chunk is None:
            raise InputError(f"{name}: must be open in blocking mode, found no bytes yet.")
        if not isinstance(chunk, bytes | bytearray | memoryview):
            raise _not_binary(name)
        if not chunk:
            return
        yield bytes(chunk)


@contextmanager
def written_to(stream: ByteSink) -> Iterator[BinaryIO]:
    """Open a seekable file, and copy it to a stream when it is complete."""
    with SpooledTemporaryFile(max_size=MEMORY_BYTES) as file:
        try:
            yield cast(BinaryIO, file)
            file.seek(0)
        except OSError as error:
            raise _no_room(f"of what {name_of(stream)} gets", error) from error
        try:
            copy_to(stream, cast(BinaryIO, file))
            getattr(stream, "flush", lambda: None)()
        except MemoryError:
            raise
        except Exception as error:  # connections raise their own kinds
            found = reason_of(error).rstrip(".")
            raise OutputError(
                f"{name_of(stream)}: must be open for writing in binary mode and take all bytes, "
                f"found: {found or type(error).__name__}."
            ) from error


def copy_to(stream: ByteSink, file: BinaryIO) -> None:
    """Write the rest of a file to a stream; raw ones may take only some of the bytes at once."""
    while chunk := file.read(CHUNK_BYTES):
        count = stream.write(chunk)
        while isinstance(stream, io.RawIOBase) and count != len(chunk):
            if not isinstance(count, int) or count < 1:
                raise BlockingIOError("it takes no more bytes without blocking")
            chunk = chunk[count:]
            count = stream.write(chunk)


def _format_of(path: Path, start: bytes) -> str:
    """Return the suffix of the format that the content of a file and its first bytes show."""
    for first, suffix in _FIRST_BYTES.items():
        if start.startswith(first):
            return suffix
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError):
        return ".sog"  # the SOG reader reports the damage
    return ".pt" if any(map(_TORCH_MEMBER.fullmatch, names)) else ".sog"


def name_of(stream: ByteSource | ByteSink) -> str:
    """Return the name of a stream for messages."""
    name = getattr(stream, "name", None)
    return name if isinstance(name, str) and name else f"the {type(stream).__name__}"
