"""Read cameras from files of NeRF, nerfstudio, COLMAP and INRIA's code."""

from cvtgs.io.cameras.load import load_cameras

__all__ = ["load_cameras"]
