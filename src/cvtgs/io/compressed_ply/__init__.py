"""PlayCanvas' compressed PLY files: 16 bytes per Gaussian and one per view-dependent number."""

from cvtgs.io.compressed_ply.read import is_compressed_ply, read_compressed_ply
from cvtgs.io.compressed_ply.write import COMPRESSED_PLY_HOLDS, write_compressed_ply

__all__ = [
    "COMPRESSED_PLY_HOLDS",
    "is_compressed_ply",
    "read_compressed_ply",
    "write_compressed_ply",
]
