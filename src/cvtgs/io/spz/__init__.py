"""Niantic's ``.spz`` files: 20 bytes per Gaussian and one per view-dependent SH value."""

from cvtgs.io.spz.read import decode_spz, read_spz
from cvtgs.io.spz.write import write_spz

__all__ = ["decode_spz", "read_spz", "write_spz"]
