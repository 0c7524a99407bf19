"""Match finished blocks to images of the full scene and refine them, one by one.

In images of the full scene, only the block itself shows all of its Gaussians; the other blocks show
their simplified ones, fixed and the same as in images of the small scene. Only the block differs.
"""

from collections.abc import Sequence
from statistics import mean
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis import drop_unused_bands, restore_columns, select_columns
from cvtgs.devices import one_thread
from cvtgs.io import load
from cvtgs.matching import cell_contributions, match_views
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merge import BlockCells, read_cells, read_report, write_block
from cvtgs.outofcore.rows import kept_rows
from cvtgs.refinement import refine
from cvtgs.rendering import observe
from cvtgs.report import MatchReport, RefineReport
from cvtgs.scene import GaussianScene, concatenate
from cvtgs.views import CameraPositions, find_view_positions, mixed_views

NEAR = 0.5
"""Camera positions depend on Gaussians around a block up to this share of its diagonal away."""


LATER_SEED = 307
"""Added to the seed, so that views for refinement differ from those for matching."""


class Drawn(NamedTuple):
    """The scenes that are rendered while a block is improved.

    Attributes:
        small: The fixed Gaussians, then those of the simplified block.
        full: The fixed Gaussians, then the members of the cells of the block.
        fixed: Number of fixed Gaussians: protected ones, and the simplified ones of other blocks.
        positions: Possible positions of cameras that look at the block.
    """

    small: GaussianScene
    full: GaussianScene
    fixed: int
    positions: CameraPositions


@one_thread()
def improve(job: Job, block: int) -> None:
    """Match a simplified block to images and refine it; other blocks are rendered unimproved."""
    if job.improved_path(block).exists():
        return
    own, found, config = load(job.small_path(block)), read_cells(job, block), job.config
    drawn = _draw(job, block, own, found)
    small, changes, observed = drawn.small, dict[str, Any](), None
    if config.match.enabled and config.uses_renders:
        choices = config.visibility
        views = mixed_views(
            drawn.positions, choices.views, size=choices.size, seed=config.seed, sharp=False
        )
        views = views.interleaved(choices.stride).in_both_modes()
        observed = observe(drawn.full, views)
        targets = cell_contributions(observed.contributions[drawn.fixed :], found.partition)
        small, changes["matching"] = match_views(
            small,
            observed,
            torch.nn.functional.pad(targets, (drawn.fixed, 0)),
            config=config.match,
            frozen=drawn.fixed,
        )
    if config.refine.enabled:
        number = min(config.refine.images, config.refine.steps) + config.refine.heldout
        size, seed = config.refine.size, config.seed + LATER_SEED
        cameras = mixed_views(drawn.positions, max(2, number), size=size, seed=seed, sharp=False)
        small, changes["refinement"] = refine(
            small,
            drawn.full,
            cameras=cameras,
            config=config.refine,
            seed=config.seed,
            device="cpu",
            frozen=drawn.fixed,
            observed=observed if config.shares_images else None,
        )
    rows = torch.arange(drawn.fixed, len(small))
    improved = own.with_tensors(small.select(rows).tensors(), own.extras)
    improved = restore_columns(improved, found.original, job.read_scan().plan)
    changes["mass_out"] = float(improved.masses.sum())
    report = read_report(job, block).model_copy(update=changes)
    write_block(job, block, improved, report, is_improved=True)


def _draw(job: Job, block: int, own: GaussianScene, found: BlockCells) -> Drawn:
    """Read the other simplified blocks, and build the scenes to render."""
    plan, effects = job.read_scan().plan, job.config.effects

    def bare(scene: GaussianScene) -> GaussianScene:
        used = drop_unused_bands(select_columns(scene, effects), plan)
        return used.with_tensors({}, {})

    parts = [bare(job.source.scene(rows)) for rows in kept_rows(job)]
    parts += [
        bare(load(job.small_path(other))) for other in job.blocks_with_cells() if other != block
    ]
    own, members = bare(own), bare(found.scene)
    fixed = concatenate([*parts, own.select(torch.arange(0))])
    near = _near(fixed.means, own.means)
    return Drawn(
        small=concatenate([fixed, own]),
        full=concatenate([fixed, members]),
        fixed=len(fixed),
        positions=find_view_positions(concatenate([members, fixed.select(near)])),
    )


def _near(means: Float[Tensor, "n 3"], own: Float[Tensor, "m 3"]) -> Tensor:
    """Return a mask of the positions in or around a block."""
    low, high = own.amin(dim=0), own.amax(dim=0)
    reach = NEAR * (high - low).norm()
    near: Tensor = ((means >= low - reach) & (means <= high + reach)).all(dim=1)
    return near


def join_matchings(reports: Sequence[MatchReport]) -> MatchReport:
    """Combine the reports of all blocks: sums of views, means of PSNR."""
    return MatchReport(
        views=sum(report.views for report in reports),
        opacities_kept=all(report.opacities_kept for report in reports),
        psnr_before=mean(report.psnr_before for report in reports),
        psnr_after=mean(report.psnr_after for report in reports),
        backend=reports[0].backend,
    )


def join_refinements(reports: Sequence[RefineReport]) -> RefineReport:
    """Combine the reports of all blocks: sums of steps, views and seconds, means of PSNR."""
    stops = {report.stopped for report in reports}
    cost = reports[0].cost
    return RefineReport(
        steps=sum(report.steps for report in reports),
        images=sum(report.images for report in reports),
        heldout=sum(report.heldout for report in reports),
        psnr_before=mean(report.psnr_before for report in reports),
        psnr_after=mean(report.psnr_after for report in reports),
        gain=mean(report.gain for report in reports),
        changed_count=sum(report.changed_count for report in reports),
        stopped=stops.pop() if len(stops) == 1 else "steps",
        backend=reports[0].backend,
        device=reports[0].device,
        cost=cost.model_copy(
            update={
                "seconds": sum(report.cost.seconds for report in reports),
                "cpu_seconds": sum(report.cost.cpu_seconds for report in reports),
            }
        ),
    )
