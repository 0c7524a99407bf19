"""Pure functions on tensors, independent of scenes, files and stages."""

from cvtgs.math import depths, frames, parameters, segments, spherical_harmonics

__all__ = ["depths", "frames", "parameters", "segments", "spherical_harmonics"]
