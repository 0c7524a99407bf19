"""Lloyd's algorithm: move every site to the middle of its cell, again and again."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt.nearest import NearestSite
from cvtgs.math.segments import segment_sum, sort_by_label


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LloydResult:
    """Where the sites ended.

    Attributes:
        sites: ``(m, d)`` sites.
        energies: ``sum w |x - site|^2`` before each move, in the order of iterations.
    """

    sites: Float[Tensor, "m d"]
    energies: tuple[float, ...]


def lloyd(
    points: Float[Tensor, "n d"],
    weights: Float[Tensor, "n"],
    sites: Float[Tensor, "m d"],
    *,
    nearest: NearestSite,
    iterations: int,
    tolerance: float,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> LloydResult:
    """Move sites to the weighted centroids of their Voronoi cells (Lloyd 1982).

    A site without points stays where it is, so the energy never rises.

    Args:
        points: Positions.
        weights: Weights, at least 0.
        sites: Where to start.
        nearest: Search of the nearest site.
        iterations: Moves at most.
        tolerance: Stops when the energy fell by less than this share since the last move.
        on_iteration: Told how many moves are done.

    Returns:
        The moved sites and the energies.

    Example:
        >>> from cvtgs.cvt.nearest import nearest_torch
        >>> points = torch.tensor([[0.0], [1.0], [8.0]])
        >>> lloyd(
        ...     points, torch.ones(3), points[[0, 2]], nearest=nearest_torch,
        ...     iterations=2, tolerance=0.0,
        ... ).sites.tolist()
        [[0.5], [8.0]]
    """
    energies: list[float] = []
    sites = sites.double()
    for done in range(iterations):
        labels, squared = nearest(points, sites)
        energies.append(float((weights * squared).sum()))
        if done > 0 and energies[-2] - energies[-1] <= tolerance * energies[-2]:
            break
        sites = weighted_centroids(points, weights, labels, sites)
        on_iteration(done + 1)
    return LloydResult(sites=sites, energies=tuple(energies))


def weighted_centroids(
    points: Float[Tensor, "n d"],
    weights: Float[Tensor, "n"],
    labels: Int[Tensor, "n"],
    fallback: Float[Tensor, "m d"],
) -> Float[Tensor, "m d"]:
    """Average the points of every label.

    Args:
        points: Positions.
        weights: Weights, at least 0.
        labels: Label of every point, 0 to m - 1.
        fallback: Result for labels without points or without weight.

    Returns:
        Weighted means in float64.

    Example:
        >>> weighted_centroids(
        ...     torch.tensor([[0.0], [1.0]]), torch.tensor([1.0, 3.0]), torch.tensor([0, 0]),
        ...     torch.tensor([[7.0], [7.0]]),
        ... ).tolist()
        [[0.75], [7.0]]
    """
    totals, sums = weighted_sums(points, weights, labels, len(fallback))
    return centroids(totals, sums, fallback)


def weighted_sums(
    points: Float[Tensor, "n d"],
    weights: Float[Tensor, "n"],
    labels: Int[Tensor, "n"],
    count: int,
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m d"]]:
    """Add up the points of every label."""
    order, offsets = sort_by_label(labels, count)
    weights = weights[order].double()
    axes = [segment_sum(column[order].double() * weights, offsets) for column in points.unbind(1)]
    return segment_sum(weights, offsets), torch.stack(axes, dim=1)


def centroids(
    totals: Float[Tensor, "m"], sums: Float[Tensor, "m d"], fallback: Float[Tensor, "m d"]
) -> Float[Tensor, "m d"]:
    """Divide sums of points by their weight."""
    filled = totals > 0
    means = sums / totals.where(filled, 1.0)[:, None]
    return torch.where(filled[:, None], means, fallback)
