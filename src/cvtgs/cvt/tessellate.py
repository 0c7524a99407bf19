"""The whole tessellation: seeds, Lloyd, labels, and no empty cell."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.config import TessellationConfig
from cvtgs.cvt.lloyd import lloyd
from cvtgs.cvt.nearest import NearestSite, nearest_backend
from cvtgs.cvt.places import once_per_place
from cvtgs.cvt.seeding import stratified_seeds, weighted_seeds
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.segments import segment_argmax, sort_by_label

MIN_SAMPLES = 1 << 15
"""Lloyd never looks at fewer points than this to save time; so few cost next to nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tessellation:
    """Points grouped into cells.

    Attributes:
        labels: ``(n,)`` cell of every point, 0 to m - 1; every cell has a point.
        sites: ``(m, d)`` sites that the labels belong to.
        energies: ``sum w |x - site|^2`` before every move of Lloyd.
        energy: The same for the final labels, over all points.
        refilled: Cells that were empty and took a point from another cell.
        backend: Name of the nearest-site search.
    """

    labels: Int[Tensor, "n"]
    sites: Float[Tensor, "m d"]
    energies: tuple[float, ...]
    energy: float
    refilled: int
    backend: str


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
        config: Seeding, iterations and backend.
        seed: Seed of weighted seeding.
        has_duplicates: Whether it pays to search for equal points only once; the result is the
            same.
        on_iteration: Told how many Lloyd moves are done.

    Returns:
        Labels and sites; exactly ``count`` cells, none empty.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to n.
        DeviceError: The backend does not work on the device of the points.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [5, 0, 0], [5.1, 0, 0]])
        >>> tessellate(points, torch.ones(3), 2, config=TessellationConfig()).labels.tolist()
        [0, 1, 1]
    """
    if not 1 <= count <= len(points):
        raise InvalidArgumentError(
            f"count must be between 1 and the number of points, {len(points)}; found {count}."
        )
    backend, nearest = search_of(config, points.device, has_duplicates=has_duplicates)
    seeds = first_seeds(weights, count, config=config, seed=seed)
    sample, sample_weights = sampled(points, weights, config.samples_per_site * count)
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
        labels=labels,
        sites=sites,
        energies=settled.energies,
        energy=float((weights * squared).sum()),
        refilled=refilled,
        backend=backend,
    )


def search_of(
    config: TessellationConfig, device: torch.device, *, has_duplicates: bool
) -> tuple[str, NearestSite]:
    """Choose what searches the nearest site."""
    backend, nearest = nearest_backend(config.backend, device)
    return backend, once_per_place(nearest) if has_duplicates else nearest


def first_seeds(
    weights: Float[Tensor, "n"], count: int, *, config: TessellationConfig, seed: int
) -> Int[Tensor, "m"]:
    """Choose the points at which sites start."""
    if config.seeding == "weighted":
        return weighted_seeds(weights, count, torch.Generator().manual_seed(seed))
    return stratified_seeds(weights, count)[0]


def sampled(
    points: Float[Tensor, "n d"], weights: Float[Tensor, "n"], size: int
) -> tuple[Float[Tensor, "k d"], Float[Tensor, "k"]]:
    """Take fewer points, which stand for all by weight, if that saves at least half of them."""
    enough = max(size, MIN_SAMPLES)
    if size == 0 or enough >= len(points) // 2:
        return points, weights
    rows, shares = stratified_seeds(weights, enough)
    return points[rows], shares


def fill_empty_cells(
    labels: Int[Tensor, "n"],
    weights: Float[Tensor, "n"],
    squared: Float[Tensor, "n"],
    count: int,
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"], int]:
    """Return every empty cell one point: those that cost most where they are.

    Each cell keeps its cheapest point, so no cell becomes empty, and a point in a cell of its
    own costs nothing, so the energy never rises.

    Args:
        labels: Cell of every point.
        weights: Weights of the points.
        squared: Squared distances to the own site.
        count: Number of cells, at most n.

    Returns:
        New labels, new squared distances, and how many cells were empty.

    Example:
        >>> labels, _, refilled = fill_empty_cells(
        ...     torch.tensor([0, 0]), torch.ones(2), torch.tensor([0.0, 4.0]), 2
        ... )
        >>> labels.tolist(), refilled
        ([0, 1], 1)
    """
    members = torch.bincount(labels, minlength=count)
    empty = (members == 0).nonzero()[:, 0]
    if len(empty) == 0:
        return labels, squared, 0
    cost = weights * squared
    order, offsets = sort_by_label(labels, count)
    filled = torch.cat([offsets[:1], offsets[1:][members > 0]])
    cheapest = order[segment_argmax(-cost[order], filled)]
    movable = torch.ones(len(labels), dtype=torch.bool, device=labels.device)
    movable[cheapest] = False
    candidates = movable.nonzero()[:, 0]
    dearest = torch.sort(cost[candidates], stable=True, descending=True).indices[: len(empty)]
    moved = candidates[dearest]
    labels, squared = labels.clone(), squared.clone()
    labels[moved], squared[moved] = empty, 0.0
    return labels, squared, len(empty)
