"""The survey: what all blocks must know of the whole scene, from a sample and one pass over it."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs import analysis as an
from cvtgs import cvt, filters, validity
from cvtgs.analysis import EffectPlan, SceneAnalysis, analyze, apparent_areas, select_columns
from cvtgs.boxes import Box, inside
from cvtgs.config import SimplifyConfig
from cvtgs.io.ply import PlyRows
from cvtgs.math.frames import RobustFrame
from cvtgs.outofcore.cuts import Cuts, cut_space
from cvtgs.scene import GaussianScene

SAMPLE = 1 << 18
"""Gaussians that stand for all where frame, plan and cuts are found."""

CHUNK = 1 << 17
"""Rows that are read together."""


class Depths(NamedTuple):
    """What one pass over some rows adds up.

    Attributes:
        sums: The grid of optical depths (:func:`cvtgs.analysis.add_depths`).
        mass: Opacity times area of all Gaussians, squared scene units.
        seen: The same as it looks from the middle.
        far: ``(f,)`` that of each Gaussian beyond 100 robust radii.
        valid: Number of valid rows.
        kept: Number of those in boxes.
    """

    sums: Int[Tensor, "voxels"]
    mass: float
    seen: float
    far: Float[Tensor, "f"]
    valid: int
    kept: int


class Survey(NamedTuple):
    """What all blocks must know of the whole scene.

    Attributes:
        frame: Centre and radius of the scene.
        plan: What the scene calls for.
        light: Light per voxel; empty if nobody asks.
        faintest: Gaussians of lower opacity are left out.
        lightest: So are those beyond 100 radii whose mass, as seen, is not above this.
        unit: Mean weight in the tessellation, before there is a least one.
        floor: Least weight.
        step: Weight of one cell; what weighs more counts as one cell.
        power: Power of the area in the weight.
        cuts: The blocks, in contracted space.
        mass: Opacity times area of all Gaussians, squared scene units.
        rows: Gaussians that are valid and in no box.
        kept: Gaussians that are in a box.
    """

    frame: RobustFrame
    plan: EffectPlan
    light: Float[Tensor, "voxels"]
    faintest: float
    lightest: float
    unit: float
    floor: float
    step: float
    power: float
    cuts: Cuts
    mass: float
    rows: int
    kept: int


def take_sample(source: PlyRows) -> GaussianScene:
    """Read Gaussians at equal steps over the file."""
    step = max(1, source.count // SAMPLE)
    parts = []
    for start in range(0, source.count, CHUNK * step):
        stop = min(start + CHUNK * step, source.count)
        parts.append(source.scene(source.read(start, stop, step)))
    whole = _joined(parts)
    return whole.select(validity.valid_rows(whole))


def add_up(
    source: PlyRows, frame: RobustFrame, boxes: tuple[Box, ...], start: int, stop: int
) -> Depths:
    """Look at some rows."""
    sums = an.empty_depth_grid(torch.device("cpu"))
    mass, seen_mass, valid, kept, far = 0.0, 0.0, 0, 0, [torch.zeros(0, dtype=torch.float64)]
    for first in range(start, stop, CHUNK):
        scene = source.scene(source.read(first, min(first + CHUNK, stop)))
        rows = validity.valid_rows(scene)
        if not bool(rows.all()):
            scene = scene.select(rows)
        masses = scene.masses
        an.add_depths(sums, scene.means, masses, frame)
        seen = masses * an.perspective_falloff(frame.distances(scene.means))
        far.append(seen[frame.distances(scene.means) > filters.FLYAWAY_RADII])
        mass, seen_mass = mass + float(masses.sum()), seen_mass + float(seen.sum())
        valid += len(scene)
        kept += int(inside(boxes, scene.means).sum()) if boxes else 0
    return Depths(sums, mass, seen_mass, torch.cat(far), valid, kept)


def total(parts: Iterable[Depths]) -> Depths:
    """Add up what was found in parts of a file."""
    first, *others = parts
    sums, far = first.sums, [first.far]
    mass, seen, valid, kept = first.mass, first.seen, first.valid, first.kept
    for part in others:
        sums += part.sums
        far.append(part.far)
        mass, seen = mass + part.mass, seen + part.seen
        valid, kept = valid + part.valid, kept + part.kept
    return Depths(sums, mass, seen, torch.cat(far), valid, kept)


def survey(
    sample: GaussianScene,
    depths: Depths,
    *,
    boxes: tuple[Box, ...],
    target: int,
    blocks: int,
    config: SimplifyConfig,
    frame: RobustFrame,
    with_filter: bool = True,
) -> Survey:
    """Decide, once for all blocks, what a scene in one piece decides for itself.

    A block gets half its measure from the number of Gaussians and half from their weight, so it
    has at most twice the mean of either.
    """
    light = an.visibility_grid(depths.sums)
    small = select_columns(sample, config.effects)
    first = analyze(small, config)
    here = an.visibility_at(light, small.means, frame)
    far = frame.distances(small.means)
    seen = apparent_areas(first.areas, far, here, config=config.cvt)
    known = SceneAnalysis(
        frame=frame,
        farthest=float(far.amax()),
        opacities=first.opacities,
        areas=first.areas,
        apparent_areas=seen,
        visibility=here,
        plan=first.plan,
    )
    rows = depths.valid - depths.kept
    if boxes:
        free = (~inside(boxes, small.means)).nonzero()[:, 0]
        if len(free):
            small, known = small.select(free), known.select(free)
    stands_for = rows / max(1, len(small))
    entering = torch.arange(len(small))
    faintest, lightest = 0.0, -1.0
    if with_filter:
        least = min(len(small), -int(-target // stands_for))
        no_flyaways = config.filter.model_copy(update={"max_flyaway_share": 0.0})
        entering = filters.filter_rows(small, known, least, no_flyaways).rows
        faintest = min(float(small.opacities[entering].amin()), config.filter.min_opacity)
        lightest = _lightest_flyaway(depths, config.filter.max_flyaway_share)
    power = known.area_power(config.cvt)
    weights = cvt.gaussian_weights(small.opacities, known.apparent_areas, power)[entering]
    unit = float(weights.mean()) or 1.0
    floor = unit * config.cvt.weight_floor
    weights = weights.clamp_min(floor)
    step = _step(weights, target / stands_for)
    shares = (weights / step).clamp_max(1.0) if step > 0 else torch.ones_like(weights)
    measure = 0.5 / len(shares) + 0.5 * shares / shares.sum()
    places = frame.contract(small.means[entering])
    return Survey(
        frame=frame,
        plan=known.plan,
        light=light,
        faintest=faintest,
        lightest=lightest,
        unit=unit,
        floor=floor,
        step=step,
        power=power,
        cuts=cut_space(places, measure, blocks),
        mass=depths.mass,
        rows=rows,
        kept=depths.kept,
    )


def _lightest_flyaway(depths: Depths, share: float) -> float:
    """Return the largest mass of a flyaway that is left out."""
    lightest_first = torch.sort(depths.far).values
    out = lightest_first[lightest_first.cumsum(0) <= share * depths.seen]
    return float(out[-1]) if share > 0 and len(out) else -1.0


def _step(weights: Float[Tensor, "n"], cells: float) -> float:
    """Find the weight of a cell such that Gaussians count as so many cells, none as more than 1."""
    low, high = 0.0, float(weights.sum())
    for _ in range(100):
        middle = (low + high) / 2
        if middle <= 0.0:
            return 0.0
        if float((weights / middle).clamp_max(1.0).sum()) > cells:
            low = middle
        else:
            high = middle
    return high


def _joined(parts: list[GaussianScene]) -> GaussianScene:
    first = parts[0]
    if len(parts) == 1:
        return first
    tensors = [part.tensors() for part in parts]
    names = [name for name in first.extras if all(name in part.extras for part in parts)]
    return first.with_tensors(
        {name: torch.cat([one[name] for one in tensors]) for name in tensors[0]},
        {name: torch.cat([part.extras[name] for part in parts]) for name in names},
    )
