"""Header and block sizes of ``.spz`` files, for reading and writing."""

import struct
from dataclasses import dataclass

import numpy as np

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")
ANTIALIASED_FLAG = 1
EXTENSIONS_FLAG = 2
AXES_EXTENSION = 0xADBE0003
"""The type of Adobe's extension for the axes, which it numbers from 1."""

FOURTH_HEADER_BYTES = 32
"""Header size of version 4; extensions follow, then the sizes of the blocks, then the blocks."""

TABLE_ENTRY = struct.Struct("<QQ")
"""Compressed and uncompressed size of a block, in bytes."""

COLOR_SCALE = np.float32(0.15)
"""Colour bytes store ``0.5 + 0.15 sh0``, a wider range than displayable colours."""

STORED_REST_COUNTS = (0, 3, 8, 15, 24)
"""View-dependent coefficients per channel that files may hold, by degree."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpzHeader:
    """The header of an ``.spz`` file of version 1 to 4."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    """Number of fractional bits of coordinates."""
    flags: int
    """Bits for antialiased and extensions."""
    streams: int = 0
    """Number of compressed blocks of version 4; reserved in older versions."""

    @property
    def antialiased(self) -> bool:
        """Whether the scene was trained with anti-aliasing."""
        return bool(self.flags & ANTIALIASED_FLAG)

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each block, in the order of the file."""
        per_row = {
            "means": 6 if self.version == 1 else 9,
            "opacities": 1,
            "colors": 3,
            "log_scales": 3,
            "quats": 3 if self.version < 3 else 4,
            "sh": 3 * STORED_REST_COUNTS[self.sh_degree],
        }
        return {name: self.count * size for name, size in per_row.items()}

    def packed(self) -> bytes:
        """Return the first 16 bytes of the file."""
        return HEADER.pack(
            MAGIC,
            self.version,
            self.count,
            self.sh_degree,
            self.fractional_bits,
            self.flags,
            self.streams,
        )
