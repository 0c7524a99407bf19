"""PLY files of 3DGS scenes, in the layout of INRIA's code and its successors."""

from cvtgs.io.ply.read import PlyRows, assemble, open_rows, read_ply
from cvtgs.io.ply.write import join_plys, write_ply

__all__ = ["PlyRows", "assemble", "join_plys", "open_rows", "read_ply", "write_ply"]
