"""Points and sites that coincide, which no search tree can tell apart."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NearestSite = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes points ``(n, d)`` and sites ``(m, d)``, returns labels and squared distances ``(n,)``."""


def runs_of_equal(
    sites: Float[Tensor, "m d"],
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]] | None:
    """Bring coincident sites next to one another.

    Sites are sorted by a sum of their coordinates, which is the same for equal ones. Where
    different sites share a sum, some equal ones may stay apart; that costs time, not correctness.
    """
    keys = sites.new_zeros(len(sites), dtype=torch.float64)
    for axis, column in enumerate(sites.unbind(1)):
        keys += column.double() * math.sqrt(1 + axis)  # no common measure: sums rarely coincide
    order = torch.sort(keys, stable=True).indices
    repeated = torch.zeros(len(sites), dtype=torch.bool, device=sites.device)
    candidates = (keys[order[1:]] == keys[order[:-1]]).nonzero()[:, 0]
    repeated[candidates + 1] = (sites[order[candidates + 1]] == sites[order[candidates]]).all(dim=1)
    if not bool(repeated.any()):
        return None
    places = torch.arange(len(sites), device=sites.device)
    starts = torch.where(repeated, 0, places).cummax(0).values
    return order, places - starts


def distinct_rows(sites: Float[Tensor, "m d"]) -> Int[Tensor, "k"] | None:
    """Return one row number for each place at which there are sites."""
    runs = runs_of_equal(sites)
    if runs is None:
        return None
    order, ranks = runs
    return torch.sort(order[ranks == 0]).values


def search_once_per_position(nearest: NearestSite) -> NearestSite:
    """Search for each position only once, with the same answers."""

    def search(points: Tensor, sites: Tensor) -> tuple[Tensor, Tensor]:
        is_first = first_of_each(points)
        labels, squared = nearest(points[is_first], sites)
        numbers = is_first.cumsum(0) - 1
        return labels[numbers], squared[numbers]

    return search


def first_of_each(points: Float[Tensor, "n d"]) -> Bool[Tensor, "n"]:
    """Return which points differ from the one before."""
    first = torch.ones(len(points), dtype=torch.bool, device=points.device)
    first[1:] = points[1:, 0] != points[:-1, 0]
    maybe = (~first).nonzero()[:, 0]
    first[maybe] = (points[maybe] != points[maybe - 1]).any(dim=1)
    return first
