"""Scenes too large for one piece: blocks of space, one after the other or on many machines."""

from cvtgs.outofcore.distributed import simplify_distributed
from cvtgs.outofcore.memory import available_memory, block_count, needed_memory, read_bytes
from cvtgs.outofcore.run import simplify_file

__all__ = [
    "available_memory",
    "block_count",
    "needed_memory",
    "read_bytes",
    "simplify_distributed",
    "simplify_file",
]
