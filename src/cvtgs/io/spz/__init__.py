"""The ``.spz`` files of Niantic: 20 bytes per Gaussian and one per view-dependent number."""

from cvtgs.io.spz.read import read_spz
from cvtgs.io.spz.write import SPZ_HOLDS, write_spz

__all__ = ["SPZ_HOLDS", "read_spz", "write_spz"]
