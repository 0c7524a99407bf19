"""A robust frame of reference: where the bulk of a scene is, and how large."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

RADIUS_QUANTILE = 0.7
"""The share of points within the radius of a frame."""

CHUNK = 1 << 16
"""Points that are looked at together, to bound memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobustFrame:
    """A centre and a radius that a minority of outliers cannot move.

    Attributes:
        center: ``(3,)`` median of each coordinate, float64.
        radius: The 70 % quantile of the distance to the centre; positive.
    """

    center: Float[Tensor, "3"]
    radius: float

    def normalize(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Express points relative to the centre, in radii.

        Args:
            points: Finite positions, scene units.

        Returns:
            Positions in float64.
        """
        return (points.double() - self.center) / self.radius

    def distances(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return distances to the centre, in radii.

        Args:
            points: Finite positions, scene units.

        Returns:
            Distances in float64.
        """
        parts = [
            torch.linalg.vector_norm(self.normalize(part), dim=1) for part in points.split(CHUNK)
        ]
        return torch.cat(parts)

    def contract(self, points: Float[Tensor, "n 3"], strength: float = 1.0) -> Float[Tensor, "n 3"]:
        """Express points in radii and pull in those beyond the first radius, logarithmically.

        A point at distance d > 1 goes to distance ``1 + log(d)`` in the same direction. Seen
        from the middle, equal steps along and across the view then shrink alike, so a far cell
        keeps its shape; the map ``2 - 1/d`` of mip-NeRF 360 (Barron et al. 2022) flattens it.

        Args:
            points: Finite positions, scene units.
            strength: From 0, which pulls nothing in, to 1. Between them the logarithm of the
                distance shrinks by that share.

        Returns:
            Positions in float64; with strength 1 a flyaway of 1e30 radii lies at 70.
        """
        local = self.normalize(points)
        distance: Tensor = torch.linalg.vector_norm(local, dim=1, keepdim=True).clamp_min(1.0)
        return local * ((1.0 + torch.log(distance)) / distance) ** strength


def robust_frame(points: Float[Tensor, "n 3"]) -> RobustFrame:
    """Find the robust frame of points.

    Args:
        points: Finite positions, at least one.

    Returns:
        The frame. If more than 70 % of the points coincide, the radius is the largest distance,
        and 1 if all do.

    Example:
        >>> frame = robust_frame(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
        >>> frame.center.tolist(), frame.radius
        ([1.0, 0.0, 0.0], 1.0)
    """
    center = torch.stack([column.median() for column in points.unbind(1)]).double()
    distances = RobustFrame(center=center, radius=1.0).distances(points)
    rank = max(1, math.ceil(RADIUS_QUANTILE * len(points)))
    radius = float(distances.kthvalue(rank).values) or float(distances.amax()) or 1.0
    return RobustFrame(center=center, radius=radius)
