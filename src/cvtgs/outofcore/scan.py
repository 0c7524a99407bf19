"""Scan of the whole scene: data that all blocks need, and the k-d partition into blocks."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from cvtgs import analysis, cells, cvt, filters, validity
from cvtgs.analysis import EffectPlan, SceneAnalysis
from cvtgs.analysis.analyze import (
    add_depths,
    apparent_areas,
    empty_depth_grid,
    visibility_at,
    visibility_grid,
)
from cvtgs.analysis.effects import select_columns
from cvtgs.boxes import Box, inside
from cvtgs.cells.moments import mass_unit
from cvtgs.config import SimplifyConfig
from cvtgs.devices import HOST, one_thread
from cvtgs.grouping import curve_order
from cvtgs.io.ply import PlyRows
from cvtgs.io.tensors import map_tensors, save_tensors, under_prefix
from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KdPartition:
    """A k-d tree (Bentley 1975) whose leaves are blocks; a single block has no nodes."""

    axes: Int[Tensor, "k"]  # along which each node splits
    thresholds: Float[Tensor, "k"]  # coordinate of the splitting plane; points below it go left
    children: Int[Tensor, "k 2"]  # left and right; ``-1 - b`` is block b

    def blocks_of(self, points: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Return the block of every point."""
        nodes = torch.full((len(points),), 0 if len(self.axes) else -1)
        while bool((nodes >= 0).any()):
            inner = nodes.clamp_min(0)
            coordinates = points.gather(1, self.axes[inner][:, None])[:, 0]
            side = (coordinates >= self.thresholds[inner]).long()
            nodes = torch.where(nodes >= 0, self.children[inner, side], nodes)
        return -1 - nodes


def partition_space(
    points: Float[Tensor, "n 3"], measure: Float[Tensor, "n"], count: int
) -> KdPartition:
    """Split space into blocks of equal measure, each time along the axis of largest variance."""
    axes, thresholds, children = list[int](), list[float](), list[list[int]]()

    def split(rows: Tensor, first: int, blocks: int) -> int:
        """Split rows into some blocks from a first one on; return their node."""
        if blocks == 1:
            return -1 - first
        node, half = len(axes), blocks // 2
        part, weights = points[rows], measure[rows]
        shares = (weights / weights.sum().clamp_min(1e-300))[:, None]
        variance = (shares * (part - (shares * part).sum(dim=0)).square()).sum(dim=0)
        axis = int(variance.argmax())
        threshold = _weighted_quantile(part[:, axis], weights, half / blocks)
        axes.append(axis)
        thresholds.append(threshold)
        children.append([])
        left = part[:, axis] < threshold
        below = split(rows[left], first, half)
        children[node] = [below, split(rows[~left], first + half, blocks - half)]
        return node

    split(torch.arange(len(points)), 0, count)
    return KdPartition(
        axes=torch.tensor(axes, dtype=torch.int64),
        thresholds=torch.tensor(thresholds, dtype=torch.float64),
        children=torch.tensor(children, dtype=torch.int64).reshape(-1, 2),
    )


def _weighted_quantile(coordinates: Tensor, weights: Tensor, share: float) -> float:
    """Return a coordinate below which the given share of the weight lies."""
    if len(coordinates) == 0:
        return 0.0
    order = torch.sort(coordinates, stable=True).indices
    below = weights[order].cumsum(0)
    rank = int(torch.searchsorted(below, share * below[-1])) + 1
    ascending = coordinates[order]
    low, high = ascending[max(0, rank - 1)], ascending[min(rank, len(order) - 1)]
    middle = float((low + high) / 2)
    return middle if middle > float(low) else float(high)


SAMPLE_ROWS = 1 << 18  # size of the sample from which frame, effect plan and partition are computed
CHUNK = 1 << 15  # number of rows that are read together, and mapped together for a sample
DEVIATIONS = 4.0  # standard deviations of the number of rows that a filter from the sample leaves
_GOLDEN = 0.6180339887498949  # multiples of it are spread evenly between whole numbers


