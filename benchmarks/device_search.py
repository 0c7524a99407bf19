"""Compare a nearest-site search in torch operations on the device with the host's k-d tree.

cvtgs copies positions to the host and searches there. The search in this file stays on the device.
It is exact, its cost is nearly linear in the number of points, and it takes few operations.
``python -m benchmarks.device_search`` prints seconds, comparisons and operations for growing
sizes; ``benchmarks.gpu`` has a table of both searches on a GPU.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from cvtgs.cvt import nearest_scipy

FAN = 8
"""Number of children of a box, and of sites in a leaf."""

CHUNK = 1 << 13
"""Points per chunk on a CPU; chunks on other devices are 32 times as large."""


class Found(NamedTuple):
    """Nearest sites.

    Attributes:
        labels: ``(n,)`` the nearest site of every point; the first of equally near sites.
        squared: ``(n,)`` squared distances, float64.
        compared: Total number of comparisons of points with boxes and sites.
    """

    labels: Int[Tensor, "n"]
    squared: Float[Tensor, "n"]
    compared: int


class Boxes(NamedTuple):
    """Bounds of runs of sites; a level has one box per ``FAN`` boxes of the level below.

    Attributes:
        low: ``(d, b)`` smallest coordinates.
        high: ``(d, b)`` largest coordinates.
    """

    low: Float[Tensor, "d b"]
    high: Float[Tensor, "d b"]


def nearest_by_boxes(points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]) -> Found:
    """Find the nearest site of every point through a tree of boxes along a Morton curve.

    The sites next to a point on the curve give an upper bound of its distance. Level by level,
    points keep the boxes within that bound. Distances to boxes and to sites are rounded alike, so
    rounding drops no box.

    Args:
        points: Positions.
        sites: Positions on the same device, at least one.

    Returns:
        Labels, squared distances and the number of comparisons.
    """
    columns, low = points.double().T.contiguous(), sites.double().amin(dim=0)
    side = (sites.double().amax(dim=0) - low).clamp_min(torch.finfo(torch.float64).tiny)
    codes = curve_codes(sites.double(), low, side)
    codes, order = torch.sort(codes, stable=True)
    levels = tree_of(sites.double()[order].T.contiguous())
    chunk = CHUNK * (1 if points.device.type == "cpu" else 32)
    parts = []
    for start in range(0, len(points), chunk):
        part = points[start : start + chunk].double()
        places = torch.searchsorted(codes, curve_codes(part, low, side))
        parts.append(_search(columns[:, start : start + chunk], places, levels, order))
    labels, squared, compared = zip(*parts, strict=True)
    return Found(torch.cat(labels), torch.cat(squared), sum(compared))


def curve_codes(
    points: Float[Tensor, "n d"], low: Float[Tensor, "d"], side: Float[Tensor, "d"]
) -> Int[Tensor, "n"]:
    """Return clamped positions along a Morton curve in any number of dimensions."""
    bits = 62 // points.shape[1]
    steps = ((points - low) / side * (2**bits - 1)).clamp(0, 2**bits - 1).long()
    codes = torch.zeros_like(steps[:, 0])
    for bit in range(bits):
        for axis, column in enumerate(steps.unbind(1)):
            codes |= (column >> bit & 1) << (bit * points.shape[1] + axis)
    return codes


def tree_of(sites: Float[Tensor, "d m"]) -> list[Boxes]:
    """Return levels of boxes, the sites first; each level is padded with its last box."""
    levels = [Boxes(sites, sites)]
    while levels[-1].low.shape[1] > FAN:
        full = [torch.cat([x, x[:, -1:].expand(-1, -x.shape[1] % FAN)], dim=1) for x in levels[-1]]
        levels[-1] = Boxes(*full)
        low, high = (x.unflatten(1, (-1, FAN)) for x in full)
        levels.append(Boxes(low.amin(dim=2), high.amax(dim=2)))
    return levels


def _search(
    points: Float[Tensor, "d n"],
    places: Int[Tensor, "n"],
    levels: list[Boxes],
    order: Int[Tensor, "m"],
) -> tuple[Tensor, Tensor, int]:
    count, device = points.shape[1], points.device
    own = torch.arange(count, device=device)
    # The sites of two runs around the position give the upper bound.
    starts = (places - FAN).clamp(0, max(0, len(order) - 2 * FAN))
    near = (starts[:, None] + torch.arange(2 * FAN, device=device)).clamp_max(len(order) - 1)
    bounds = _squared(points, own[:, None], near, levels[0]).amin(dim=1)
    boxes = torch.arange(levels[-1].low.shape[1], device=device)
    rows, nodes = own.repeat_interleave(len(boxes)), boxes.repeat(count)
    compared = near.numel()
    for number, level in enumerate(reversed(levels)):
        if number:
            children = nodes[:, None] * FAN + torch.arange(FAN, device=device)
            last = level.low.shape[1] - 1  # padding has no children
            rows, nodes = rows.repeat_interleave(FAN), children.flatten().clamp_max(last)
        squared = _squared(points, rows, nodes, level)
        compared += len(rows)
        kept = (squared <= bounds[rows]).nonzero()[:, 0]
        rows, nodes, squared = rows[kept], nodes[kept], squared[kept]
    best = bounds.scatter_reduce(0, rows, squared, "amin")
    found = order[nodes.clamp_max(len(order) - 1)]  # padding is the last site
    found = torch.where(squared == best[rows], found, len(order))
    labels = torch.full((count,), len(order), device=device)
    return labels.scatter_reduce(0, rows, found, "amin"), best, compared


def _squared(points: Tensor, rows: Tensor, nodes: Tensor, level: Boxes) -> Tensor:
    """Return squared distances of points to boxes, column by column to save memory."""
    total = torch.zeros((), dtype=torch.float64, device=points.device)
    for column, low, high in zip(points, *level, strict=True):
        place = column[rows]
        total = total + torch.maximum(low[nodes] - place, place - high[nodes]).clamp_min(0).square()
    return total


class Operations(TorchDispatchMode):
    """Counts operations; each is one kernel launch or a few."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        self.count += 1
        return func(*args, **(kwargs or {}))


