"""Simplify scenes that do not fit into memory in blocks of space, here or on a cluster."""

from cvtgs.outofcore.distributed import ClusterWorkers, connect
from cvtgs.outofcore.run import simplify_file
from cvtgs.processes import LocalWorkers, Workers

__all__ = ["ClusterWorkers", "LocalWorkers", "Workers", "connect", "simplify_file"]
