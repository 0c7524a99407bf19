"""Pruning without images: keep the M Gaussians of most opacity, or of most mass.

The simplest baselines of every paper; no source is needed. Mass is opacity times mean projected
area of the one-sigma ellipsoid (Cauchy 1832: a quarter of its surface), which is what a Gaussian
paints, averaged over all directions, if nothing hides it.
"""

from benchmarks.baselines.gaussians import keep_largest, usable
from cvtgs.scene import GaussianScene


def keep_most_opaque(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` most opaque Gaussians; nothing is random."""
    valid = usable(scene, count)
    return keep_largest(valid, valid.logit_opacities, count=count)


def keep_most_mass(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` Gaussians of most mass; nothing is random."""
    valid = usable(scene, count)
    return keep_largest(valid, valid.masses, count=count)