class RangeTotals(NamedTuple):
    """Sums over the valid rows of a range; of masses by chunk, since their order changes bits."""

    depths: Int[Tensor, "voxels"]  # optical depths (:func:`cvtgs.analysis.analyze.add_depths`)
    masses: tuple[float, ...]  # opacity times mean projected area, squared scene units
    falloff_masses: tuple[float, ...]  # the same times the perspective falloff
    far_masses: tuple[Float[Tensor, "f"], ...]  # the same of each beyond the distance of flyaways
    invalid_rows: Counter[str]  # by the attribute that is NaN, infinite or zero
    valid_count: int
    kept_count: int  # valid rows in boxes

    @property
    def mass(self) -> float:
        """Mass of all valid rows."""
        return reduce(add, self.masses, 0.0)

    @property
    def falloff_mass(self) -> float:
        """Mass of all valid rows, times the perspective falloff."""
        return reduce(add, self.falloff_masses, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneScan:
    """Data of the whole scene that all blocks need."""

    frame: RobustFrame
    plan: EffectPlan
    visibility: Float[Tensor, "voxels"]  # :func:`cvtgs.analysis.analyze.visibility_grid`
    min_opacity: float  # the filter leaves out Gaussians of lower opacity
    min_faint_mass: float  # and of a smaller apparent mass than this; infinite: of any mass,
    max_flyaway_mass: float  # and flyaways of at most this mass times falloff; -1: none
    mean_weight: float  # in the tessellation, before the floor
    cell_weight: float  # heavier Gaussians count as one cell; 0 if all do
    partition: KdPartition  # the blocks, in contracted space
    view_components: Float[Tensor, "c k"]  # :func:`cvtgs.cells.view_components`
    mass: float  # opacity times mean projected area of all valid Gaussians, squared scene units
    mass_unit: float  # of the masses in moments (:func:`cvtgs.cells.moments.mass_unit`)
    invalid_rows: dict[str, int]  # by the attribute that is NaN, infinite or zero
    row_count: int  # valid Gaussians outside boxes
    kept_count: int  # valid Gaussians in boxes


def read_sample(source: PlyRows, count: int) -> GaussianScene:
    """Read one of every k Gaussians, about ``count``; return the valid ones."""
    step = max(1, source.count // count)
    rows = step * max(1, CHUNK // step)
    parts = (
        _one_of(source.read(start, min(start + rows, source.count)), step)
        for start in range(0, source.count, rows)
    )
    return validity.valid_part(source.assemble(parts, -(-source.count // step)))


def read_chunks(source: PlyRows) -> Iterator[GaussianScene]:
    """Read the valid Gaussians chunk by chunk."""
    for start in range(0, source.count, CHUNK):
        rows = source.read(start, min(start + CHUNK, source.count))
        yield validity.valid_part(source.scene(rows))


def _one_of(rows: NDArray[Any], step: int) -> NDArray[Any]:
    """Return one of every ``step`` rows, each at another place: the order may be periodic."""
    firsts = np.arange(0, len(rows), step)
    places = np.floor(np.arange(len(firsts)) * _GOLDEN % 1 * step).astype(np.int64)
    found: NDArray[Any] = rows[np.minimum(firsts + places, len(rows) - 1)]
    return found


@one_thread()
def scan_range(
    source: PlyRows, frame: RobustFrame, boxes: tuple[Box, ...], rows: range
) -> RangeTotals:
    """Sum optical depths, masses and counts over a range of the source."""
    depths = empty_depth_grid(HOST)
    all_masses, falloff_masses, valid_count, kept_count = list[float](), list[float](), 0, 0
    far_masses, found = list[Tensor](), Counter[str]()
    for start in range(rows.start, rows.stop, CHUNK):
        scene = source.scene(source.read(start, min(start + CHUNK, rows.stop)))
        invalid = validity.invalid_rows(scene)
        if invalid:
            found.update({name: int(mask.sum()) for name, mask in invalid.items()})
            scene = scene.select(~validity.any_row(scene, invalid))
        masses = scene.masses
        add_depths(depths, scene.means, masses, frame)
        distances = frame.distances(scene.means)
        seen = masses * analysis.perspective_falloff(distances)
        far_masses.append(seen[distances > filters.FLYAWAY_RADII])
        all_masses.append(float(masses.sum()))
        falloff_masses.append(float(seen.sum()))
        valid_count += len(scene)
        kept_count += int(inside(boxes, scene.means).sum())
    return RangeTotals(
        depths,
        tuple(all_masses),
        tuple(falloff_masses),
        tuple(far_masses),
        found,
        valid_count,
        kept_count,
    )


def add_totals(parts: Iterable[RangeTotals]) -> RangeTotals:
    """Add up the totals of all ranges; the grid of the first is changed in place."""
    rest = iter(parts)  # one after the other: a grid has dozens of megabytes
    total = next(rest)
    for part in rest:
        depths, *own = total
        total = RangeTotals(depths.add_(part.depths), *map(add, own, part[1:]))
    return total


def scan_scene(
    sample: GaussianScene,
    totals: RangeTotals,
    *,
    boxes: tuple[Box, ...],
    target: int,
    cell_count: int,
    blocks: int,
    config: SimplifyConfig,
    frame: RobustFrame,
) -> SceneScan:
    """Choose filter thresholds that keep the target, scale of the weights and partition."""
    grid = visibility_grid(totals.depths)
    sample = select_columns(sample, config.effects)
    known = analysis.analyze(sample, config)
    visibility = visibility_at(grid, sample.means, frame)
    distances = frame.distances(sample.means)
    apparent = apparent_areas(known.areas, distances, visibility, config=config.cvt)
    known = replace(known, apparent_areas=apparent, visibility=visibility)
    free = (~inside(boxes, sample.means)).nonzero()[:, 0]
    if boxes and len(free):
        sample, known = sample.select(free), known.select(free)
    row_count = totals.valid_count - totals.kept_count
    rows_per_sample, mean_mass = row_count / max(1, len(sample)), totals.mass / totals.valid_count
    least = -int(-target // rows_per_sample)
    if rows_per_sample > 1:  # a part of the rows estimates how many stay
        least += math.ceil(DEVIATIONS * math.sqrt(least))
    no_flyaways = config.filter.model_copy(update={"max_flyaway_share": 0.0})
    is_partial = known.plan.haze.active and config.filter.max_mass_share < 1.0
    usual = filters.filter_rows(sample, known, 1, no_flyaways).rows
    faintest = float(known.opacities[usual].amin()) if is_partial else math.inf
    rows = filters.filter_rows(sample, known, min(len(sample), least), no_flyaways).rows
    min_opacity = min(faintest, config.filter.min_opacity)
    faint = faint_masses(known.opacities[rows], known.apparent_areas[rows], min_opacity)
    power = config.cvt.area_power
    weights = cvt.gaussian_weights(known.opacities, known.apparent_areas, area_power=power)[rows]
    mean_weight = float(weights.mean()) or 1.0
    weights = weights.clamp_min(mean_weight * config.cvt.weight_floor)
    cell_weight = _cell_weight(weights, cell_count / rows_per_sample)
    shares = in_cells(weights, cell_weight)
    # So no block has more than about twice the average of Gaussians or of their weight.
    measure = 0.5 / len(shares) + 0.5 * shares / shares.sum()
    return SceneScan(
        frame=frame,
        plan=known.plan,
        visibility=grid,
        min_opacity=min_opacity,
        min_faint_mass=float(faint.amin()),
        max_flyaway_mass=_max_flyaway_mass(totals, config.filter.max_flyaway_share),
        mean_weight=mean_weight,
        cell_weight=cell_weight,
        partition=partition_space(frame.contract(sample.means[rows]), measure, blocks),
        view_components=_view_components(sample, known, rows, config),
        mass=totals.mass,
        mass_unit=float(mass_unit(known.masses, mean_mass)),
        invalid_rows=totals.invalid_rows,
        row_count=row_count,
        kept_count=totals.kept_count,
    )


def faint_masses(
    opacities: Float[Tensor, "n"], apparent_areas: Float[Tensor, "n"], min_opacity: float
) -> Float[Tensor, "n"]:
    """Return apparent masses, none of Gaussians that are never drawn; infinite if not faint."""
    masses = apparent_areas.double() * opacities * (opacities >= MIN_ALPHA)
    return torch.where(opacities < min_opacity, masses, torch.inf)


def _view_components(
    sample: GaussianScene, known: SceneAnalysis, rows: Int[Tensor, "k"], config: SimplifyConfig
) -> Float[Tensor, "c k"]:
    """Return the components of the view-dependent colour by which cells of all blocks compare."""
    if not config.allocation.compares_view_colors:
        return torch.zeros(0, 0, dtype=torch.float64)
    masses = (known.apparent_areas * known.opacities)[rows]
    order = curve_order(sample, rows, known.frame, masses=masses)
    return cells.view_components(sample, rows[order], masses[order])


def _max_flyaway_mass(totals: RangeTotals, max_share: float) -> float:
    """Return the largest mass of a flyaway that is left out; -1 if none is left out."""
    ascending = torch.sort(torch.cat(totals.far_masses)).values
    max_share *= len(ascending) <= filters.most_flyaways(totals.valid_count)
    left_out = ascending[ascending.cumsum(0) <= max_share * totals.falloff_mass]
    return float(left_out[-1]) if max_share > 0 and len(left_out) else -1.0


def in_cells(weights: Float[Tensor, "n"], cell_weight: float) -> Float[Tensor, "n"]:
    """Return how many cells each Gaussian needs, at most one; heavier ones than a cell need one."""
    return (weights / cell_weight).clamp_max(1.0) if cell_weight > 0 else torch.ones_like(weights)


def _cell_weight(weights: Float[Tensor, "n"], cells: float) -> float:
    """Return, by bisection, the w at which ``sum min(1, weights / w)`` is the number of cells."""
    low, high = 0.0, float(weights.sum())
    for _ in range(100):
        middle = (low + high) / 2
        if float(in_cells(weights, middle).sum()) > cells:
            low = middle
        else:
            high = middle
    return high


def write_scan(scan: SceneScan, path: Path) -> None:
    """Write a scan: tensors as they are, other values as JSON, each under its dotted name."""
    values = _named_fields(scan)
    for name in ("frame", "partition"):
        values |= _named_fields(values.pop(name), f"{name}.")
    values["plan"] = scan.plan.model_dump()
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    others = {name: value for name, value in values.items() if name not in tensors}
    save_tensors(path, tensors, {"values": json.dumps(others)})


def _named_fields(part: SceneScan | RobustFrame | KdPartition, prefix: str = "") -> dict[str, Any]:
    return {prefix + field.name: getattr(part, field.name) for field in fields(part)}


def read_scan(path: Path) -> SceneScan:
    """Read a scan that :func:`write_scan` wrote."""
    tensors, texts = map_tensors(path)
    values: dict[str, Any] = {**tensors, **json.loads(texts["values"])}
    frame = RobustFrame(**under_prefix("frame.", values))
    partition = KdPartition(**under_prefix("partition.", values))
    plan = EffectPlan.model_validate(values.pop("plan"))
    rest = {name: value for name, value in values.items() if "." not in name}
    return SceneScan(frame=frame, partition=partition, plan=plan, **rest)
