"""Divide the Gaussians of every level into chunks, so that chunks of different levels fit together.

Chunks are formed from the Gaussians of the coarsest level. A Gaussian of a finer level belongs to
the chunk of the coarse Gaussian that replaces most of its input rows, wherever its centre is. So
all levels of a chunk show the same part of the scene, but for a few Gaussians at its border.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.boxes import Corner
from cvtgs.counts import checked_whole, real_number
from cvtgs.cvt import nearest_site
from cvtgs.devices import on_host
from cvtgs.errors import InvalidArgumentError
from cvtgs.io.arrays import morton_rows
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.parameters import rotation_matrices
from cvtgs.report import check_one_scene
from cvtgs.scene import GaussianScene
from cvtgs.text import counted, short_repr, shown

CHUNK_GAUSSIANS = 1 << 15
"""Maximum number of finest Gaussians in a chunk, unless one coarse Gaussian replaces more."""

ENVIRONMENT_GAUSSIANS = 1 << 16
"""Maximum size of the environment, unless the coarsest level has more that far away."""

_SIGMAS = 3.0  # extent of Gaussians in boxes, in standard deviations

_ROUNDING = 1.06  # factor on this extent, for scales and rotations that files round

_SPREAD = (0.05, 0.95)
"""Quantiles whose distance selects the axis of a split; they exclude outlying Gaussians."""

_SAMPLE = 1 << 16  # points used for these quantiles


class StreamedLevel(Protocol):
    """What a stream needs of a level, such as :class:`cvtgs.report.Level`.

    With its ``error_sums``, too, tiles state errors of their own, else that of the level.
    """

    @property
    def scene(self) -> GaussianScene:
        """The Gaussians."""
        ...

    @property
    def geometric_error(self) -> float:
        """Their distance from the Gaussians of the full scene, scene units."""
        ...

    @property
    def assignment(self) -> Int[Tensor, "n"] | None:
        """Row of the Gaussian that replaces each input row, -1 for none; None if all are kept."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamChunk:
    """The same part of a scene at every level.

    Attributes:
        rows: Row numbers in every level, the finest first, along a Morton curve.
        box_min: Minimum coordinates of the Gaussians of all levels, at three sigmas and 6 % more,
            since files round scales and rotations.
        box_max: Maximum coordinates.
    """

    rows: tuple[Int[Tensor, "k"], ...]
    box_min: Corner
    box_max: Corner

    __repr__ = short_repr


class StreamNode(NamedTuple):
    """A node of the tree of chunks.

    Attributes:
        box_min: Minimum coordinates of its chunks.
        box_max: Maximum coordinates.
        children: Two nodes; empty for a leaf.
        chunk: Number of its chunk; None for an inner node.
    """

    box_min: Corner
    box_max: Corner
    children: tuple["StreamNode", ...] = ()
    chunk: int | None = None


