"""Write 3D Tiles 1.1 for CesiumJS: ``tileset.json``, and glTF tiles that contain SPZ."""

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.boxes import Corner
from cvtgs.checks import checked
from cvtgs.counts import checked_whole, finite_numbers, real_number
from cvtgs.devices import on_host
from cvtgs.errors import InvalidArgumentError
from cvtgs.io import atomic_output
from cvtgs.io.axes import SCENE_AXES, change_axes
from cvtgs.io.formats import tagged_if_flat
from cvtgs.io.gltf.document import AXES, SPLATS, SPZ
from cvtgs.io.gltf.write import write_spz_glb
from cvtgs.io.limits import FORMAT_LIMITS, clamped_within, dropped_within
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import rms_error
from cvtgs.scene import GaussianScene
from cvtgs.streams.files import StreamLevel, StreamPart, join_trees, write_stream
from cvtgs.streams.plan import StreamNode, StreamPlan, box_of, join_boxes
from cvtgs.text import shown

TILE_GAUSSIANS = 1 << 16
"""Maximum number of Gaussians in a tile, unless it holds the coarsest level or a single chunk."""

EARTH_RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
"""Equatorial radius, metres, and flattening of WGS 84."""

_UNMOVED = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)

ERROR_PIXELS = 16.0
"""By default, viewers refine a tile whose error covers more pixels than this. Tile errors are
multiplied by it, so that viewers refine where Gaussians are off by one pixel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tile:
    """A tile: consecutive chunks at one level, and the finer tiles that replace it."""

    level: int
    chunks: range
    children: list["_Tile"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TilesFormat:
    """3D Tiles 1.1, as CesiumJS loads them."""

    tile_gaussians: int = TILE_GAUSSIANS  # the most in a tile; a chunk is never split
    transform: tuple[float, ...] = _UNMOVED  # from z up and metres, column by column
    kind: str = "3dtiles"

    def write_part(
        self, plan: StreamPlan, folder: Path, *, part: int, listener: ProgressListener
    ) -> StreamPart:
        """Write the tiles of a part; the first holds the coarsest level of the whole part."""
        root = _tiles(plan, self.tile_gaussians)
        total, names, dropped = _count(root), list[str](), Counter[str]()
        counts, files, sizes = ([0] * len(plan.levels) for _ in range(3))

        def write(tile: _Tile) -> tuple[dict[str, Any], tuple[Corner, Corner]]:
            """Write a tile and the finer ones; return their entry, and the box of all."""
            names.append(f"{part}_{len(names)}.glb")
            path, scene = folder / names[-1], plan.levels[tile.level].scene
            rows = _rows(plan, tile)
            origin, own_box, lost = _write_tile(scene.select(rows.to(scene.device)), path)
            dropped.update(lost)
            counts[tile.level] += len(rows)
            files[tile.level] += 1
            sizes[tile.level] += path.stat().st_size
            listener(ProgressEvent(stage="write", done=len(names), total=total))
            content = {"uri": path.name}
            finer = [write(child) for child in tile.children]
            box = join_boxes([own_box, *(child_box for _, child_box in finer)])
            entry = {**_located(*box, origin), "geometricError": 0.0, "content": content}
            if finer:
                below = [child for child, _ in finer]
                errors = [child["geometricError"] for child in below]  # never above the parent's
                entry["geometricError"] = max(ERROR_PIXELS * _error(plan, tile), *errors)
                entry["children"] = below
            return entry, box

        tree, (box_min, box_max) = write(root)
        return StreamPart(
            levels=tuple(map(StreamLevel, counts, files, sizes)),
            chunks=len(plan.chunks),
            names=tuple(names),
            tree=tree,
            box_min=box_min,
            box_max=box_max,
            dropped=dropped,
        )

    def index(self, parts: Sequence[StreamPart], folder: Path) -> dict[str, Any]:
        """Return the content of ``tileset.json``; tiles share no other file."""
        low, high = join_boxes((part.box_min, part.box_max) for part in parts)
        root = join_trees(parts, [part.tree for part in parts], _parent)
        to_place = _matrix(self.transform)
        scale = float(to_place[:3, :3].norm(dim=0).max())  # of the root's own error, for viewers
        extensions = {"extensionsUsed": [SPLATS, SPZ], "extensionsRequired": [SPLATS, SPZ]}
        return {
            "asset": {"version": "1.1", "generator": "cvtgs"},
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": extensions},
            "geometricError": scale * max(root["geometricError"], math.dist(low, high)),
            "root": {"refine": "REPLACE", **_relative(root, to_place)},
        }


@on_host()
@checked
def write_tiles(
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    tile_gaussians: int = TILE_GAUSSIANS,
    transform: Sequence[float] | None = None,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> tuple[StreamLevel, ...]:
    """Write 3D Tiles, all files or none.

    The root holds the coarsest level of the whole scene. Finer tiles of its parts replace a tile,
    down to the finest level of single chunks. Tiles use the axes of glTF, and boxes use those of
    3D Tiles (z up). The transform of a tile moves the median of its positions into place, so that
    they keep their digits far from the origin.

    Args:
        plan: Levels and chunks.
        folder: Folder to write to; created if it is missing.
        tile_gaussians: Maximum number of Gaussians in a tile; a chunk is never split.
        transform: Transform of the tileset, 16 numbers column by column, as returned by
            :func:`geo_transform`: from x left, y back and z up in the scene to its place; None for
            no transform.
        overwrite: Whether files of an earlier stream may be replaced.
        listener: Called after each tile.

    Returns:
        The written counts of each level, the finest first; it may be at several depths of the tree.

    Raises:
        InvalidArgumentError: The transform is not affine and invertible, or the plan has an
            environment, which 3D Tiles cannot hold.
        OutputExistsError: The folder holds files that may not be replaced.
        OutputError: A file cannot be written.
        InvalidSceneError: No Gaussian of a tile is finite.

    Example:
        >>> import tempfile
        >>> import cvtgs
        >>> from cvtgs.streams import plan_stream
        >>> scene = cvtgs.synthetic.scene("object", 500)
        >>> levels = cvtgs.Simplifier(device="cpu").levels(scene, [0.5, 0.05])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = write_tiles(plan_stream(levels, chunk_gaussians=100), folder)
        ...     len(cvtgs.load(f"{folder}/0_0.glb")), written[0].gaussians
        (25, 250)
    """
    check_no_environment(bool(plan.far))
    form = TilesFormat(
        tile_gaussians=checked_whole(tile_gaussians, "tile_gaussians"),
        transform=check_transform(transform),
    )
    return write_stream(form, plan, folder, overwrite=overwrite, listener=listener)


def geo_transform(longitude: float, latitude: float, height: float = 0.0) -> tuple[float, ...]:
    """Return the transform that places a tileset on the Earth.

    The scene's right (x of a PLY) points east, its forward (z) north and its up (-y) up, in metres.
    As glTF and thus the tileset have x to the left, x of the tileset points west, and y south. The
    ellipsoid is that of WGS 84 (EPSG 4978).

    Args:
        longitude: Degrees, east is positive.
        latitude: Degrees, north is positive.
        height: Metres above the ellipsoid.

    Returns:
        16 numbers, column by column.

    Raises:
        InvalidArgumentError: A coordinate is out of range or not finite.

    Example:
        >>> [round(number) for number in geo_transform(0.0, 0.0)[12:]]
        [6378137, 0, 0, 1]
    """
    given = (longitude, latitude, height)
    longitude, latitude, height = map(real_number, given)
    if not (abs(longitude) <= 360.0 and abs(latitude) <= 90.0 and math.isfinite(height)):
        one, two, three = map(shown, given)
        raise InvalidArgumentError(
            "a place on Earth needs a longitude from -360 to 360 degrees, a latitude from -90 "
            f"to 90 and a height in metres, found {one}, {two} and {three}."
        )
    east, north = math.radians(longitude), math.radians(latitude)
    sin_east, cos_east = math.sin(east), math.cos(east)
    sin_north, cos_north = math.sin(north), math.cos(north)
    squared = FLATTENING * (2.0 - FLATTENING)
    across = EARTH_RADIUS / math.sqrt(1.0 - squared * sin_north**2)
    return (
        sin_east, -cos_east, 0.0, 0.0,
        sin_north * cos_east, sin_north * sin_east, -cos_north, 0.0,
        cos_north * cos_east, cos_north * sin_east, sin_north, 0.0,
        (across + height) * cos_north * cos_east, (across + height) * cos_north * sin_east,
        (across * (1.0 - squared) + height) * sin_north, 1.0,
    )  # fmt: skip


def check_no_environment(has_one: bool) -> None:
    """Refuse an environment, whose Gaussians are in no chunk, so that tiles would lack them."""
    if has_one:
        raise InvalidArgumentError(
            "3D Tiles have no environment, so environment_radii must be None, found a distance."
        )


def check_transform(numbers: Sequence[float] | None) -> tuple[float, ...]:
    """Return the transform of a tileset, 16 numbers by columns; raise unless it is invertible."""
    if numbers is None:
        return _UNMOVED
    values = finite_numbers(numbers, 16)
    if values is not None and values[3::4] == (0.0, 0.0, 0.0, 1.0):
        matrix = torch.tensor(values, dtype=torch.float64).reshape(4, 4)[:3, :3]
        if abs(float(torch.linalg.det(matrix))) > 0.0:
            return values
    raise InvalidArgumentError(
        "the transform of a tileset must be 16 finite numbers, column by column: an "
        f"invertible 4 x 4 matrix whose last row is 0, 0, 0, 1; found {shown(numbers)}."
    )


def _tiles(plan: StreamPlan, most: int) -> _Tile:
    """Build the tree of tiles; the children of a tile have the next finer level that fits."""
    sums = [[0] for _ in plan.levels]
    for chunk in plan.chunks:
        for total, rows in zip(sums, chunk.rows, strict=True):
            total.append(total[-1] + len(rows))

    def level_of(chunks: range, above: int) -> int:
        """Return the finest level that fits into a tile; for a single chunk, at least one finer."""
        fitting = [
            level
            for level in range(above)
            if sums[level][chunks.stop] - sums[level][chunks.start] <= most
        ]
        last = above - 1 if len(chunks) == 1 else above
        return min(fitting, default=last)

    def below(node: StreamNode, chunks: range, above: int) -> Iterator[_Tile]:
        """Return the finer tiles that replace level ``above`` within a node."""
        if above == 0:
            return
        level = level_of(chunks, above)
        if level < above:
            yield tile(node, chunks, level)
            return
        middle = chunks.start + _leaves(node.children[0])
        yield from below(node.children[0], range(chunks.start, middle), above)
        yield from below(node.children[1], range(middle, chunks.stop), above)

    def tile(node: StreamNode, chunks: range, level: int) -> _Tile:
        finer = list(below(node, chunks, level))
        return _Tile(level=level, chunks=chunks, children=finer)

    whole = range(len(plan.chunks))
    return tile(plan.root, whole, len(plan.levels) - 1)


def _leaves(node: StreamNode) -> int:
    return 1 if node.chunk is not None else sum(_leaves(child) for child in node.children)


def _count(tile: _Tile) -> int:
    return 1 + sum(map(_count, tile.children))


def _write_tile(
    scene: GaussianScene, path: Path
) -> tuple[Corner, tuple[Corner, Corner], dict[str, int]]:
    """Write Gaussians about their median; return it, the box of the file, and lost data."""
    some = tagged_if_flat(scene)
    means = some.means.detach().double()
    origin = _median(means)
    tensors = {**some.tensors(), "means": means - means.new_tensor(origin)}
    local = some.with_tensors({name: one.float() for name, one in tensors.items()})
    turned = change_axes(local, SCENE_AXES, AXES)
    with np.errstate(over="ignore"), atomic_output(path, overwrite=True) as file:
        write_spz_glb(turned, file)
    limits = FORMAT_LIMITS[".spz.glb"]
    held = clamped_within(local.with_sh_degree(0), limits)  # flyaways; boxes need no colours
    return origin, box_of(held, origin), dropped_within(turned, limits)


def _error(plan: StreamPlan, tile: _Tile) -> float:
    """Return the error of the Gaussians of a tile, which may be far from that of their level."""
    level = plan.levels[tile.level]
    sums = getattr(level, "error_sums", None)  # optional
    return level.geometric_error if sums is None else rms_error(sums[:, _rows(plan, tile)])


def _rows(plan: StreamPlan, tile: _Tile) -> Int[Tensor, "k"]:
    return torch.cat([plan.chunks[chunk].rows[tile.level] for chunk in tile.chunks])


def _parent(low: Corner, high: Corner, children: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a tile without content, which viewers always refine."""
    errors = [child["geometricError"] for child in children]
    x, y, z = _median(torch.stack([_matrix(child["transform"])[:3, 3] for child in children]))
    return {
        **_located(low, high, (-x, -z, -y)),
        "geometricError": max(math.dist(low, high), *errors),
        "children": children,
    }


