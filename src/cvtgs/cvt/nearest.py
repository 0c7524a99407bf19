"""Nearest sites and neighbours: by scipy's k-d tree on the host, or in tiles on CUDA."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.checks import checked
from cvtgs.counts import checked_whole
from cvtgs.cvt.device_search import nearest_in_tiles
from cvtgs.devices import HOST, thread_count
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import robust_frame
from cvtgs.math.segments import ascending_rows

NearestSite = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps points ``(n, d)`` and sites ``(m, d)`` to labels and squared distances ``(n,)``."""

CHUNK = 1 << 15  # points per chunk of a search thread, to bound memory
TINY_SHIFT = 1e-9  # largest shift of coincident sites, as a share of the robust radius of all


def search_device(device: torch.device) -> torch.device:
    """Return where the sites nearest to points of a device are searched: there, or on the host."""
    return device if device.type == "cuda" else HOST


def search_name(device: torch.device) -> str:
    """Return the name of the search on a device, for reports."""
    return "tiles" if device.type == "cuda" else "scipy"


@checked
def nearest_site(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Find the nearest site of every point, on CUDA if they are there, else on the host.

    Args:
        points: Positions on any device.
        sites: Positions on the same device, at least one.

    Returns:
        Labels and squared distances in float64. Ties may be resolved in any way.

    Raises:
        InvalidArgumentError: There is no site, shapes do not fit together, or (on the host) a
            coordinate is not finite.

    Example:
        >>> labels, squared = nearest_site(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]]))
        >>> labels.tolist()
        [1]
    """
    return _nearest_distinct(points, sites, search_device(points.device))


@checked
def nearest_scipy(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Find the nearest site of every point with a k-d tree (Maneewongvatana and Mount 1999).

    Distances are computed in float64. Points along a space-filling curve take half the time of
    shuffled ones. The tree is on the host: positions from another device are copied there, and
    the result back. Memory: ``16 n`` bytes for the result, and a chunk of points in float64.

    Args:
        points: Positions on any device.
        sites: Positions, at least one.

    Returns:
        Labels and squared distances in float64. Ties may be resolved in any way.

    Raises:
        InvalidArgumentError: There is no site, shapes do not fit together, or (on the host) a
            coordinate is not finite.

    Example:
        >>> labels, squared = nearest_scipy(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]]))
        >>> labels.tolist()
        [1]
    """
    return _nearest_distinct(points, sites, HOST)


def _nearest_distinct(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], device: torch.device
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Search on a device, with one site of every position: trees cannot separate the others."""
    _check_sites(sites)
    home, points, sites = points.device, points.detach().to(device), sites.detach().to(device)
    runs = runs_of_equal(sites)
    distinct = None if runs is None else torch.sort(runs[0][runs[1] == 0]).values
    found, squared = _nearest_apart(points, sites if distinct is None else sites[distinct], 1)
    labels = found[:, 0] if distinct is None else distinct[found[:, 0]]
    return labels.to(home), squared[:, 0].to(home)


def _check_sites(sites: Float[Tensor, "m d"]) -> None:
    if sites.numel() == 0:
        raise InvalidArgumentError(
            f"sites must hold at least one position, found shape {tuple(sites.shape)}."
        )


def build_tree(sites: Float[Tensor, "m d"]) -> Any:
    """Build scipy's k-d tree, split at the middles of boxes."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 (heavy; `import cvtgs` stays light)

    # Split at medians, boxes of a few far sites would be long: searches there would look at all.
    return cKDTree(sites.double().numpy(), balanced_tree=False)


@checked
def nearest_neighbors(sites: Float[Tensor, "m d"], count: int) -> Int[Tensor, "m k"]:
    """Find the nearest other sites of every site, on CUDA if they are there, else on the host.

    Args:
        sites: Positions on any device.
        count: Number of neighbours per site; fewer if there are fewer other sites.

    Returns:
        Row numbers, k = min(count, m - 1); the site itself is not among them. Ties may be
        resolved in any way.

    Raises:
        InvalidArgumentError: There is no site, shapes or ``count`` do not fit, or (on the host) a
            coordinate is not finite.

    Example:
        >>> nearest_neighbors(torch.tensor([[0.0], [1.0], [9.0]]), 1).tolist()
        [[1], [0], [1]]
    """
    _check_sites(sites)
    count = checked_whole(count, "count", least=0)
    with_self = min(count + 1, len(sites))
    apart = _apart(sites.detach().to(search_device(sites.device)))
    rows, _ = _nearest_apart(apart, apart, with_self)
    # With coincident sites, the site itself may be anywhere or missing: then drop the last one.
    is_self = rows == torch.arange(len(sites), device=rows.device)[:, None]
    if bool(is_self[:, 0].all()):
        return rows[:, 1:].to(sites.device)
    others = torch.sort(is_self.to(torch.uint8), dim=1, stable=True).indices[:, : with_self - 1]
    return rows.gather(1, others).to(sites.device)


