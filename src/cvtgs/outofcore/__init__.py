"""Simplify scenes that do not fit into memory in blocks of space, here or on a cluster."""

from cvtgs.outofcore.distributed import ClusterWorkers, connect, simplify_distributed
from cvtgs.outofcore.memory import (
    available_memory,
    block_count,
    needed_memory,
    read_bytes,
    worker_count,
)
from cvtgs.outofcore.run import check_config, simplify_file
from cvtgs.processes import LocalWorkers, Workers

__all__ = [
    "ClusterWorkers",
    "LocalWorkers",
    "Workers",
    "available_memory",
    "block_count",
    "check_config",
    "connect",
    "needed_memory",
    "read_bytes",
    "simplify_distributed",
    "simplify_file",
    "worker_count",
]
