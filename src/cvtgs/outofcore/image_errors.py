"""Errors of images of given cameras by the cells of all blocks, which are allocated again by them.

The full and the simplified block are drawn in images of the whole scene, with the simplified
Gaussians of the other blocks in both, and the difference counts for all that is drawn in it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis.analyze import visibility_cameras
from cvtgs.devices import one_thread
from cvtgs.grouping import factors_by_errors
from cvtgs.io import load
from cvtgs.matching import cell_contributions
from cvtgs.outofcore.images import Drawn, draw, pixels_of
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merge import read_cells
from cvtgs.rendering import observe
from cvtgs.rendering.image_errors import LEAST_ERROR, errors_by_view


@one_thread()
def measure_errors(job: Job, block: int) -> None:
    """Write the errors of images by a simplified block, the shares of all cells, and its pixels."""
    if job.has("errors", block):
        return
    own, found = load(job.small_path(block)), read_cells(job, block)
    drawn = draw(job, block, own, found)
    # The same cameras for all blocks, so that their errors add up.
    cameras = visibility_cameras(found.scene, job.config, cameras=job.cameras)
    reached = torch.stack([pixels_of(found.scene, camera) for camera in cameras.singles()])
    shown, sums = (reached > 0).nonzero()[:, 0], torch.zeros(len(cameras), dtype=torch.float64)
    pixels, counts = torch.zeros(len(own)), torch.zeros(len(cameras), dtype=torch.int64)
    numbers = _numbers_of_cells(job, block, drawn)
    cells, shares = [numbers[:0]], [pixels[:0]]
    if len(shown):
        observed = observe(drawn.full, cameras.select(shown))
        pixels = cell_contributions(observed.contributions[drawn.fixed :], found.partition)
        errors = errors_by_view(drawn.small, observed)
        for view, (values, mean) in zip(shown, errors, strict=True):
            rows = ((values > 0) & (numbers >= 0)).nonzero()[:, 0]
            sums[view], counts[view] = mean, len(rows)
            cells.append(numbers[rows])
            shares.append(values[rows].float())
    of_views = {"sums": sums, "counts": counts}
    of_cells = {"cells": torch.cat(cells), "shares": torch.cat(shares)}
    tensors = {"means": own.means, "pixels": pixels, **of_views, **of_cells}
    job.write("errors", block, tensors)


def _numbers_of_cells(job: Job, block: int, drawn: Drawn) -> Int[Tensor, "n"]:
    """Return the number among the cells of all blocks of each that is drawn; -1 if protected."""
    targets = job.targets
    start, own = sum(targets[:block]), targets[block]
    numbers = torch.arange(sum(targets), dtype=torch.int32)
    others = torch.cat([numbers[:start], numbers[start + own :]])
    protected = numbers.new_full((drawn.fixed - len(others),), -1)
    return torch.cat([protected, others, numbers[start : start + own]])


@one_thread()
def compare_errors(job: Job) -> None:
    """Write the factors of the cells of all blocks on masses, which are larger where images err."""
    blocks = job.blocks_with_cells()
    if all(job.has("factors", block) for block in blocks):
        return
    means, pixels = (
        torch.cat([job.read("errors", block)[name] for block in blocks])
        for name in ("means", "pixels")
    )
    power, errors = job.config.match.error_power, _joined_errors(job)
    factors = factors_by_errors(means, errors=errors, pixels=pixels, power=power)
    counts = [count for count in job.targets if count]
    for block, own in zip(blocks, factors.split(counts), strict=True):
        job.write("factors", block, {"factors": own})


def _joined_errors(job: Job) -> Float[Tensor, "m"]:
    """Return the errors of all cells, relative to the mean of each image."""
    parts = [job.read("errors", block) for block in job.blocks_with_cells()]
    sums = torch.stack([part["sums"] for part in parts]).sum(dim=0).clamp_min(LEAST_ERROR)
    errors = torch.zeros(sum(job.targets), dtype=torch.float64)
    for part in parts:
        shares = part["shares"] / sums.repeat_interleave(part["counts"])
        errors.index_add_(0, part["cells"], shares)
    return errors
