"""Compare the search for nearest sites on a device with the k-d tree on the host.

``python -m benchmarks.device_search`` prints seconds for growing numbers of points, and
``benchmarks.gpu`` has this table of a GPU. On a CPU, where cvtgs uses the tree, it shows how the
other search grows.
"""

import argparse
import time
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cvt import nearest_scipy
from cvtgs.cvt.device_search import nearest_in_tiles

Search = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def sample(count: int, axes: int, device: torch.device) -> Float[Tensor, "n d"]:
    """Return points on a sphere, with smooth colours in the other columns."""
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)
    colors = 0.1 * torch.sin(5 * points) + 0.01 * torch.randn(count, 3, generator=generator)
    return torch.cat([points, colors], dim=1)[:, :axes].to(device)


def seconds(search: Search, points: Tensor, sites: Tensor) -> float:
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
        f"| points of {axes} numbers, sites | k-d tree on the host s | tiles on the device s |",
        "|---|---|---|",
    ]
    for count in counts:
        points = sample(count, axes, device)
        sites = points[:: round(1 / share)] + 1e-3
        nearest_in_tiles(points, sites)  # loads kernels
        tree, tiles = (seconds(one, points, sites) for one in (nearest_scipy, nearest_in_tiles))
        lines.append(f"| {count:,}, {len(sites):,} | {tree:.3f} | {tiles:.3f} |")
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 200_000, 1_000_000])
    parser.add_argument("--axes", type=int, choices=(3, 6), default=6, help="6 with colours")
    parser.add_argument("--share", type=float, default=0.08, help="sites per point")
    options = parser.parse_args()
    if not 0 < options.share <= 1:
        parser.error(f"--share must be above 0 and at most 1; found {options.share:g}.")
    device = torch.device(options.device)
    print("\n".join(search_table(device, options.counts, axes=options.axes, share=options.share)))


if __name__ == "__main__":
    main()
