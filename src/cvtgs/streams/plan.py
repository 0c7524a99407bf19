"""Which Gaussians of every level form a chunk, so that chunks of unlike levels fit together.

Chunks are made of Gaussians of the coarsest level. A Gaussian of a finer level is in the chunk of
the coarse one that stands for most of its own input rows, wherever its centre is. Where levels are
nested, all levels of a chunk therefore stand for the same part of the scene, and next to a chunk of
another level nothing is missing and nothing is there twice.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.io.arrays import morton_rows
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.parameters import rotation_matrices
from cvtgs.scene import GaussianScene

CHUNK_GAUSSIANS = 1 << 15
"""Gaussians of the finest level in a chunk, at most, unless a coarse one stands for more."""

ENVIRONMENT_GAUSSIANS = 1 << 16
"""Gaussians of the environment, at most, unless the coarsest level has more so far away."""

_SIGMAS = 3.0
"""Boxes of chunks hold Gaussians up to here, in standard deviations."""

_SPREAD = (0.05, 0.95)
"""Quantiles whose distance decides across which axis a node is cut; far Gaussians do not count."""

_SAMPLE = 1 << 16
"""Points that are looked at for that."""

Corner = tuple[float, float, float]


class StreamedLevel(Protocol):
    """What a stream takes of a level, such as :class:`cvtgs.report.Level`."""

    @property
    def scene(self) -> GaussianScene:
        """The Gaussians."""
        ...

    @property
    def geometric_error(self) -> float:
        """How far they are from those of the full scene, scene units."""
        ...

    @property
    def assignment(self) -> Int[Tensor, "n"] | None:
        """Row of the Gaussian that stands for each input row; -1 for none, None if all are kept."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamChunk:
    """The same part of a scene at every level.

    Attributes:
        rows: Rows of every level, the finest first, along a Morton curve.
        box_min: Least coordinates of the Gaussians of all levels, three sigmas wide.
        box_max: Largest coordinates.
    """

    rows: tuple[Int[Tensor, "k"], ...]
    box_min: Corner
    box_max: Corner


class StreamNode(NamedTuple):
    """A node of the tree of chunks.

    Attributes:
        box_min: Least coordinates of its chunks.
        box_max: Largest coordinates.
        children: Two nodes; none for a leaf.
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
        root: The tree.
        environment: What is so far away that all levels share it, and no chunk has it; None if
            nothing is.
    """

    levels: tuple[StreamedLevel, ...]
    chunks: tuple[StreamChunk, ...]
    root: StreamNode
    environment: GaussianScene | None = None

    @property
    def counts(self) -> tuple[int, ...]:
        """Gaussians in the chunks of each level."""
        rows = zip(*(chunk.rows for chunk in self.chunks), strict=True)
        return tuple(sum(map(len, level)) for level in rows)


class _Cut(NamedTuple):
    """A node of the tree over the Gaussians of the coarsest level, before boxes are known."""

    chunk: int | None = None
    sides: tuple["_Cut", ...] = ()


def plan_stream(
    levels: Sequence[StreamedLevel],
    *,
    chunk_gaussians: int = CHUNK_GAUSSIANS,
    environment_radii: float | None = None,
) -> StreamPlan:
    """Build the chunks of a stream of levels.

    Args:
        levels: Levels of one scene, of different sizes, as
            :meth:`~cvtgs.simplifier.Simplifier.levels` makes them.
        chunk_gaussians: Gaussians of the finest level in a chunk; a Gaussian of the coarsest level
            is never cut, so chunks are larger where it stands for more.
        environment_radii: What lies farther from the middle than so many robust radii is the
            environment, in one size for all levels; None leaves everything in chunks.

    Returns:
        The plan. Every row of every level is in one chunk, or so far away that the environment
        stands for it.

    Raises:
        InvalidArgumentError: There is no level, two have one size, or chunks are to be empty.

    Example:
        >>> from cvtgs import Simplifier, synthetic
        >>> levels = Simplifier(device="cpu").levels(synthetic.scene("object", 500), [0.5, 0.05])
        >>> plan = plan_stream(levels, chunk_gaussians=100)
        >>> sum(len(chunk.rows[0]) for chunk in plan.chunks)
        250
    """
    ordered = tuple(sorted(levels, key=lambda level: -len(level.scene)))
    counts = [len(level.scene) for level in ordered]
    if not counts or len(set(counts)) < len(counts) or chunk_gaussians < 1:
        raise InvalidArgumentError(
            f"a stream needs levels of different sizes and chunks of at least one Gaussian, found "
            f"levels of {counts} and chunks of {chunk_gaussians}."
        )
    near = near_rows(ordered[-1].scene, robust_frame(ordered[0].scene.means), environment_radii)
    return plan_part(ordered, near, chunk_gaussians=chunk_gaussians)


def near_rows(
    coarsest: GaussianScene, frame: RobustFrame, radii: float | None
) -> Bool[Tensor, "c"]:
    """Return which Gaussians go into chunks, at least one; the others are the environment."""
    near = torch.ones(len(coarsest), dtype=torch.bool)
    if radii is not None:
        distances = frame.distances(coarsest.means).cpu()
        near = distances <= max(radii, float(distances.min()))
    return near