def nearest_several(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Return the rows of the sites nearest to every point, nearest first, and their distances."""
    device = search_device(sites.device)
    apart = _apart(sites.detach().to(device))
    more = apart.shape[1] - points.shape[1]
    padded = torch.nn.functional.pad(points.detach().to(device).double(), (0, more))
    rows, squared = _nearest_apart(padded, apart, min(count, len(sites)))
    return rows.to(points.device), squared.sqrt().to(points.device)


def _apart(sites: Float[Tensor, "m d"]) -> Float[Tensor, "m e"]:
    """Add a tiny coordinate that separates coincident sites, which trees compare pairwise."""
    runs = runs_of_equal(sites)
    if runs is None:
        return sites.double()
    (order, ranks), places = runs, sites.double()
    shifts = torch.empty_like(places[:, 0])
    shifts[order] = ranks.double() * (TINY_SHIFT * robust_frame(places).radius / len(sites))
    return torch.cat([places, shifts[:, None]], dim=1)


def _nearest_apart(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Find the nearest of sites that do not coincide, and their squared distances."""
    if sites.device.type == "cuda":
        return nearest_in_tiles(points, sites, count)
    ranks, starts = [*range(1, count + 1)], range(0, len(points), CHUNK)
    rows = np.empty((len(points), count), dtype=np.int64)
    squared = np.empty((len(points), count), dtype=np.float64)
    try:
        tree = build_tree(sites)

        def search(start: int) -> None:
            part = slice(start, start + CHUNK)
            distances, rows[part] = tree.query(points[part].double().numpy(), k=ranks)
            np.square(distances, out=squared[part])

        if len(starts) == 1:
            search(0)
        else:  # in threads of our own: an interrupt would leave scipy's running
            with ThreadPoolExecutor(thread_count()) as pool:
                list(pool.map(search, starts))
    except ValueError as error:
        raise InvalidArgumentError(
            "points and sites must be finite, found NaN or infinite coordinates."
        ) from error
    np.minimum(rows, len(sites) - 1, out=rows)  # one too many where squares of distances overflow
    return torch.from_numpy(rows), torch.from_numpy(squared)


def runs_of_equal(sites: Float[Tensor, "m d"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]] | None:
    """Return an order that makes coincident sites adjacent, and their ranks; None if all differ."""
    # Equal sites have equal sums. Where others share them, some stay apart, which costs only time.
    keys = sites.new_zeros(len(sites), dtype=torch.float64)
    for axis, column in enumerate(sites.unbind(1)):
        keys += column.double() * math.sqrt(1 + axis)  # incommensurable: sums rarely coincide
    order = ascending_rows(keys)
    repeated = torch.zeros(len(sites), dtype=torch.bool, device=sites.device)
    ascending = keys.index_select(0, order)
    candidates = (ascending[1:] == ascending[:-1]).nonzero()[:, 0]
    if len(candidates) == 0:
        return None
    repeated[candidates + 1] = (sites[order[candidates + 1]] == sites[order[candidates]]).all(dim=1)
    if not bool(repeated.any()):
        return None
    places = torch.arange(len(sites), device=sites.device)
    starts = torch.where(repeated, 0, places).cummax(0).values
    return order, places - starts


def search_once_per_position(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Return what :func:`nearest_site` does, but look up runs of equal points only once."""
    is_first = first_of_each(points)
    labels, squared = nearest_site(points[is_first], sites)
    numbers = is_first.cumsum(0) - 1
    return labels[numbers], squared[numbers]


def first_of_each(points: Float[Tensor, "n d"]) -> Bool[Tensor, "n"]:
    """Return which points differ from their predecessor."""
    first = torch.ones(len(points), dtype=torch.bool, device=points.device)
    first[1:] = points[1:, 0] != points[:-1, 0]
    maybe = (~first).nonzero()[:, 0]
    first[maybe] = (points[maybe] != points[maybe - 1]).any(dim=1)
    return first
