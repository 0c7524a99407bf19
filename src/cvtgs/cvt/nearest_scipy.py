"""Nearest site by scipy's k-d tree, on the CPU."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt.distinct import distinct_rows

CHUNK = 1 << 15
"""Points that a thread searches together, to bound memory."""


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