def _located(low: Corner, high: Corner, origin: Corner) -> dict[str, Any]:
    """Return the box of a tile, and the translation to its origin, in the axes of 3D Tiles."""
    # In them, x is left, y back and z up in the scene.
    start, *corners = ((-x, -z, -y) for x, y, z in (origin, low, high))
    middle = [(a + b) / 2 - o for o, a, b in zip(start, *corners, strict=True)]
    half = [abs(a - b) / 2 for a, b in zip(*corners, strict=True)]
    box = [*middle, half[0], 0.0, 0.0, 0.0, half[1], 0.0, 0.0, 0.0, half[2]]
    return {"transform": [*_UNMOVED[:12], *start, 1.0], "boundingVolume": {"box": box}}


def _relative(tile: dict[str, Any], above: Float[Tensor, "4 4"]) -> dict[str, Any]:
    """Return a tile whose transforms, and those below, go to the axes that ``above`` leads to."""
    own = _matrix(tile["transform"])
    inverse = 2 * _matrix(_UNMOVED) - own  # of a translation
    moved = {**tile, "transform": (above @ own).T.flatten().tolist()}
    if "children" in tile:
        moved["children"] = [_relative(child, inverse) for child in tile["children"]]
    return moved


def _matrix(numbers: Sequence[float]) -> Float[Tensor, "4 4"]:
    return torch.tensor(numbers, dtype=torch.float64, device="cpu").reshape(4, 4).T


def _median(positions: Float[Tensor, "n 3"]) -> Corner:
    """Return the median of finite positions along each axis; a mean could be far from all."""
    finite = positions[positions.isfinite().all(dim=1)]
    return tuple(finite.median(dim=0).values.tolist()) if len(finite) else (0.0, 0.0, 0.0)
