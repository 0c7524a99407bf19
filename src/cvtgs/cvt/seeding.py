"""Seeds of the tessellation: the points at which sites start."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.checks import checked, checked_sum
from cvtgs.config import TessellationConfig
from cvtgs.counts import check_whole
from cvtgs.math.segments import running_sums


@checked
def choose_seeds(
    weights: Float[Tensor, "n"], count: int, *, config: TessellationConfig, seed: int
) -> Int[Tensor, "m"]:
    """Choose the points at which the sites start.

    Args:
        weights: Weights of the points, in the order of a Morton curve.
        count: Number of sites.
        config: The settings; ``seeding`` is used.
        seed: Seed of the random numbers, if ``seeding`` draws any.

    Returns:
        Rows of the points.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to n, or a weight is negative or not finite.
    """
    check_whole(seed, "seed", least=0)
    if config.seeding == "weighted":
        return weighted_seeds(weights, count, torch.Generator().manual_seed(seed))
    return stratified_seeds(weights, count)[0]


@checked
def stratified_seeds(
    weights: Float[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "count"], Float[Tensor, "count"]]:
    """Take points at equal steps of accumulated weight: systematic sampling, no random numbers.

    Points that weigh at least one step are always taken, and the step is recomputed for the
    others (Madow 1949), so every point is taken at most once.

    Args:
        weights: Weights of points along a space-filling curve, at least 0.
        count: Number of points to take, at most n.

    Returns:
        Row numbers, ascending, and the weight that each taken point represents; these weights
        add up to the sum of ``weights``.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to n, or a weight is negative or not finite.

    Example:
        >>> rows, shares = stratified_seeds(torch.tensor([1.0, 1.0, 1.0, 9.0]), 2)
        >>> rows.tolist(), shares.tolist()
        ([1, 3], [3.0, 9.0])
    """
    weights = weights.detach().double()
    check_whole(count, "count", most=len(weights), things="points")
    if checked_sum(weights, "weights") == 0.0:
        weights = torch.ones_like(weights)
    rows, left = torch.empty(0, dtype=torch.int64, device=weights.device), weights.clone()
    while free := count - len(rows):
        step = float(left.sum()) / free
        heavier = (left >= step).nonzero()[:, 0]
        if len(heavier) == 0 or step == 0.0:
            break
        order = torch.sort(left[heavier], stable=True, descending=True).indices
        rows = torch.cat([rows, heavier[order[:free]]])
        left[rows] = 0.0
    shares = weights[rows]
    if free:  # the middles of equal steps of accumulated weight
        is_other = torch.ones_like(weights, dtype=torch.bool)
        is_other[rows] = False
        others = is_other.nonzero()[:, 0]
        total = running_sums(weights.index_select(0, others))
        middles = (torch.arange(free, device=weights.device) + 0.5) * (total[-1] / free)
        picks = torch.searchsorted(total, middles).clamp_max(len(others) - 1)
        # Weights below one step give distinct picks, except for rounding and zero weights:
        # equal picks move to the next free place.
        places = torch.arange(free, device=weights.device)
        picks = (picks - places).cummax(0).values + places
        picks = torch.minimum(picks, len(others) - free + places)
        rows = torch.cat([rows, others[picks]])
        shares = torch.cat([shares, shares.new_full((free,), step)])
    rows, order = torch.sort(rows)
    return rows, shares[order]


@checked
def weighted_seeds(
    weights: Float[Tensor, "n"], count: int, generator: torch.Generator
) -> Int[Tensor, "count"]:
    """Draw points at random without replacement, with probabilities by weight.

    The points with the smallest ``-log(u) / w`` are taken (Efraimidis and Spirakis 2006).

    Args:
        weights: Weights, at least 0; points of weight 0 are taken last.
        count: Number of points to draw, at most n.
        generator: Random generator on the CPU, so that every device draws the same.

    Returns:
        Row numbers, ascending.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to n, or a weight is negative or not finite.

    Example:
        >>> weighted_seeds(torch.tensor([0.0, 1.0]), 1, torch.Generator().manual_seed(0)).tolist()
        [1]
    """
    check_whole(count, "count", most=len(weights), things="points")
    checked_sum(weights.detach(), "weights")
    uniform = torch.rand(len(weights), generator=generator, dtype=torch.float64, device="cpu")
    keys = -torch.log(uniform.clamp_min(1e-300)).to(weights.device) / weights.double()
    chosen = torch.sort(keys, stable=True).indices[:count]
    return torch.sort(chosen).values
