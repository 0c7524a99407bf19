"""Nearest sites and neighbours: the choice of a backend, and the search by scipy's k-d tree."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt.coincident import NearestSite, distinct_rows, runs_of_equal
from cvtgs.cvt.nearest_torch import nearest_torch
from cvtgs.errors import DeviceError

CHUNK = 1 << 15
"""Points that a thread searches together, to bound memory."""

MAX_ENTRIES = 1 << 23
"""Largest number of distances held at one time by the torch search."""

TINY_SHIFT = 1e-9
"""Coincident sites are parted by at most this share of the extent of all sites."""


def nearest_backend(
    name: Literal["auto", "scipy", "torch"], device: torch.device
) -> tuple[str, NearestSite]:
    """Resolve the name of a backend for a device.

    Args:
        name: ``scipy``, ``torch``, or ``auto``: scipy on a CPU, torch elsewhere.
        device: Where the points are.

    Returns:
        The resolved name and the function.

    Raises:
        DeviceError: scipy was asked for and the points are not on the CPU.

    Example:
        >>> nearest_backend("auto", torch.device("cpu"))[0]
        'scipy'
    """
    if name == "auto":
        name = "scipy" if device.type == "cpu" else "torch"
    if name == "scipy" and device.type != "cpu":
        raise DeviceError(
            f"cvt.backend 'scipy' works on the CPU only, found device {device}; "
            f"use 'torch' or 'auto'."
        )
    return name, nearest_scipy if name == "scipy" else nearest_torch


def nearest_scipy(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Find the nearest site of every point with a k-d tree (Maneewongvatana and Mount 1999).

    Distances are computed in float64. Points along a space-filling curve take half the time of
    shuffled ones. Memory is ``16 n`` bytes for the result, and a chunk of points in float64.

    Args:
        points: Positions on the CPU.
        sites: Positions, at least one.

    Returns:
        Labels and squared distances in float64. Of equally near sites any one may be named.

    Example:
        >>> labels, squared = nearest_scipy(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]]))
        >>> labels.tolist()
        [1]
    """
    distinct = distinct_rows(sites)  # a tree cannot part coincident sites: it would compare all
    tree = build_tree(sites if distinct is None else sites[distinct])
    labels = np.empty(len(points), dtype=np.int64)
    squared = np.empty(len(points), dtype=np.float64)

    def search(start: int) -> None:
        part = slice(start, start + CHUNK)
        distances, labels[part] = tree.query(np.asarray(points[part], np.float64))
        np.square(distances, out=squared[part])

    # Threads of our own: an interrupt waits for them, where scipy's own would be left running.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(search, range(0, len(points), CHUNK)):
            pass
    found = torch.from_numpy(labels)
    return found if distinct is None else distinct[found], torch.from_numpy(squared)


def build_tree(sites: Float[Tensor, "m d"]) -> Any:
    """Build scipy's k-d tree."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 (heavy; `import cvtgs` stays light)

    return cKDTree(np.asarray(sites, dtype=np.float64))


def nearest_neighbors(
    sites: Float[Tensor, "m d"], count: int, *, backend: str
) -> Int[Tensor, "m k"]:
    """Find the nearest other sites of every site.

    Args:
        sites: Positions.
        count: How many neighbours each site gets; fewer if there are not so many others.
        backend: ``scipy`` (CPU only, a k-d tree) or ``torch`` (any device; compares all sites with
            all others in pieces, so time grows with m squared).

    Returns:
        Row numbers, k = min(count, m - 1); the site itself is not among them. Of equally near
        sites any may be named.

    Example:
        >>> nearest_neighbors(torch.tensor([[0.0], [1.0], [9.0]]), 1, backend="scipy").tolist()
        [[1], [0], [1]]
    """
    with_self = min(count + 1, len(sites))
    if backend == "scipy":
        apart = _apart(sites)
        rows, _ = _by_tree(apart, apart, with_self)
    else:
        rows, _ = _by_comparison(sites.double(), sites.double(), with_self)
    # Among coincident sites the site itself may be anywhere, even missing: then the last one goes.
    is_self = rows == torch.arange(len(sites), device=sites.device)[:, None]
    others = torch.sort(is_self.to(torch.uint8), dim=1, stable=True).indices[:, : with_self - 1]
    return rows.gather(1, others)


def nearest_several(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int, *, backend: str
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Find the nearest sites of every point."""
    among = min(count, len(sites))
    if backend == "scipy":
        apart = _apart(sites)
        more = apart.shape[1] - points.shape[1]
        return _by_tree(torch.nn.functional.pad(points.double(), (0, more)), apart, among)
    return _by_comparison(points.double(), sites.double(), among)


def _apart(sites: Float[Tensor, "m d"]) -> Float[Tensor, "m e"]:
    """Add a coordinate that parts coincident sites, which a tree would compare all with all.

    It is so small that among sites that differ, distances stay the same but for rounding.
    """
    runs = runs_of_equal(sites)
    if runs is None:
        return sites.double()
    (order, ranks), places = runs, sites.double()
    extent = float((places.amax(dim=0) - places.amin(dim=0)).amax()) or 1.0
    shifts = torch.empty_like(places[:, 0])
    shifts[order] = ranks.double() * (TINY_SHIFT * extent / len(sites))
    return torch.cat([places, shifts[:, None]], dim=1)


def _by_tree(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    distances, rows = build_tree(sites).query(np.asarray(points), k=[*range(1, count + 1)])
    return torch.from_numpy(rows.astype(np.int64)), torch.from_numpy(distances)


def _by_comparison(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    step = max(1, MAX_ENTRIES // len(sites))
    found = [
        torch.cdist(part, sites, compute_mode="donot_use_mm_for_euclid_dist").topk(
            count, dim=1, largest=False
        )
        for part in points.split(step)
    ]
    return torch.cat([one.indices for one in found]), torch.cat([one.values for one in found])
