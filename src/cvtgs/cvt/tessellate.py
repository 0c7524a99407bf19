"""Weighted centroidal Voronoi tessellation: seeds, Lloyd's algorithm, labels, empty cells."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.checks import check_range, checked
from cvtgs.config import TessellationConfig
from cvtgs.counts import check_not_negative, checked_whole
from cvtgs.cvt.nearest import NearestSite, nearest_site, search_device, search_once_per_position
from cvtgs.devices import move_together
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.segments import label_argmin, label_sums, running_sums, smallest_rows
from cvtgs.text import short_repr

MIN_SAMPLES = 1 << 15  # smallest sample of points for Lloyd; fewer would save next to no time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tessellation:
    """Points grouped into cells.

    Attributes:
        labels: ``(n,)`` cell of every point, 0 to m - 1, int64; every cell has a point.
        sites: ``(m, d)`` sites that the labels refer to, float64, on the device of the search.
        energies: ``sum w |x - site|^2`` before every Lloyd iteration, over the points that Lloyd
            samples; if it stops early, also after the last one. A single 0 if every point is a
            cell.
        energy: The same for the final labels, over all points.
        refilled: Number of empty cells that received a point from another cell.
    """

    labels: Int[Tensor, "n"]
    sites: Float[Tensor, "m d"]
    energies: tuple[float, ...]
    energy: float
    refilled: int

    __repr__ = short_repr


@checked
def tessellate(
    points: Float[Tensor, "n d"],
    weights: Float[Tensor, "n"],
    count: int,
    *,
    config: TessellationConfig,
    seed: int = 0,
    has_duplicates: bool = False,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> Tessellation:
    """Group points into a weighted centroidal Voronoi tessellation (Du et al. 1999).

    Args:
        points: Positions in the order of :func:`cvtgs.math.frames.morton_order`, which the
            stratified seeds follow and which halves the time of the search.
        weights: Weights, at least 0.
        count: Number of cells, 1 to n.
        config: Seeding and iterations.
        seed: Seed of weighted seeding.
        has_duplicates: Whether runs of equal points are searched once each, which does not change
            the result.
        on_iteration: Called with the number of finished Lloyd iterations.

    Returns:
        Labels and sites; exactly ``count`` cells, none empty.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to n, shapes do not fit together, or, if
            ``count`` is below n, a weight is negative or a value is not finite.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [5, 0, 0], [5.1, 0, 0]])
        >>> tessellate(points, torch.ones(3), 2, config=TessellationConfig()).labels.tolist()
        [0, 1, 1]
    """
    count = checked_whole(count, "count", most=len(points), things="points")
    points, weights, home = points.detach(), weights.detach(), points.device
    if count == len(points):  # nothing to group
        own = torch.arange(count, device=home)
        return Tessellation(
            labels=own, sites=points.double(), energies=(0.0,), energy=0.0, refilled=0
        )
    nearest = search_once_per_position if has_duplicates else nearest_site
    points, weights = move_together([points, weights], search_device(home))
    seeds = choose_seeds(weights, count, config=config, seed=seed)
    sample, sample_weights = sample_points(points, weights, config.samples_per_site * count)
    settled = lloyd(
        sample,
        sample_weights,
        points[seeds],
        nearest=nearest,
        iterations=config.iterations,
        tolerance=config.tolerance,
        on_iteration=on_iteration,
    )
    sites = settled.sites
    labels, squared = nearest(points, sites)
    labels, squared, refilled = fill_empty_cells(labels, weights, squared, count)
    return Tessellation(
        labels=labels.to(home),
        sites=sites,
        energies=settled.energies,
        energy=float((weights * squared).sum()),
        refilled=refilled,
    )


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
    seed = checked_whole(seed, "seed", least=0)
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
    count = checked_whole(count, "count", most=len(weights), things="points")
    if _checked_sum(weights) == 0.0:
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
        steps = torch.arange(free, dtype=torch.float32, device=weights.device)
        middles = (steps + 0.5) * (total[-1] / free)
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
    count = checked_whole(count, "count", most=len(weights), things="points")
    _checked_sum(weights.detach())
    uniform = torch.rand(len(weights), generator=generator, dtype=torch.float64, device="cpu")
    keys = -torch.log(uniform.clamp_min(1e-300)).to(weights.device) / weights.double()
    chosen = torch.sort(keys, stable=True).indices[:count]
    return torch.sort(chosen).values


def _checked_sum(weights: Float[Tensor, "n"]) -> float:
    """Return the sum of weights; raise unless all are finite and at least 0."""
    least, most, total = torch.stack([*weights.aminmax(), weights.sum()]).tolist()  # one wait
    if not (least >= 0.0 and most < math.inf):
        row = int((~((weights >= 0.0) & (weights < math.inf))).nonzero()[0])
        raise InvalidArgumentError(
            f"weights must be finite and at least 0, found {float(weights[row])} in row {row}."
        )
    return float(total)


def sample_points(
    points: Float[Tensor, "n d"], weights: Float[Tensor, "n"], size: int
) -> tuple[Float[Tensor, "k d"], Float[Tensor, "k"]]:
    """Take a weighted sample that represents all points, or all if it saves less than half."""
    enough = max(size, MIN_SAMPLES)
    if size == 0 or enough >= len(points) // 2:
        return points, weights
    rows, shares = stratified_seeds(weights, enough)
    return points[rows], shares


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LloydResult:
    """The final sites of Lloyd's algorithm, and energies as of :class:`Tessellation`."""

    sites: Float[Tensor, "m d"]
    energies: tuple[float, ...]


