"""Other methods as readable reference implementations, written from their papers' formulas.

Nothing is copied from anybody's code. ``python -m benchmarks.baselines METHOD IN OUT --count M``
runs one of them on a file. As in the comparisons of CVT-GS, nothing is fine-tuned afterwards.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Protocol

from cvtgs.scene import GaussianScene


class Simplify(Protocol):
    """What every baseline is."""

    def __call__(self, scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
        """Return exactly ``count`` valid standard Gaussians."""
        ...


BASELINES: Mapping[str, str] = {
    "opacity pruning": "pruning.keep_most_opaque",
    "mass pruning": "pruning.keep_most_mass",
    "LightGaussian": "light_gaussian.simplify",
    "PUP 3D-GS": "pup_3dgs.simplify",
    "GHAP": "ghap.simplify",
    "NanoGS": "nano_gs.simplify",
}
"""Names, and where the functions are; they are imported when they are asked for."""


def baseline(name: str) -> Simplify:
    """Return a baseline by its name."""
    module, _, function = BASELINES[name].partition(".")
    found: Simplify = getattr(import_module(f"benchmarks.baselines.{module}"), function)
    return found
