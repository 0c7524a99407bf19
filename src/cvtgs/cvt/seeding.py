"""First sites of the tessellation: which points to start from."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def stratified_seeds(
    weights: Float[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "count"], Float[Tensor, "count"]]:
    """Take points at equal steps of accumulated weight: systematic sampling, no random numbers.

    Points that weigh more than one step are taken for certain, and the steps are made anew for
    the others (Madow 1949), so every point is taken at most once.

    Args:
        weights: Weights of points along a space-filling curve, at least 0.
        count: How many points to take, at most n.

    Returns:
        Row numbers, ascending, and the weight that each taken point stands for; the latter sum
        to the sum of ``weights``.

    Example:
        >>> rows, shares = stratified_seeds(torch.tensor([1.0, 1.0, 1.0, 9.0]), 2)
        >>> rows.tolist(), shares.tolist()
        ([1, 3], [3.0, 9.0])
    """
    weights = weights.double()
    if float(weights.sum()) <= 0:
        weights = torch.ones_like(weights)
    certain = torch.zeros(len(weights), dtype=torch.bool, device=weights.device)
    while True:
        free = count - int(certain.sum())
        step = float(weights[~certain].sum()) / free if free else 0.0
        heavier = ~certain & (weights >= step)
        if free == 0 or not bool(heavier.any()) or step == 0.0:
            break
        certain = _take_heaviest(certain, heavier, weights, count)
    shares = torch.where(certain, weights, step)
    rows = torch.cat([certain.nonzero()[:, 0], _systematic(weights, ~certain, free)])
    rows = torch.sort(rows).values
    return rows, shares[rows]


def weighted_seeds(
    weights: Float[Tensor, "n"], count: int, generator: torch.Generator
) -> Int[Tensor, "count"]:
    """Draw points at random, without replacement, with probability by weight.

    The points with the smallest ``-log(u) / w`` are taken (Efraimidis and Spirakis 2006).

    Args:
        weights: Weights, at least 0; points of weight 0 are taken last.
        count: How many points to draw, at most n.
        generator: Source of randomness on the CPU, so that every device draws the same.

    Returns:
        Row numbers, ascending.

    Example:
        >>> weighted_seeds(torch.tensor([0.0, 1.0]), 1, torch.Generator().manual_seed(0)).tolist()
        [1]
    """
    uniform = torch.rand(len(weights), generator=generator, dtype=torch.float64)
    keys = -torch.log(uniform.clamp_min(1e-300)).to(weights.device) / weights.double()
    chosen = torch.sort(keys, stable=True).indices[:count]
    return torch.sort(chosen).values


def _take_heaviest(certain: Tensor, heavier: Tensor, weights: Tensor, count: int) -> Tensor:
    """Mark the heavier points as certain, the heaviest first, never more than ``count``."""
    rows = heavier.nonzero()[:, 0]
    heaviest = torch.sort(weights[rows], stable=True, descending=True).indices
    result = certain.clone()
    result[rows[heaviest[: count - int(certain.sum())]]] = True
    return result


def _systematic(weights: Tensor, allowed: Tensor, count: int) -> Tensor:
    """Take the allowed points at the middle of ``count`` equal steps of accumulated weight."""
    rows = allowed.nonzero()[:, 0]
    if count == 0:
        return rows[:0]
    total = weights[rows].cumsum(0)
    steps = (torch.arange(count, device=rows.device) + 0.5) * (total[-1] / count)
    picks = torch.searchsorted(total, steps).clamp_max(len(rows) - 1)
    return rows[_ascending(picks, len(rows))]


def _ascending(picks: Tensor, n: int) -> Tensor:
    """Separate equal picks by moving them to the next free place, within 0 to n - 1.

    Picks of weights below one step are distinct but for rounding and for weights of zero.
    """
    places = torch.arange(len(picks), device=picks.device)
    forward = (picks - places).cummax(0).values + places
    latest = n - len(picks) + places
    return torch.minimum(forward, latest)
