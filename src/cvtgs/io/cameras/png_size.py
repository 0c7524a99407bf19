"""The size of a PNG image, for camera files that do not give it."""

import struct
from pathlib import Path

from cvtgs.errors import FileFormatError
from cvtgs.io.files import open_input

_START = struct.Struct(">8sI4sII")
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def png_size(path: Path) -> tuple[int, int]:
    """Read the size of a PNG image from its first bytes."""
    with open_input(path) as file:
        start = file.read(_START.size)
    if len(start) == _START.size:
        signature, _, chunk, width, height = _START.unpack(start)
        if signature == _SIGNATURE and chunk == b"IHDR":
            return width, height
    raise FileFormatError(
        f"{path}: must be a PNG file, since its size is not among the cameras; found another "
        f"format. Give 'w' and 'h' in the file of the cameras."
    )
