"""Files of rows that one attempt to sort a range has written, before they are adopted."""

import secrets
import zlib
from pathlib import Path
from typing import NamedTuple


class SortedFile(NamedTuple):
    """A file that one attempt to sort a range has written, before it is adopted.

    Attributes:
        name: Name that it gets in the folder of the job.
        attempt: Name that it has.
        size: Bytes.
        checksum: CRC-32 of its content.
    """

    name: str
    attempt: str
    size: int
    checksum: int


class Attempt:
    """The files that one call writes for a range; a second call for it writes others.

    So a worker that was taken for dead and still writes cannot damage those that are used.
    """

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._token = secrets.token_hex(8)
        self._found: dict[str, tuple[int, int]] = {}

    def append(self, name: str, content: bytes) -> None:
        """Append to the file that is to get a name."""
        with (self._folder / self._name(name)).open("ab") as file:
            file.write(content)
        size, checksum = self._found.get(name, (0, 0))
        self._found[name] = (size + len(content), zlib.crc32(content, checksum))

    def files(self) -> tuple[SortedFile, ...]:
        """Return what was written."""
        return tuple(
            SortedFile(name, self._name(name), size, checksum)
            for name, (size, checksum) in self._found.items()
        )

    def _name(self, name: str) -> str:
        return f"attempt_{name}_{self._token}"
