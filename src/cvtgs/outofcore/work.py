"""What processes do with the source: look at it, sort its rows into blocks; and a single block."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs import cvt, filters, validity
from cvtgs.analysis import (
    SceneAnalysis,
    apparent_areas,
    perspective_falloff,
    select_columns,
    visibility_at,
)
from cvtgs.boxes import inside
from cvtgs.config import SimplifyConfig
from cvtgs.devices import one_thread
from cvtgs.math.frames import RobustFrame
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merging import save_block
from cvtgs.outofcore.rows import LIGHT, SEEN, read_rows, record_type
from cvtgs.outofcore.survey import CHUNK, Depths, Survey, add_up
from cvtgs.pipeline import reduce_scene
from cvtgs.progress import StageClock, silent
from cvtgs.scene import GaussianScene


@one_thread()
def look(job: Job, frame: RobustFrame, part: tuple[int, int, int]) -> Depths:
    """Look at one part of the source."""
    return add_up(job.source, frame, job.boxes, part[1], part[2])


@one_thread()
def sort_into_blocks(job: Job, part: tuple[int, int, int]) -> tuple[list[int], list[float]]:
    """Write the rows of one part of the source into one file per block.

    Doing it again writes the same files again.
    """
    survey, _ = job.read_survey()
    number, first, last = part
    for block in range(job.blocks):
        job.rows_path(block, number).unlink(missing_ok=True)
    job.kept_path(number).unlink(missing_ok=True)
    rows, shares = torch.zeros(job.blocks, dtype=torch.int64), torch.zeros(job.blocks).double()
    for start in range(first, last, CHUNK):
        records = job.source.read(start, min(start + CHUNK, last))
        scene = job.source.scene(records)
        valid = validity.valid_rows(scene)
        protected = valid & inside(job.boxes, scene.means) if job.boxes else ~valid & valid
        _append_kept(job, number, records, scene, protected)
        places = (valid & ~protected).nonzero()[:, 0]
        light, seen, places = _entering(survey, job.config, scene, places)
        weights = cvt.gaussian_weights(scene.opacities[places], seen, survey.power)
        weights = weights.clamp_min(survey.floor)
        cells = (weights / survey.step).clamp_max(1.0) if survey.step > 0 else weights * 0 + 1
        points = survey.frame.contract(scene.means[places])
        blocks = survey.cuts.blocks_of(points)
        rows += torch.bincount(blocks, minlength=job.blocks)
        shares += torch.bincount(blocks, cells, minlength=job.blocks)
        order = torch.sort(blocks, stable=True).indices
        table = np.empty(len(order), record_type(job))
        sorted_rows = places[order].numpy()
        for name in records.dtype.names or ():
            table[name] = records[name][sorted_rows]
        table[SEEN], table[LIGHT] = seen[order].numpy(), light[order].numpy()
        _append(job, number, table, torch.bincount(blocks, minlength=job.blocks))
    return rows.tolist(), shares.tolist()


@one_thread()
def simplify_whole(job: Job, block: int) -> None:
    """Simplify the only block of a job, and write it, unless that was done before."""
    survey, targets = job.read_survey()
    if job.small_path(block).exists():
        return
    scene, seen, light = read_rows(job, block)
    scene = select_columns(scene, job.config.effects)
    known = SceneAnalysis(
        frame=survey.frame,
        farthest=0.0,
        opacities=scene.opacities,
        areas=scene.areas,
        apparent_areas=seen,
        visibility=light,
        plan=survey.plan,
    )
    checkpoint = job.network
    net = None if checkpoint is None else checkpoint.net.to(scene.dtype)
    clock, config = StageClock(silent, scene.device), without_filter(job.config)
    reduced = reduce_scene(scene, known, targets[block], config, net=net, clock=clock)
    small = reduced.scene
    facts = reduced.statistics().model_dump() | {"mass_out": float(small.masses.sum())}
    save_block(job, block, small, {"input_count": len(scene), "facts": facts})


def without_filter(config: SimplifyConfig) -> SimplifyConfig:
    """Return the choices for Gaussians of which none is to be left out any more."""
    nothing = {"min_opacity": 0.0, "max_flyaway_share": 0.0}
    return config.model_copy(update={"filter": config.filter.model_copy(update=nothing)})


def _entering(
    survey: Survey, config: SimplifyConfig, scene: GaussianScene, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return light, area as seen and row of the Gaussians that are not left out."""
    means, opacities = scene.means[rows], scene.opacities[rows]
    areas = scene.select(rows).areas
    light = visibility_at(survey.light, means, survey.frame)
    distances = survey.frame.distances(means)
    seen = apparent_areas(areas, distances, light, config=config.cvt)
    enters = opacities >= survey.faintest
    if survey.lightest >= 0.0:
        far = distances > filters.FLYAWAY_RADII
        mass = areas * opacities * perspective_falloff(distances)
        enters &= ~(far & (mass <= survey.lightest))
    return light[enters], seen[enters], rows[enters]


def _append(job: Job, number: int, table: NDArray[Any], counts: Tensor) -> None:
    start = 0
    for block, count in enumerate(counts.tolist()):
        if count:
            with job.rows_path(block, number).open("ab") as file:
                file.write(table[start : start + count].tobytes())
        start += count


def _append_kept(
    job: Job, number: int, records: NDArray[Any], scene: GaussianScene, protected: Tensor
) -> None:
    if not bool(protected.any()):
        return
    kept = records[protected.numpy()]
    logits = validity.with_finite_opacities(scene.select(protected)).logit_opacities
    kept["opacity"] = logits.numpy()
    with job.kept_path(number).open("ab") as file:
        file.write(kept.tobytes())
