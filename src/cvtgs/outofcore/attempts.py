"""Files of rows that one attempt to sort a range writes, before the job adopts them."""

import secrets
import zlib
from pathlib import Path
from typing import NamedTuple

from cvtgs.io.atomic import write_error


class SortedFile(NamedTuple):
    """A file that one attempt to sort a range wrote, before the job adopts it.

    Attributes:
        name: Final name in the folder of the job.
        attempt: Current name.
        size: Size in bytes.
        checksum: CRC-32 of its content.
    """

    name: str
    attempt: str
    size: int
    checksum: int


class Attempt:
    """The files that one call writes for a range; every other call for it writes other files.

    Therefore a worker that was presumed dead but still writes cannot damage the files in use.
    """

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._token = secrets.token_hex(8)
        self._found: dict[str, tuple[int, int]] = {}

    def append(self, name: str, content: bytes) -> None:
        """Append to the file with this final name."""
        path = self._folder / self._name(name)
        try:
            with path.open("ab") as file:
                file.write(content)
        except OSError as error:
            raise write_error(path, error) from error
        size, checksum = self._found.get(name, (0, 0))
        self._found[name] = (size + len(content), zlib.crc32(content, checksum))

    def files(self) -> tuple[SortedFile, ...]:
        """Return the written files."""
        return tuple(
            SortedFile(name, self._name(name), size, checksum)
            for name, (size, checksum) in self._found.items()
        )

    def _name(self, name: str) -> str:
        return f"attempt_{name}_{self._token}"
