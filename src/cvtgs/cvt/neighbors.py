"""The nearest other sites of every site."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt.distinct import runs_of_equal
from cvtgs.cvt.nearest_scipy import build_tree

MAX_ENTRIES = 1 << 23
"""Largest number of distances held at one time by the torch search."""

TINY_SHIFT = 1e-9
"""Coincident sites are parted by at most this share of the extent of all sites."""


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
