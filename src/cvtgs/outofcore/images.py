"""Images in blocks: contributions before cells form, then matching and refinement.

Contributions are measured in images of the whole scene, from the same cameras for all blocks. A
block is rendered with all of its Gaussians; an enlarged sample of the scene stands for the others.

Finished blocks are matched and refined one by one, in images of the full and the small scene that
differ in this block only: the other blocks show their simplified Gaussians in both.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from statistics import mean
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis import drop_unused_bands, restore_columns
from cvtgs.analysis.analyze import measured_areas, visibility_cameras, warn_of_empty_images
from cvtgs.analysis.effects import EffectPlan, drop_mip_tag, select_columns
from cvtgs.boxes import inside
from cvtgs.cameras import Cameras
from cvtgs.clock import join_costs
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.devices import one_thread
from cvtgs.edit import concatenate
from cvtgs.errors import CameraWarning, without_warnings
from cvtgs.evaluation.blind_views import warn_of_blind
from cvtgs.io import load
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.matching import cell_contributions, match_views
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merge import BlockCells, read_cells, read_report, write_block
from cvtgs.outofcore.rows import BlockRows, kept_rows, read_rows
from cvtgs.refinement import refine
from cvtgs.rendering import contributions, observe
from cvtgs.rendering.projection import warn_of_near_plane
from cvtgs.report import MatchReport, RefineReport
from cvtgs.scene import GaussianScene
from cvtgs.tags import TWO_SCALES
from cvtgs.views import CameraPositions, find_view_positions, mixed_views

MEASURED = "measured.json"  # file of the sums over all blocks
SCENE, SEEN, LATER = "scene/", "seen/", "later/"
"""Prefixes of the sample, and of views of the whole scene for matching and for refinement."""

PIXELS_EACH = 2.0
"""Pixels of an image per Gaussian that is kept, from which on all blocks use the same views."""

NEAR = 0.5  # camera positions depend on Gaussians up to this share of a block's diagonal away
SHOWS_BLOCK = 0.1  # share of the pixels of the best camera from which one is used for a block
MOST_SHOWN = 0.01  # largest share of an image that one Gaussian counts for in this
LEAST_CAMERAS = 2  # a refinement trains with one camera at least, and holds out another
LATER_SEED = 307  # added to the seed, so that views for refinement differ from those for matching


@one_thread()
def write_views(job: Job, sample: GaussianScene, *, total: int) -> None:
    """Choose views by a sample of ``total`` Gaussians, or from given cameras; write both."""
    enlarged = sample.log_scales + 0.5 * math.log(total / len(sample))
    tensors = sample.with_sh_degree(0).tensors() | {"log_scales": enlarged}
    contents = add_prefix(SCENE, tensors)
    if job.cameras is None:
        positions = find_view_positions(sample)
        for name, views in _views_from(positions, job.config, sharp=True).items():
            size = torch.tensor([views.width, views.height])
            packed = {"viewmats": views.viewmats, "Ks": views.Ks, "size": size}
            contents |= add_prefix(name, packed)
            if name == SEEN:
                warn_of_near_plane(sample, views.singles(), name="the scene")
    save_tensors(job.views_path, contents, {})


def _views_from(
    positions: CameraPositions, config: SimplifyConfig, *, sharp: bool
) -> dict[str, Cameras]:
    """Choose views for contributions and matching, and others for a refinement."""
    make, seed = partial(mixed_views, positions, sharp=sharp), config.seed
    found = dict[str, Cameras]()
    if config.uses_renders:
        found[SEEN] = make(config.visibility.views, size=config.visibility.size, seed=seed)
    if config.refine.enabled:
        later = later_views(config)
        found[LATER] = make(later, size=config.refine.size, seed=seed + LATER_SEED)
    return found


def _scene_views(job: Job) -> dict[str, Cameras]:
    tensors, found = map_tensors(job.views_path)[0], dict[str, Cameras]()
    for name in (SEEN, LATER):
        own = under_prefix(name, tensors)
        if own:
            width, height = own.pop("size").tolist()
            found[name] = Cameras(**own, width=width, height=height)
    return found


@one_thread()
def measure(job: Job, block: int) -> None:
    """Write the contributions of the Gaussians of a block, and their sums."""
    if job.has("contributions", block):
        return
    scan, rows = job.read_scan(), read_rows(job, block, is_slim=True)
    tensors = map_tensors(job.views_path)[0]
    sample = rows.scene.with_tensors(under_prefix(SCENE, tensors), {})
    given = _scene_views(job)[SEEN] if job.cameras is None else job.cameras
    cameras = visibility_cameras(sample, job.config, cameras=given)
    blocks = scan.partition.blocks_of(scan.frame.contract(sample.means))
    others = sample.select((blocks != block) | inside(job.boxes, sample.means))
    drawn = drop_mip_tag(concatenate([rows.scene, others]), scan.plan)
    found = contributions(drawn, cameras)[: len(rows.scene)].contiguous()
    mass = (rows.apparent_areas * rows.scene.opacities).double().sum()
    tensors = {"contributions": found, "pixels": found.sum(), "mass": mass}
    job.write("contributions", block, tensors)


def add_contributions(job: Job) -> None:
    """Write the sums of masses and contributions over all blocks; warn if images show nothing."""
    sums = {"mass": 0.0, "pixels": 0.0}
    for block in job.blocks_with_rows():
        tensors = job.read("contributions", block)
        sums = {name: total + float(tensors[name]) for name, total in sums.items()}
    if sums["pixels"] == 0.0:
        warn_of_empty_images()
    job.write_file(MEASURED, json.dumps(sums).encode())


def read_apparent_rows(job: Job, block: int, *, is_slim: bool = True) -> BlockRows:
    """Read rows, with the areas that images measured if there are images."""
    rows = read_rows(job, block, is_slim=is_slim)
    if not job.config.uses_renders:
        return rows
    sums = json.loads(job.path(MEASURED).read_bytes())
    if sums["pixels"] == 0.0:
        return rows
    measured = measured_areas(
        rows.apparent_areas,
        rows.scene.opacities,
        job.read("contributions", block)["contributions"],
        mass_per_pixel=torch.tensor(sums["mass"] / sums["pixels"], dtype=torch.float64),
        share=job.config.visibility.mass_share,
    )
    return rows._replace(apparent_areas=measured)


class Drawn(NamedTuple):
    """A block, simplified and full, after protected Gaussians and simplified ones of others."""

    small: GaussianScene
    full: GaussianScene
    fixed: int  # number of the others


@one_thread()
def warn_of_blind_cameras(job: Job) -> None:
    """Warn if most given cameras see nothing of the simplified blocks and the protected rows."""
    if job.cameras is not None:
        parts = _drawn_parts(job, job.read_scan().plan)
        warn_of_blind(concatenate(parts), job.cameras, name="the scene")


@one_thread()
def improve(job: Job, block: int) -> None:
    """Match a block to images and refine it, unless fewer than two given cameras show it."""
    if job.finished_path(block).exists():
        return
    own, found, config = load(job.small_path(block)), read_cells(job, block), job.config
    drawn = draw(job, block, own, found)
    views, later = _choose_views(job, drawn)
    changes, observed, small = dict[str, Any](), None, drawn.small
    if views is not None:
        observed = observe(drawn.full, views)
        targets = cell_contributions(observed.contributions[drawn.fixed :], found.partition)
        small, changes["matching"] = match_views(
            small,
            observed,
            torch.nn.functional.pad(targets, (drawn.fixed, 0)),
            config=config.match,
            frozen=drawn.fixed,
        )
    if later is not None:
        # The run has warned of given cameras; nobody can give better views than generated ones.
        with without_warnings(Warning if job.cameras is None else CameraWarning):
            small, changes["refinement"] = refine(
                small,
                drawn.full,
                cameras=later,
                config=config.refine,
                seed=config.seed,
                device="cpu",
                frozen=drawn.fixed,
                observed=observed if config.shares_images else None,
            )
    improved = own.with_tensors(small[drawn.fixed :].tensors(), own.extras)
    improved = restore_columns(improved, found.original, job.read_scan().plan)
    changes["mass_out"] = float(improved.masses.sum())
    report = read_report(job, block).model_copy(update=changes)
    write_block(job, block, improved, report, is_improved=True)


def _choose_views(job: Job, drawn: Drawn) -> tuple[Cameras | None, Cameras | None]:
    """Return cameras that look at a block, given or new: for matching and for refinement."""
    config = job.config
    matches, refines = config.match.enabled and config.uses_renders, config.refine.enabled
    members = drawn.full[drawn.fixed :]
    if job.cameras is not None:
        shown = cameras_of_block(job.cameras, members)
        if len(shown) < LEAST_CAMERAS:
            return None, None
        views = visibility_cameras(members, config, cameras=shown) if matches else None
        return views, shown if refines else None
    if has_fine_views(config, job.target):
        found = _scene_views(job)
    else:
        fixed = drawn.small[: drawn.fixed]
        near = fixed.select(_near(fixed.means, drawn.small.means[drawn.fixed :]))
        around = find_view_positions(concatenate([members, near]))
        found = _views_from(around, config, sharp=False)
    views = visibility_cameras(members, config, cameras=found[SEEN]) if matches else None
    return views, found[LATER] if refines else None


def has_fine_views(config: SimplifyConfig, count: int) -> bool:
    """Return whether images of the whole scene have enough pixels; else blocks need their own."""
    size = config.visibility.size if config.uses_renders else config.refine.size
    return size**2 >= PIXELS_EACH * count


def later_views(config: SimplifyConfig) -> int:
    """Return the number of views that a refinement needs besides the images of the matching."""
    refine = config.refine
    new = refine.steps * refine.images_per_step
    if config.shares_images:
        new = refine.new_images(refine.steps, shared=config.visibility.views)
    return max(LEAST_CAMERAS, min(refine.images, new) + refine.heldout)


def cameras_of_block(cameras: Cameras, members: GaussianScene) -> Cameras:
    """Return the cameras that show a block, whatever hides it, compared with the best of them."""
    pixels = torch.stack([pixels_of(members, camera) for camera in cameras.singles()])
    rows = ((pixels > 0) & (pixels >= SHOWS_BLOCK * pixels.max())).nonzero()[:, 0]
    return cameras.select(rows)


def pixels_of(members: GaussianScene, camera: Cameras) -> Float[Tensor, ""]:
    """Return the opaque area of all Gaussians with centres in an image, pixels."""
    view, intrinsics = camera.viewmats[0].double(), camera.Ks[0].double()
    local = members.means.double() @ view[:3, :3].T + view[:3, 3]
    x, y, depth = (local @ intrinsics.T).unbind(1)
    is_inside = (depth > 0) & (x > 0) & (x < camera.width * depth)
    is_inside &= (y > 0) & (y < camera.height * depth)
    scales = intrinsics[0, 0] * intrinsics[1, 1] / depth[is_inside].square()
    areas = members.areas[is_inside] * scales
    most = MOST_SHOWN * camera.width * camera.height
    return (members.opacities[is_inside] * areas.clamp_max(most)).sum()


def draw(job: Job, block: int, own: GaussianScene, found: BlockCells) -> Drawn:
    """Read the other simplified blocks, and build the scenes to render."""
    plan = job.read_scan().plan
    own, members = _bare(job, own, plan), _bare(job, found.scene, plan)
    fixed = concatenate([*_drawn_parts(job, plan, without=block), own[:0]])
    return Drawn(
        small=concatenate([fixed, own]), full=concatenate([fixed, members]), fixed=len(fixed)
    )


def _drawn_parts(
    job: Job, plan: EffectPlan, *, without: int | None = None
) -> Sequence[GaussianScene]:
    """Read protected Gaussians, then the simplified ones of all blocks or of all but one."""
    parts = [_bare(job, job.source.scene(rows), plan) for rows in kept_rows(job)]
    others = (block for block in job.blocks_with_cells() if block != without)
    return [*parts, *(_bare(job, load(job.small_path(block)), plan) for block in others)]


def _bare(job: Job, scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Return a scene with what renderers draw alone."""
    used = drop_unused_bands(select_columns(scene, job.config.effects), plan)
    # Only files tell flat Gaussians apart; simplified blocks are thick if the plan says so.
    comments = TWO_SCALES.removed_from(used.comments)
    return replace(used.with_tensors({}, {}), comments=comments, layout=())