class StreamPlan(NamedTuple):
    """The chunks of a stream, in the order of the leaves of its tree.

    Attributes:
        levels: The levels, the finest first.
        chunks: The chunks.
        root: Root of the tree.
        far: Row numbers in every level of the Gaussians that are so far away that they are in no
            chunk, the finest level first; empty if there are none.
    """

    levels: tuple[StreamedLevel, ...]
    chunks: tuple[StreamChunk, ...]
    root: StreamNode
    far: tuple[Int[Tensor, "k"], ...] = ()

    def __repr__(self) -> str:
        """Return the numbers of Gaussians and chunks, not the rows."""
        sizes = ", ".join(f"{len(level.scene):,}" for level in self.levels)
        return f"StreamPlan(levels of {sizes} Gaussians, {counted(len(self.chunks), 'chunk')})"

    @property
    def environment(self) -> GaussianScene | None:
        """The far Gaussians that all levels share; None if there are none."""
        return self.far_scene(environment_level([*map(len, self.far)])) if self.far else None

    def far_scene(self, level: int) -> GaussianScene:
        """Return the far Gaussians of a level."""
        scene = self.levels[level].scene
        return scene.select(self.far[level].to(scene.device))

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of Gaussians in the chunks of each level."""
        rows = zip(*(chunk.rows for chunk in self.chunks), strict=True)
        return tuple(sum(map(len, level)) for level in rows)


_Cut = int | tuple["_Cut", "_Cut"]
"""A node of the tree over the Gaussians of the coarsest level: a chunk, or both sides of a cut."""


@on_host()
@torch.no_grad()
def plan_stream(
    levels: Sequence[StreamedLevel],
    *,
    chunk_gaussians: int = CHUNK_GAUSSIANS,
    environment_radii: float | None = None,
) -> StreamPlan:
    """Build the chunks of a stream of levels.

    Args:
        levels: Levels of one scene, of different sizes, as
            :meth:`~cvtgs.simplifier.Simplifier.levels` returns them.
        chunk_gaussians: Maximum number of finest Gaussians in a chunk. A Gaussian of the
            coarsest level is never split, so a chunk is larger if one replaces more.
        environment_radii: Gaussians farther from the centre than this, in robust radii, are the
            environment, which all levels share; None puts all Gaussians into chunks.

    Returns:
        The plan. Every row of every level is in one chunk, or so far away that the environment
        replaces it.

    Raises:
        InvalidArgumentError: There is no level, two have the same size, they are of scenes of
            different sizes, or a number is out of range.

    Example:
        >>> from cvtgs import Simplifier, synthetic
        >>> levels = Simplifier(device="cpu").levels(synthetic.scene("object", 500), [0.5, 0.05])
        >>> plan = plan_stream(levels, chunk_gaussians=100)
        >>> sum(len(chunk.rows[0]) for chunk in plan.chunks)
        250
    """
    check_environment(environment_radii)
    checked_whole(chunk_gaussians, "chunk_gaussians")
    for level in levels if isinstance(levels, Sequence) else [levels]:
        if not hasattr(level, "assignment"):
            raise InvalidArgumentError(
                f"levels must be those that Simplifier.levels returns, found {shown(level)}."
            )
    check_one_scene(len(_assignment(level)) for level in levels)
    ordered = tuple(sorted(levels, key=lambda level: -len(level.scene)))
    counts = [len(level.scene) for level in ordered]
    if not counts or len(set(counts)) < len(counts):
        raise InvalidArgumentError(
            f"a stream needs levels of different sizes, found levels of {counts}; other ratios "
            f"help a small scene."
        )
    # Every Gaussian of the full scene counts, at the place of the one that replaces it: a small
    # scene has a larger share of far ones.
    rows = _assignment(ordered[0])
    frame = robust_frame(ordered[0].scene.means.to(rows.device)[rows[rows >= 0]])
    near = near_rows(ordered[-1].scene, frame, environment_radii)
    return plan_part(ordered, near, chunk_gaussians=chunk_gaussians)


def check_environment(radii: float | None) -> None:
    """Check the distance at which the environment begins, in robust radii; None for none."""
    if radii is not None and not real_number(radii) >= 0:
        raise InvalidArgumentError(
            f"the environment must begin at a number of radii, at least 0, found {shown(radii)}."
        )


def near_rows(
    coarsest: GaussianScene, frame: RobustFrame, radii: float | None
) -> Bool[Tensor, "c"]:
    """Return a mask of the Gaussians in chunks, at least one; the others are the environment."""
    if radii is None:
        return torch.ones(len(coarsest), dtype=torch.bool)
    distances = frame.distances(coarsest.means).cpu()
    return distances <= max(radii, float(distances.min()))


def plan_part(
    ordered: Sequence[StreamedLevel], near: Bool[Tensor, "c"], *, chunk_gaussians: int
) -> StreamPlan:
    """Build the chunks of a part of a scene; levels are finest first and may have equal sizes."""
    coarsest = ordered[-1]
    means = coarsest.scene.means.double().cpu()
    parents = [_parents(level, coarsest) for level in ordered]
    weights = torch.bincount(parents[0], minlength=len(means)).clamp_min(1)
    tree, parts = _cut(means, weights, near.nonzero()[:, 0], most=chunk_gaussians)
    labels = torch.full((len(means),), -1)
    for number, rows in enumerate(parts):
        labels[rows] = number
    of_levels = [labels[rows] for rows in parents]
    members = [
        _rows(own, level.scene, len(parts)) for level, own in zip(ordered, of_levels, strict=True)
    ]
    chunks = tuple(_chunk(ordered, rows) for rows in zip(*members, strict=True))
    far = () if bool(near.all()) else tuple((own < 0).nonzero()[:, 0] for own in of_levels)
    return StreamPlan(tuple(ordered), chunks, _node(tree, chunks), far)


def environment_level(far: Sequence[int]) -> int:
    """Return the finest level with few enough far Gaussians, by their numbers at each level."""
    fitting = (level for level, count in enumerate(far) if 0 < count <= ENVIRONMENT_GAUSSIANS)
    return next(fitting, max(0, len(far) - 1))


def _parents(level: StreamedLevel, coarsest: StreamedLevel) -> Int[Tensor, "m"]:
    """Return, for each Gaussian of a level, the coarsest one that replaces most of its rows."""
    count, wide = len(level.scene), len(coarsest.scene)
    if level is coarsest:
        return torch.arange(count)
    coarse = _assignment(coarsest)
    own = _assignment(level)
    both = (own >= 0) & (coarse >= 0)
    pairs, votes = torch.unique(own[both] * wide + coarse[both], return_counts=True)
    parents = torch.full((count,), -1)
    if len(pairs):
        ranks = votes * len(pairs) + torch.arange(len(pairs))  # no two are equal
        best = parents.scatter_reduce(0, pairs // wide, ranks, "amax")
        parents = torch.where(best < 0, -1, pairs[best % len(pairs)] % wide)
    missing = (parents < 0).nonzero()[:, 0]  # the coarsest level left out all of their rows
    if len(missing):
        means, sites = level.scene.means.cpu(), coarsest.scene.means.cpu()
        parents[missing], _ = nearest_site(means[missing], sites)
    return parents


def _assignment(level: StreamedLevel) -> Int[Tensor, "n"]:
    if level.assignment is not None:
        return level.assignment.to(torch.int64)
    return torch.arange(len(level.scene))


def _cut(
    means: Float[Tensor, "c 3"], weights: Int[Tensor, "c"], near: Int[Tensor, "k"], *, most: int
) -> tuple[_Cut, list[Int[Tensor, "k"]]]:
    """Split the near Gaussians of the coarsest level until no part replaces more than ``most``."""
    parts, ends = [], torch.tensor(_SPREAD, dtype=means.dtype)

    def part(rows: Int[Tensor, "k"]) -> _Cut:
        if int(weights[rows].sum()) <= most or len(rows) == 1:
            parts.append(rows)
            return len(parts) - 1
        points = means[rows]
        low, high = points[:: 1 + len(points) // _SAMPLE].quantile(ends, dim=0)
        widest = points[:, int((high - low).argmax())]
        order = rows[torch.sort(widest, stable=True).indices]
        passed = weights[order].cumsum(0)
        half = int(torch.searchsorted(passed, int(passed[-1]) // 2))
        half = min(max(half, 1), len(rows) - 1)
        return part(order[:half]), part(order[half:])

    return part(near), parts


def _rows(labels: Int[Tensor, "m"], scene: GaussianScene, count: int) -> list[Int[Tensor, "k"]]:
    """Return the rows of every chunk, along a Morton curve of the whole level."""
    curve = torch.from_numpy(morton_rows(scene.means.detach().cpu().float().numpy()))
    curve = curve[labels[curve] >= 0]
    order = curve[torch.sort(labels[curve], stable=True).indices]
    sizes = torch.bincount(labels[curve], minlength=count).tolist()
    return list(order.split(sizes))


def _chunk(levels: Sequence[StreamedLevel], rows: tuple[Int[Tensor, "k"], ...]) -> StreamChunk:
    """Build a chunk with the box of its Gaussians at all levels."""
    pairs = [(level.scene, own) for level, own in zip(levels, rows, strict=True) if len(own)]
    low, high = join_boxes(box_of(scene.select(own.to(scene.device))) for scene, own in pairs)
    return StreamChunk(rows=rows, box_min=low, box_max=high)


def box_of(scene: GaussianScene, origin: Corner = (0.0, 0.0, 0.0)) -> tuple[Corner, Corner]:
    """Return the corners of the box of Gaussians about an origin, also after files round them."""
    axes = rotation_matrices(scene.quats.double()) * scene.scales.double()[:, None, :]
    reach = _SIGMAS * _ROUNDING * axes.square().sum(dim=2).sqrt()
    means = scene.means.double()
    means = means + means.new_tensor(origin)
    low, high = (means - reach).amin(dim=0), (means + reach).amax(dim=0)
    return _three(low.tolist()), _three(high.tolist())


def _node(cut: _Cut, chunks: Sequence[StreamChunk]) -> StreamNode:
    if isinstance(cut, int):
        return StreamNode(chunks[cut].box_min, chunks[cut].box_max, chunk=cut)
    sides = tuple(_node(side, chunks) for side in cut)
    return StreamNode(*join_boxes((side.box_min, side.box_max) for side in sides), sides)


def join_boxes(boxes: Iterable[tuple[Corner, Corner]]) -> tuple[Corner, Corner]:
    """Return the minimum and maximum corners of the bounding box of boxes."""
    lows, highs = zip(*boxes, strict=True)
    return _three(map(min, zip(*lows, strict=True))), _three(map(max, zip(*highs, strict=True)))


def _three(numbers: Iterable[float]) -> Corner:
    x, y, z = numbers
    return x, y, z
