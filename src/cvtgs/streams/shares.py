"""Shares of blocks in the levels of a stream, from the cells of a sample of the whole scene."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.analysis import SceneAnalysis, drop_unused_bands
from cvtgs.analysis.analyze import apparent_areas, visibility_at
from cvtgs.analysis.effects import select_columns
from cvtgs.config import SimplifyConfig
from cvtgs.filters import filter_rows
from cvtgs.grouping import OrderedRows, allocate, order_rows, tessellate_rows, weigh_rows
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import BlockRows, analysis_of
from cvtgs.outofcore.scan import read_sample
from cvtgs.scene import GaussianScene

SAMPLED = 1 << 15  # size of the sample; fewer than twice as many rows are read

PRIOR_CELLS = 4.0  # added to the cells found and expected in a block, so that few mean little
POWER = 0.75  # of the factors on weights; below 1, since cells of blocks end at their borders


def block_shares(
    job: Job, ratios: Sequence[float], weights: Sequence[float], *, sh_degree: int | None
) -> list[list[float]]:
    """Estimate the share of each block in the cells of levels with these ratios, in any unit.

    A sample is grouped as a scene in one piece, so blocks where merging costs more have more cells.
    """
    sample = read_sample(job.source, SAMPLED)
    if job.blocks == 1 or len(sample) == 0:
        return [list(weights) for _ in ratios]
    sample = select_columns(sample, job.config.effects)
    if sh_degree is not None:
        sample = sample.with_sh_degree(sh_degree)
    scan = job.read_scan()
    visibility = visibility_at(scan.visibility, sample.means, scan.frame)
    distances = scan.frame.distances(sample.means)
    areas = apparent_areas(sample.areas, distances, visibility, config=job.config.cvt)
    analysis = analysis_of(scan, BlockRows(sample, areas, visibility))
    sample = drop_unused_bands(sample, scan.plan)
    blocks = scan.partition.blocks_of(scan.frame.contract(sample.means))
    ordered, known = order_rows(sample, analysis, job.config), torch.tensor(weights).double()
    found = list[list[float]]()
    for ratio in ratios:
        target = max(1, round(ratio * len(sample)))
        if target >= len(sample):
            found.append(list(weights))
            continue
        rows, labels = _group(sample, analysis, target, job.config, ordered)
        parts = 1.0 / torch.bincount(labels, minlength=target).double()[labels]
        counts = torch.bincount(blocks[rows], parts, minlength=job.blocks)
        expected = known / known.sum().clamp_min(1e-300) * target
        factors = (counts + PRIOR_CELLS) / (expected + PRIOR_CELLS)
        found.append((known * factors**POWER).tolist())
    return found


def _group(
    sample: GaussianScene,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    ordered: OrderedRows,
) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Return the rows of a sample that the filter leaves, and the cell of each."""
    rows = filter_rows(sample, analysis, target, config.filter).rows
    points = weigh_rows(sample, rows, analysis, config, ordered=ordered)
    tessellation = tessellate_rows(points, analysis, target, config)
    return points.rows, allocate(points, tessellation, analysis, target, config.allocation)