def _near(means: Float[Tensor, "n 3"], own: Float[Tensor, "m 3"]) -> Tensor:
    """Return a mask of the positions in or around a block."""
    low, high = own.amin(dim=0), own.amax(dim=0)
    reach = NEAR * (high - low).norm()
    near: Tensor = ((means >= low - reach) & (means <= high + reach)).all(dim=1)
    return near


def join_matchings(reports: Sequence[MatchReport]) -> MatchReport:
    """Combine the reports of all blocks: sums of views, means of PSNR."""
    joined = _joined(reports, sums=("views", "heldout"), means=("psnr_before", "psnr_after"))
    joined["opacities_kept"] = all(report.opacities_kept for report in reports)
    return reports[0].model_copy(update=joined)


def join_refinements(reports: Sequence[RefineReport]) -> RefineReport:
    """Combine the reports of all blocks: sums of steps, views and seconds, means of PSNR."""
    stops = {report.stopped for report in reports}
    joined = _joined(
        reports,
        sums=("steps", "images", "heldout", "changed_count"),
        means=("psnr_before", "psnr_after", "gain"),
    )
    joined["stopped"] = stops.pop() if len(stops) == 1 else "steps"
    (joined["cost"],) = join_costs(report.cost for report in reports)
    return reports[0].model_copy(update=joined)


def _joined(
    reports: Sequence[Record], *, sums: Sequence[str], means: Sequence[str]
) -> dict[str, Any]:
    columns = {name: [getattr(report, name) for report in reports] for name in (*sums, *means)}
    totals = {name: sum(columns[name]) for name in sums}
    return totals | {name: mean(columns[name]) for name in means}