def sample(count: int, axes: int, device: torch.device) -> Float[Tensor, "n d"]:
    """Return points on a sphere, with smooth colours in the other columns."""
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)
    colors = 0.1 * torch.sin(5 * points) + 0.01 * torch.randn(count, 3, generator=generator)
    return torch.cat([points, colors], dim=1)[:, :axes].to(device)


def seconds(
    search: Callable[[Tensor, Tensor], tuple[Tensor, Tensor] | Found], points: Tensor, sites: Tensor
) -> float:
    """Return CPU seconds of a search on a CPU, and wall-clock seconds on other devices."""
    clock = time.process_time if points.device.type == "cpu" else time.perf_counter
    start = clock()
    float(search(points, sites)[1].sum())  # waits for the device
    return clock() - start


def search_table(
    device: torch.device, counts: Sequence[int], *, axes: int, share: float
) -> list[str]:
    """Return Markdown lines that compare both searches for growing numbers of points."""
    lines = [
        f"| points of {axes} numbers, sites | k-d tree on the host s | boxes on the device s "
        f"| comparisons for each point | operations |",
        "|---|---|---|---|---|",
    ]
    for count in counts:
        points = sample(count, axes, device)
        sites = points[:: round(1 / share)] + 1e-3
        nearest_by_boxes(points[:100], sites)  # loads kernels
        tree, boxes = (seconds(one, points, sites) for one in (nearest_scipy, nearest_by_boxes))
        with Operations() as operations:
            found = nearest_by_boxes(points, sites)
        lines.append(
            f"| {count:,}, {len(sites):,} | {tree:.3f} | {boxes:.3f} "
            f"| {found.compared / count:.0f} | {operations.count:,} |"
        )
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 200_000, 1_000_000])
    parser.add_argument("--axes", type=int, choices=(3, 6), default=6, help="6 with colours")
    parser.add_argument("--share", type=float, default=0.02, help="sites per point")
    options = parser.parse_args()
    device = torch.device(options.device)
    print("\n".join(search_table(device, options.counts, axes=options.axes, share=options.share)))


if __name__ == "__main__":
    main()
