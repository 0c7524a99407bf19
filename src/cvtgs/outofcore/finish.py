"""The end of a job: blocks become one file, and a report."""

import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvtgs.errors import DroppedDataWarning
from cvtgs.io import atomic_output, load, save
from cvtgs.io.ply import join_plys
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.survey import Survey
from cvtgs.progress import StageClock
from cvtgs.report import SimplifyReport
from cvtgs.scene import concatenate
from cvtgs.simplifier import Simplifier


def join_blocks(
    job: Job, busy: Sequence[int], output: str | os.PathLike[str], *, overwrite: bool
) -> None:
    """Put protected rows and blocks behind one another."""
    smalls = [job.small_path(block) for block in busy]
    name = Path(output).name.lower()
    if name.endswith(".ply") and not name.endswith(".compressed.ply"):
        with atomic_output(output, overwrite=overwrite) as file:
            join_plys(smalls, file, before=_kept(job))
        return
    scenes = [load(path) for path in smalls]
    scenes[:0] = [job.source.scene(rows) for rows in _kept(job)]
    save(concatenate(scenes), output, overwrite=overwrite)


def _energy_of_light(job: Job, busy: Sequence[int]) -> float:
    """Return the energy of the Gaussians of blocks that keep nothing."""
    light = [block for block in job.filled() if block not in busy]
    return sum(float(map_tensors(job.labels_path(block))[0]["energy"]) for block in light)


def _kept(job: Job) -> list[NDArray[Any]]:
    paths = [job.kept_path(number) for number, _, _ in job.ranges()]
    return [np.memmap(path, job.source.dtype, "r") for path in paths if path.exists()]


def report_of(
    job: Job,
    found: Survey,
    busy: Sequence[int],
    *,
    simplifier: Simplifier,
    clock: StageClock,
    resumed: int,
) -> SimplifyReport:
    """Report what was done."""
    said = [json.loads(job.facts_path(block).read_text(encoding="utf-8")) for block in busy]
    facts = [one["facts"] for one in said]
    total_rows, valid = job.source.count, found.rows + found.kept
    invalid, output_count = total_rows - valid, min(job.target, valid)
    if invalid:
        warnings.warn(
            f"dropped {invalid} of {total_rows} Gaussians with NaN, infinite or zero values.",
            DroppedDataWarning,
            stacklevel=4,
        )
    kept_mass = sum(float(job.source.scene(rows).masses.sum()) for rows in _kept(job))
    in_blocks = sum(one["input_count"] for one in said)
    return SimplifyReport(
        input_count=total_rows,
        output_count=output_count,
        target_count=job.target,
        rho=job.target / total_rows,
        invalid_count=invalid,
        shortfall=(
            f"only {valid} of {total_rows} Gaussians are valid" if valid < job.target else ""
        ),
        filtered_count=found.rows - in_blocks,
        kept_count=found.kept,
        single_member_cells=sum(one.get("single_member_cells", 0) for one in facts),
        largest_cell=max((one.get("largest_cell", 0) for one in facts), default=0),
        refilled_cells=sum(one.get("refilled_cells", 0) for one in facts),
        mass_in=found.mass,
        mass_out=sum(one["mass_out"] for one in facts) + kept_mass,
        energy=sum(one.get("energy", 0.0) for one in facts) + _energy_of_light(job, busy),
        backend=next((one["backend"] for one in facts if "backend" in one), "none"),
        checkpoint="none" if simplifier.checkpoint is None else simplifier.checkpoint.name,
        plan=found.plan,
        stages=tuple(clock.costs),
        blocks=job.blocks,
        resumed_blocks=resumed,
        config=simplifier.config,
    )
