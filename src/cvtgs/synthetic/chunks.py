"""Chunk: the rows of one part that are drawn together, and all the randomness they get."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import activations, quaternions
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

OPACITY_RANGE = (0.006, 0.9995)
"""Every opacity lies in here."""

_PLASTIC = 1.32471795724474602596
_JITTER = 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Rows ``start`` to ``stop`` of a part of ``total`` Gaussians.

    Attributes:
        start: First row.
        stop: Row after the last one.
        total: Gaussians of the whole part, which sets their spacing.
        rest_count: View-dependent SH coefficients per channel.
        shift: ``(2,)`` offset of the part's low-discrepancy sequence.
        generator: Where random numbers come from.
    """

    start: int
    stop: int
    total: int
    rest_count: int
    shift: Float[Tensor, "2"]
    generator: torch.Generator

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.stop - self.start

    def uniforms(self, *shape: int) -> Tensor:
        """Draw uniform numbers in [0, 1), ``(rows, *shape)``."""
        return torch.rand(len(self), *shape, generator=self.generator)

    def normals(self, *shape: int) -> Tensor:
        """Draw standard normal numbers, ``(rows, *shape)``."""
        return torch.randn(len(self), *shape, generator=self.generator)

    def lognormals(self, median: float, spread: float) -> Float[Tensor, "n"]:
        """Draw positive numbers with this median, whose logarithms have this deviation."""
        return median * torch.exp(spread * self.normals())

    def positions(self) -> Float[Tensor, "n 2"]:
        """Return evenly spread points of the unit square.

        The R2 sequence (Roberts 2018), each point moved at random by a part of the spacing.
        """
        rows = torch.arange(self.start, self.stop, dtype=torch.float64)
        steps = torch.tensor([1 / _PLASTIC, 1 / _PLASTIC**2], dtype=torch.float64)
        jitter = (self.uniforms(2) - 0.5) * (_JITTER / math.sqrt(self.total))
        # rounding to float32 may give 1.0, which is outside
        return ((rows[:, None] * steps + self.shift + jitter) % 1.0).float().clamp_max(1 - 1e-7)

    def directions(self) -> Float[Tensor, "n 3"]:
        """Draw unit vectors, all directions alike."""
        return torch.nn.functional.normalize(self.normals(3), dim=1)

    def frames(self) -> Float[Tensor, "n 3 3"]:
        """Draw rotation matrices."""
        return frames_of(self.directions(), self.directions())


Draw = Callable[[Chunk], GaussianScene]
"""Makes the Gaussians of one chunk of a part."""


def frames_of(first: Float[Tensor, "n 3"], second: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Build rotations whose first column is ``first`` and whose second is near ``second``."""
    third = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=1)
    return torch.stack([first, torch.linalg.cross(third, first), third], dim=2)


def gaussians(
    *,
    means: Float[Tensor, "n 3"],
    frames: Float[Tensor, "n 3 3"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colors: Float[Tensor, "n 3"],
    rest: Float[Tensor, "n k 3"],
) -> GaussianScene:
    """Store readable values as a scene does."""
    return GaussianScene(
        means=means,
        quats=quaternions.from_matrices(frames),
        log_scales=activations.positive_log(scales),
        logit_opacities=activations.logit_from_opacity(opacities.clamp(*OPACITY_RANGE)),
        sh0=((colors.clamp(0.0, 1.0) - 0.5) / SH_C0)[:, None, :],
        shN=rest,
    )