@checked
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
        sites: Initial sites.
        nearest: Nearest-site search.
        iterations: Largest number of iterations.
        tolerance: Stop when an iteration lowers the energy by no more than this share.
        on_iteration: Called with the number of finished iterations.

    Returns:
        The moved sites and the energies.

    Raises:
        InvalidArgumentError: Shapes do not fit together, ``iterations`` or ``tolerance`` is
            negative, or ``tolerance`` or the energy is not a finite number of at least 0.

    Example:
        >>> from cvtgs.cvt import nearest_scipy
        >>> points = torch.tensor([[0.0], [1.0], [8.0]])
        >>> lloyd(
        ...     points, torch.ones(3), points[[0, 2]], nearest=nearest_scipy,
        ...     iterations=2, tolerance=0.0,
        ... ).sites.tolist()
        [[0.5], [8.0]]
    """
    iterations = checked_whole(iterations, "iterations", least=0)
    check_not_negative(tolerance, "tolerance")
    energies: list[float] = []
    points, weights, sites = points.detach(), weights.detach(), sites.detach().double()
    for done in range(iterations):
        labels, squared = nearest(points, sites)
        energies.append(float((weights * squared).sum()))
        if not 0.0 <= energies[-1] < math.inf:
            raise InvalidArgumentError(
                f"points and weights must be finite, and weights at least 0, "
                f"found an energy of {energies[-1]}."
            )
        if done > 0 and energies[-2] - energies[-1] <= tolerance * energies[-2]:
            break
        totals, sums = weighted_sums(points, weights, labels, len(sites))
        sites = centroids(totals, sums, sites)
        on_iteration(done + 1)
    return LloydResult(sites=sites, energies=tuple(energies))


def weighted_sums(
    points: Float[Tensor, "n d"], weights: Float[Tensor, "n"], labels: Int[Tensor, "n"], count: int
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m d"]]:
    """Sum weights and weighted points per label, in float64."""
    columns = [torch.ones_like(weights), *points.unbind(1)]
    sums = label_sums(columns, labels, count, weights.double())
    return sums[0], sums[1:].T


def centroids(
    totals: Float[Tensor, "m"], sums: Float[Tensor, "m d"], fallback: Float[Tensor, "m d"]
) -> Float[Tensor, "m d"]:
    """Divide sums by total weights; labels without weight take the fallback."""
    filled = totals > 0
    means = sums / totals.where(filled, 1.0)[:, None]
    return torch.where(filled[:, None], means, fallback)


@checked
def fill_empty_cells(
    labels: Int[Tensor, "n"], weights: Float[Tensor, "n"], squared: Float[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"], int]:
    """Move one point into every empty cell: those of the largest weight times squared distance.

    Each cell keeps its cheapest point, so no cell becomes empty. A point in a cell of its own
    costs nothing, so the energy never rises.

    Args:
        labels: Cell of every point.
        weights: Weights of the points.
        squared: Squared distance of every point to its site.
        count: Number of cells, at most n.

    Returns:
        New labels, new squared distances, and the number of cells that were empty.

    Raises:
        InvalidArgumentError: Shapes do not fit together, ``count`` is outside 1 to n, or (on the
            host) a label is out of range, or a weight times a squared distance is negative or NaN.

    Example:
        >>> labels, _, refilled = fill_empty_cells(
        ...     torch.tensor([0, 0]), torch.ones(2), torch.tensor([0.0, 4.0]), 2
        ... )
        >>> labels.tolist(), refilled
        ([0, 1], 1)
    """
    count = checked_whole(count, "count", most=len(labels), things="points")
    check_range(labels, count - 1, "labels")
    members = torch.bincount(labels, minlength=count)
    empty = (members == 0).nonzero()[:, 0]
    if len(empty) == 0:
        return labels, squared, 0
    cost = weights * squared
    check_range(cost, math.inf, "weights times squared distances")
    cheapest = label_argmin(cost, labels, count)[members > 0]
    movable = torch.ones(len(labels), dtype=torch.bool, device=labels.device)
    movable[cheapest] = False
    candidates = movable.nonzero()[:, 0]
    moved = candidates[smallest_rows(-cost[candidates], len(empty))]
    labels, squared = labels.clone(), squared.clone()
    labels[moved], squared[moved] = empty.to(labels.dtype), 0.0
    return labels, squared, len(empty)