def plan_part(
    ordered: Sequence[StreamedLevel], near: Bool[Tensor, "c"], *, chunk_gaussians: int
) -> StreamPlan:
    """Build the chunks of a part of a scene; sizes of levels may be equal, the finest is first."""
    coarsest = ordered[-1]
    means = coarsest.scene.means.double().cpu()
    weights = torch.ones(len(means), dtype=torch.int64)
    if len(ordered) > 1:
        weights = torch.bincount(_parents(ordered[0], coarsest), minlength=len(means)).clamp_min(1)
    labels = torch.full((len(means),), -1)
    tree, count = _cut(means, weights, labels, near.nonzero()[:, 0], most=chunk_gaussians)
    of_levels = [labels[_parents(level, coarsest)] for level in ordered]
    members = [
        _rows(own, level.scene, count) for level, own in zip(ordered, of_levels, strict=True)
    ]
    chunks = tuple(_chunk(ordered, rows) for rows in zip(*members, strict=True))
    environment = None if bool(near.all()) else _environment(ordered, of_levels)
    return StreamPlan(tuple(ordered), chunks, _node(tree, chunks), environment)


def _environment(
    levels: Sequence[StreamedLevel], labels: Sequence[Int[Tensor, "m"]]
) -> GaussianScene:
    """Return what is in no chunk, of the finest level at which it is not too much."""
    far = [(own < 0).nonzero()[:, 0] for own in labels]
    fitting = (level for level, rows in enumerate(far) if len(rows) <= ENVIRONMENT_GAUSSIANS)
    level = next(fitting, len(levels) - 1)
    scene = levels[level].scene
    return scene.select(far[level].to(scene.device))


def _parents(level: StreamedLevel, coarsest: StreamedLevel) -> Int[Tensor, "m"]:
    """Return the Gaussian of the coarsest level that stands for most rows of each of a level."""
    count, wide = len(level.scene), len(coarsest.scene)
    if level is coarsest:
        return torch.arange(count)
    coarse = _assignment(coarsest)
    own = _assignment(level)
    both = (own >= 0) & (coarse >= 0)
    pairs, votes = torch.unique(own[both] * wide + coarse[both], return_counts=True)
    order = torch.sort(votes, stable=True).indices  # the most votes are written last
    parents = torch.full((count,), -1)
    parents[pairs[order] // wide] = pairs[order] % wide
    missing = (parents < 0).nonzero()[:, 0]  # all of its rows were left out of the coarsest
    means, sites = level.scene.means.double().cpu(), coarsest.scene.means.double().cpu()
    for rows in missing.split(1 << 10):
        parents[rows] = torch.cdist(means[rows], sites).argmin(dim=1)
    return parents


def _assignment(level: StreamedLevel) -> Int[Tensor, "n"]:
    if level.assignment is not None:
        return level.assignment.to(torch.int64)
    return torch.arange(len(level.scene))


def _cut(
    means: Float[Tensor, "c 3"],
    weights: Int[Tensor, "c"],
    labels: Int[Tensor, "c"],
    near: Int[Tensor, "k"],
    *,
    most: int,
) -> tuple[_Cut, int]:
    """Cut near Gaussians of the coarsest level in two until no part stands for too many."""
    count = 0

    def part(rows: Int[Tensor, "k"]) -> _Cut:
        nonlocal count
        if int(weights[rows].sum()) <= most or len(rows) == 1:
            labels[rows] = count
            count += 1
            return _Cut(chunk=count - 1)
        order = rows[torch.sort(_widest(means[rows]), stable=True).indices]
        passed = weights[order].cumsum(0)
        half = int(torch.searchsorted(passed, int(passed[-1]) // 2))
        half = min(max(half, 1), len(rows) - 1)
        return _Cut(sides=(part(order[:half]), part(order[half:])))

    return part(near), count


def _widest(points: Float[Tensor, "k 3"]) -> Float[Tensor, "k"]:
    """Return the coordinate of points that is spread most; far points do not count."""
    some = points[:: 1 + len(points) // _SAMPLE]
    ends = torch.tensor(_SPREAD, dtype=points.dtype)
    low, high = some.quantile(ends, dim=0)
    return points[:, int((high - low).argmax())]


def _rows(labels: Int[Tensor, "m"], scene: GaussianScene, count: int) -> list[Int[Tensor, "k"]]:
    """Return the rows of every chunk, along a Morton curve of the whole level."""
    curve = torch.from_numpy(morton_rows(scene.means.cpu().float().numpy()))
    curve = curve[labels[curve] >= 0]
    order = curve[torch.sort(labels[curve], stable=True).indices]
    sizes = torch.bincount(labels[curve], minlength=count).tolist()
    return list(order.split(sizes))


def _chunk(levels: Sequence[StreamedLevel], rows: tuple[Int[Tensor, "k"], ...]) -> StreamChunk:
    """Build a chunk with the box of its Gaussians at all levels."""
    lows, highs = [], []
    for level, own in zip(levels, rows, strict=True):
        if len(own) == 0:
            continue
        part = level.scene.select(own.to(level.scene.device))
        axes = rotation_matrices(part.quats.double()) * part.scales.double()[:, None, :]
        reach = _SIGMAS * axes.square().sum(dim=2).sqrt()
        lows.append((part.means.double() - reach).amin(dim=0))
        highs.append((part.means.double() + reach).amax(dim=0))
    low, high = torch.stack(lows).amin(dim=0), torch.stack(highs).amax(dim=0)
    return StreamChunk(rows=rows, box_min=_three(low.tolist()), box_max=_three(high.tolist()))


def _node(cut: _Cut, chunks: Sequence[StreamChunk]) -> StreamNode:
    if cut.chunk is not None:
        chunk = chunks[cut.chunk]
        return StreamNode(chunk.box_min, chunk.box_max, chunk=cut.chunk)
    first, second = (_node(side, chunks) for side in cut.sides)
    low = map(min, zip(first.box_min, second.box_min, strict=True))
    high = map(max, zip(first.box_max, second.box_max, strict=True))
    return StreamNode(_three(low), _three(high), (first, second))


def _three(numbers: Iterable[float]) -> Corner:
    x, y, z = numbers
    return x, y, z
