"""Pure functions on tensors, independent of scenes, files and stages."""

from cvtgs.math import frames, parameters, spherical_harmonics

__all__ = ["frames", "parameters", "spherical_harmonics"]
