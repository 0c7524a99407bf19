"""PLY files of 3DGS scenes, as INRIA's code and its successors write them."""

from cvtgs.io.ply.properties import FLAT_LOG_SCALE
from cvtgs.io.ply.read import read_ply
from cvtgs.io.ply.write import write_ply

__all__ = ["FLAT_LOG_SCALE", "read_ply", "write_ply"]
