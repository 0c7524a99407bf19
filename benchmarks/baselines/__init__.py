"""Readable reference implementations of other methods, written from the formulas in their papers.

No code is copied. ``python -m benchmarks.baselines METHOD IN OUT --count M`` runs one method on a
file. As in the comparisons of CVT-GS, results are not fine-tuned.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from cvtgs.scene import GaussianScene  # loads torch, which is to start after its settings


class Simplify(Protocol):
    """The signature of every baseline."""

    def __call__(self, scene: "GaussianScene", count: int, *, seed: int = 0) -> "GaussianScene":
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
"""Names and functions of the baselines, which are imported on demand."""


def baseline(name: str) -> Simplify:
    """Import a baseline by name."""
    module, _, function = BASELINES[name].partition(".")
    found: Simplify = getattr(import_module(f"benchmarks.baselines.{module}"), function)
    return found
