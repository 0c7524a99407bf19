"""Sites that coincide, which no search tree can tell apart."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor


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
