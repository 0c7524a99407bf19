"""PLY files of 3DGS scenes, in the layout of INRIA's code and its successors."""

from cvtgs.io.ply.read import assemble, read_ply
from cvtgs.io.ply.rows import PlyRows, join_plys, open_rows
from cvtgs.io.ply.write import write_ply

__all__ = ["PlyRows", "assemble", "join_plys", "open_rows", "read_ply", "write_ply"]
