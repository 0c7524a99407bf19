"""What users get back: small scenes, and how they came about."""

from typing import NamedTuple

from cvtgs.report import SimplifyReport
from cvtgs.scene import GaussianScene


class Simplified(NamedTuple):
    """A small scene, and how it came about.

    Attributes:
        scene: The small scene.
        report: Counts, mass, energies, and the cost of every stage.
    """

    scene: GaussianScene
    report: SimplifyReport


class Level(NamedTuple):
    """One size of a scene, of several.

    Attributes:
        scene: The small scene.
        report: What was done, and what it cost beyond what was there already for finer sizes.
        geometric_error: Root mean square distance from Gaussians to those that stand for them,
            each weighing what it paints; scene units.
        nested: Whether every cell consists of whole cells of the finest size.
    """

    scene: GaussianScene
    report: SimplifyReport
    geometric_error: float
    nested: bool
