"""Choose the few numbers and the few colour functions that a SOG stores."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

CODES = 256
PALETTE = 1 << 16
_ITERATIONS = 30
_KNOTS = 4096
_RELATIVE_ROUNDING = 1e-5
"""Variances below this share of the mean square may be rounding errors of float32."""


class Codebook(NamedTuple):
    """Numbers in ascending order, and the index of the one that replaces each value."""

    codes: Float[np.ndarray, "256"]
    labels: UInt8[np.ndarray, "*n"]


def codebook(values: Float[np.ndarray, "*n"]) -> Codebook:
    """Find 256 numbers that values are rounded to with little squared error.

    One-dimensional k-means (Lloyd 1982) on the sorted values, from codes whose density follows
    the cube root of that of the values (Panter and Dite 1951). Up to 256 different values are
    kept. Memory: three copies of the values in float64.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    codes = _first_codes(ordered)
    for _ in range(_ITERATIONS):
        inner = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2)
        bounds = np.concatenate([[0], inner, [len(ordered)]])
        counts = np.diff(bounds)
        means = np.diff(sums[bounds]) / np.maximum(counts, 1)
        codes = np.sort(np.where(counts > 0, means, codes))
    codes = codes.astype(np.float32)
    labels = np.searchsorted((codes[1:] + codes[:-1]) / 2, values).astype(np.uint8)
    return Codebook(codes, labels)


def _first_codes(ordered: Float[np.ndarray, "n"]) -> Float[np.ndarray, "256"]:
    different = np.flatnonzero(np.diff(ordered, prepend=-np.inf))
    if len(different) <= CODES:
        few: Float[np.ndarray, 256] = ordered[different]
        return np.pad(few, (0, CODES - len(few)), "edge")
    count = min(len(ordered), _KNOTS)
    knots = ordered[np.linspace(0, len(ordered) - 1, count).round().astype(np.int64)]
    passed = np.concatenate([[0.0], np.cumsum(np.diff(knots) ** (2 / 3))])
    codes: Float[np.ndarray, 256] = np.interp(np.linspace(0, passed[-1], CODES), passed, knots)
    return codes


class Palette(NamedTuple):
    """At most 65,536 rows, and the index of the one that replaces each of the given rows."""

    entries: Float[np.ndarray, "p d"]
    labels: Int[np.ndarray, "n"]


def palette_size(count: int) -> int:
    """Return the number of entries for so many rows: a power of 2, at least half of them.

    As splat-transform does. A palette of all rows is most of a file of a small scene: 452 of 668 kB
    of 15,000 Gaussians.
    """
    return min(PALETTE, 1 << max(10, count.bit_length() - 1))


def palette(rows: Float[np.ndarray, "n d"], most: int | None = None) -> Palette:
    """Find a few rows that replace many.

    Up to ``most`` rows are kept. Of more, the half of the groups with the largest squared errors is
    split, each at the mean of its most varied column (after Wu 1991, many groups at once), until
    there are ``most``; entries are means of groups. This takes seconds for a million rows, where
    k-means would take an hour on a CPU. Memory: three copies of the rows.
    """
    most = palette_size(len(rows)) if most is None else most
    if len(rows) <= most:
        return Palette(rows, np.arange(len(rows)))
    middle = rows.mean(axis=0)  # about it, squares lose no digits
    shifted = torch.from_numpy(rows - middle)
    squares = shifted.square()
    order, starts = torch.arange(len(rows)), torch.zeros(1, dtype=torch.int64)
    before = 0
    while before < len(starts) < most:
        before = len(starts)
        order, starts = _split(shifted, squares, order, starts, most=most)
    labels = np.empty(len(rows), np.int64)
    labels[order.numpy()] = _groups(starts, len(rows)).numpy()
    return Palette(_means(shifted, order, starts).numpy() + middle, labels)


def _split(
    rows: Tensor, squares: Tensor, order: Tensor, starts: Tensor, *, most: int
) -> tuple[Tensor, Tensor]:
    """Split the half of the groups with the largest errors; give the new order and starts."""
    means, mean_squares = _means(rows, order, starts), _means(squares, order, starts)
    variances = mean_squares - means.square()
    variances = torch.where(variances > _RELATIVE_ROUNDING * mean_squares, variances, 0.0)
    errors = variances.sum(dim=1) * torch.diff(starts, append=starts.new_tensor([len(rows)]))
    count = min(most - len(starts), max(1, len(starts) // 2), int((errors > 0).sum()))
    chosen = torch.zeros(len(starts), dtype=torch.bool)
    chosen[torch.sort(errors, descending=True, stable=True).indices[:count]] = True
    column, groups = variances.argmax(dim=1), _groups(starts, len(rows))
    above = rows[order, column[groups]] > means.gather(1, column[:, None])[groups, 0]
    step = torch.sort(2 * groups + (above & chosen[groups]), stable=True)
    new_starts = torch.nn.functional.pad(step.values.diff(), (1, 0), value=1).nonzero()[:, 0]
    return order[step.indices], new_starts


def _groups(starts: Tensor, count: int) -> Tensor:
    """Return the number of the group of every place."""
    ends = torch.cat([starts[1:], starts.new_tensor([count])])
    return torch.repeat_interleave(ends - starts)


def _means(rows: Tensor, order: Tensor, starts: Tensor) -> Tensor:
    """Average the rows of every group, without a copy of them in its order."""
    return torch.nn.functional.embedding_bag(order, rows, starts, mode="mean")
