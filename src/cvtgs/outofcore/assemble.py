"""The end of an out-of-core run: finished blocks become one file, and their reports one report."""

import os
import warnings
from pathlib import Path

from cvtgs.analysis import select_columns
from cvtgs.clock import StageClock
from cvtgs.counts import shortfall
from cvtgs.errors import DroppedDataWarning
from cvtgs.io import atomic_output, load, save
from cvtgs.io.ply import join_plys
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore.improve import join_matchings, join_refinements
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merge import read_report
from cvtgs.outofcore.rows import kept_rows
from cvtgs.report import SimplifyReport
from cvtgs.scene import concatenate
from cvtgs.simplifier import Simplifier


def assemble_blocks(
    job: Job, output: str | os.PathLike[str], *, axes: str | None, overwrite: bool
) -> None:
    """Write protected rows and blocks behind one another."""
    blocks = [job.finished_path(block) for block in job.blocks_with_cells()]
    if is_plain_ply(output):
        with atomic_output(output, overwrite=overwrite) as file:
            join_plys([*_kept_files(job), *blocks], file)
        return
    kept = [job.source.scene(rows) for rows in kept_rows(job)]
    scene = concatenate([*kept, *map(load, blocks)])
    save(scene, output, overwrite=overwrite, axes=axes)


def is_plain_ply(output: str | os.PathLike[str]) -> bool:
    """Return whether an output is a PLY, into which rows go as they are."""
    name = Path(output).name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def _kept_files(job: Job) -> list[Path]:
    """Write the protected rows as blocks are written: with these columns and axes."""
    paths = []
    for number, rows in enumerate(kept_rows(job)):
        paths.append(job.path(f"unchanged_{number:05d}.ply"))
        scene = select_columns(job.source.scene(rows), job.config.effects)
        save(scene, paths[-1], overwrite=True, axes=job.axes)
    return paths


def report_blocks(
    job: Job,
    simplifier: Simplifier,
    clock: StageClock,
    *,
    energies: tuple[float, ...],
    resumed: int,
) -> SimplifyReport:
    """Add up the reports of all blocks."""
    scan, with_cells = job.read_scan(), job.blocks_with_cells()
    reports = [read_report(job, block) for block in with_cells]
    matchings = [report.matching for report in reports if report.matching is not None]
    refinements = [report.refinement for report in reports if report.refinement is not None]
    total, valid = job.source.count, scan.row_count + scan.kept_count
    if valid < total:
        reasons = ", ".join(f"{name} {number}" for name, number in scan.invalid_rows.items())
        warnings.warn(
            f"dropped {total - valid} of {total} Gaussians with NaN, infinite or zero values "
            f"({reasons}).",
            DroppedDataWarning,
            stacklevel=4,
        )
    tessellated = job.blocks_with_rows() if job.goes_by_steps else []
    parts = [map_tensors(job.parts_path(block))[0] for block in tessellated]
    kept_mass = sum(float(job.source.scene(rows).masses.sum()) for rows in kept_rows(job))
    return SimplifyReport(
        input_count=total,
        output_count=min(job.target, valid),
        target_count=job.target,
        rho=job.target / total,
        invalid_rows=scan.invalid_rows,
        invalid_count=total - valid,
        shortfall=shortfall(valid, total, job.target),
        filtered_count=scan.row_count - sum(report.input_count for report in reports),
        filtered_mass_share=job.left_out_mass / (scan.mass or 1.0),
        kept_count=scan.kept_count,
        single_member_cells=sum(report.single_member_cells for report in reports),
        largest_cell=max((report.largest_cell for report in reports), default=0),
        refilled_cells=sum(report.refilled_cells for report in reports)
        + sum(int(part["refilled"]) for part in parts),
        mass_in=scan.mass,
        mass_out=sum(report.mass_out for report in reports) + kept_mass,
        energies=energies or (reports[0].energies if reports else ()),
        energy=sum(report.energy for report in reports)
        + sum(float(part["energy"]) for part in parts),
        backend=reports[0].backend if reports else "none",
        checkpoint="none" if simplifier.checkpoint is None else simplifier.checkpoint.name,
        plan=scan.plan,
        views="found" if matchings or refinements else "none",
        stages=tuple(clock.costs),
        matching=join_matchings(matchings) if matchings else None,
        refinement=join_refinements(refinements) if refinements else None,
        blocks=job.blocks,
        resumed_blocks=resumed,
        config=simplifier.config,
    )
