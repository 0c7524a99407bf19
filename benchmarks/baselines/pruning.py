"""Pruning without images: keep the M Gaussians of largest opacity, or of largest mass.

These are the simplest baselines of every paper and need no source. Mass is opacity times the mean
projected area of the one-sigma ellipsoid (Cauchy 1832: a quarter of its surface): the area that an
unoccluded Gaussian paints, averaged over all directions.
"""

from benchmarks.baselines.gaussians import keep_largest, usable
from cvtgs.scene import GaussianScene


def keep_most_opaque(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` most opaque Gaussians; nothing is random."""
    valid = usable(scene, count)
    return keep_largest(valid, valid.logit_opacities, count=count)


def keep_most_mass(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` Gaussians of largest mass; nothing is random."""
    valid = usable(scene, count)
    return keep_largest(valid, valid.masses, count=count)
