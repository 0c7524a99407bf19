"""The layout of a scene: position and size of its content, up direction, floor and room."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.errors import InvalidSceneError
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.parameters import divide
from cvtgs.scene import GaussianScene
from cvtgs.text import short_repr
from cvtgs.validity import valid_part, with_finite_opacities
from cvtgs.views.up import VOXEL_SIZE, Voxels, among_others, find_floor, find_up, voxelize

ENCLOSED = 0.7  # least share of the upper hemisphere that a room hides from a camera in its middle
FREE = 0.12  # clearance that a camera needs, in robust radii
_NEAR = 2.2  # surfaces farther away than this, in robust radii, are not walls
# Least correlation of size and distance of Gaussians in a room: Gaussians behind the surfaces,
# where no image was taken, are large. In a hollow object, sizes shrink with distance.
_GROWS = 0.1
# Largest share of the surfaces of a room that is behind others, seen from its middle; about 0.1 was
# measured. Hollow objects have outer sides, a base and things beside them: 0.25 and more.
_HIDDEN = 0.18
_BEHIND = 1.3  # a surface over this many times as far, plus one voxel, is behind another
_FARTHEST = 6.0
_WALL_RAYS = 24  # level directions in which walls are searched
_WALLED = (0.4, 0.95)  # share of them with a wall in a room that is open to a side
_REACHED = 0.75  # a line that passes a voxel within this many edges meets its surface
_MOST_POINTS = 10_000
_CELLS = 10
_LEAST_IN_CELL = 8
# A room has Gaussians in at least so many cells of directions; small objects seem to grow in a few
# by chance
_LEAST_CELLS = 16
_BANDS = 5
_SECTORS = 12


class SizedPoints(NamedTuple):
    """Positions and mean log scales of Gaussians that are not faint, float64."""

    means: Float[Tensor, "n 3"]
    log_sizes: Float[Tensor, "n"]


def sized_points(sample: GaussianScene) -> SizedPoints:
    """Return every k-th Gaussian that is not faint, at most 10,000 in total."""
    rows = (sample.opacities > _VISIBLE).nonzero()[:, 0]
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    return SizedPoints(sample.means[rows].double(), sample.log_scales[rows].double().mean(dim=1))


def find_room(
    voxels: Voxels,
    sized: SizedPoints,
    frame: RobustFrame,
    *,
    middle: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "3"] | None, Float[Tensor, "3"] | None]:
    """Return the eye point of a room, and that of one open to a side, in robust radii, or None."""
    points = voxels.points
    if len(points) == 0:
        return None, None
    heights = points @ up
    low, high = heights.quantile(heights.new_tensor([0.02, 0.98])).tolist()
    center = middle - (middle @ up) * up
    steps = torch.linspace(-0.3, 0.3, 5, dtype=points.dtype, device="cpu")
    offsets = torch.cartesian_prod(steps, steps) @ torch.linalg.svd(up[None]).Vh[1:]
    lifts = torch.tensor([0.45, 0.55, 0.65], dtype=points.dtype, device="cpu") * (high - low) + low
    eyes = ((center + offsets)[:, None] + lifts[:, None] * up).reshape(-1, 3)
    best = _freest(eyes, points)
    if best is None:
        return None, None
    place = frame.center + frame.radius * best
    if size_growths(sized, place[None], frame.radius, least_cells=_LEAST_CELLS)[0] < _GROWS:
        return None, None
    if enclosure(best, points, up) >= ENCLOSED:
        return center + (0.58 * (high - low) + low) * up, None
    right, ahead = level_axes(up)
    angles = torch.arange(_WALL_RAYS, dtype=points.dtype, device="cpu") * (math.tau / _WALL_RAYS)
    level = angles.cos()[:, None] * right + angles.sin()[:, None] * ahead
    walls = are_hidden(best + _NEAR * level, best, points)
    least, most = _WALLED
    return None, best if least <= float(walls.double().mean()) <= most else None


def _freest(eyes: Float[Tensor, "e 3"], points: Float[Tensor, "v 3"]) -> Tensor | None:
    """Return the eye farthest from surfaces; None if these are near, or hide one another."""
    clearance = torch.cdist(eyes, points).amin(dim=1)
    best = eyes[clearance.argmax()]
    is_free = float(clearance.amax()) >= FREE and hidden_share(best, points) <= _HIDDEN
    return best if is_free else None


def is_enclosed(points: Float[Tensor, "v 3"]) -> bool:
    """Return whether surfaces surround a free point near the middle, with little behind them."""
    if len(points) == 0:
        return False
    middle = 0.5 * (points.amin(dim=0) + points.amax(dim=0))
    steps = torch.linspace(-0.3, 0.3, 5, dtype=points.dtype, device="cpu")
    best = _freest(middle + torch.cartesian_prod(steps, steps, steps), points)
    if best is None:
        return False
    up = points.new_tensor([0.0, 0.0, 1.0])
    return enclosure(best, points, up) + enclosure(best, points, -up) >= 2 * ENCLOSED


def are_hidden(
    eyes: Float[Tensor, "e 3"], target: Float[Tensor, "3"], points: Float[Tensor, "v 3"]
) -> Bool[Tensor, "e"]:
    """Return which positions have a surface between them and a target; all in robust radii."""
    directions, distances = eyes - target, torch.linalg.vector_norm(eyes - target, dim=1)
    directions = divide(directions, distances[:, None])
    offsets = points - target
    along = directions @ offsets.T
    aside = offsets.square().sum(dim=1) - along.square()
    near = (aside < (_REACHED * VOXEL_SIZE) ** 2) & (along > 0) & (along < distances[:, None])
    hidden: Tensor = near.any(dim=1)
    return hidden


def enclosure(
    eye: Float[Tensor, "3"], points: Float[Tensor, "v 3"], up: Float[Tensor, "3"]
) -> float:
    """Return the share of the upper hemisphere of directions in which there is a surface."""
    offsets = points - eye
    offsets = offsets[torch.linalg.vector_norm(offsets, dim=1) < _NEAR]
    directions = torch.nn.functional.normalize(offsets, dim=1)
    axes = torch.linalg.svd(up[None]).Vh[1:]
    rise = directions @ up
    x, y = (directions @ axes.T).unbind(1)
    sectors = ((torch.atan2(y, x) / math.tau + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    bands = (rise * _BANDS).long().clamp(0, _BANDS - 1)  # bands of equal solid angle
    filled = torch.zeros(_BANDS, _SECTORS, dtype=torch.bool, device="cpu")
    filled[bands[rise > 0], sectors[rise > 0]] = True
    return float(filled.double().mean())


def hidden_share(eye: Float[Tensor, "3"], points: Float[Tensor, "v 3"]) -> float:
    """Return the share of the surfaces around a point that are behind others as seen from it."""
    offsets = points - eye
    distances = torch.linalg.vector_norm(offsets, dim=1)
    around = distances < _NEAR
    offsets, distances = offsets[around], distances[around]
    cells = _cells_of_cube(offsets)
    nearest = distances.new_full((6 * _CELLS**2,), _NEAR)
    nearest = nearest.scatter_reduce(0, cells, distances, "amin")
    return float((distances > _BEHIND * nearest[cells] + VOXEL_SIZE).double().mean())


def size_growths(
    sized: SizedPoints, eyes: Float[Tensor, "e 3"], radius: float, *, least_cells: int = 1
) -> list[float]:
    """Return mean correlations of sizes with distances from points, 0 for few filled cells."""
    offsets = sized.means - eyes[:, None]
    distances = torch.linalg.vector_norm(offsets, dim=2)
    near = (distances < _FARTHEST * radius) & (distances > 0)
    eye, row = near.nonzero(as_tuple=True)
    offsets, distances, sizes = offsets[near], distances[near].log(), sized.log_sizes[row]
    count = 6 * _CELLS**2
    cells = eye * count + _cells_of_cube(offsets)
    numbers = torch.bincount(cells, minlength=len(eyes) * count)

    def sums(values: Tensor) -> Tensor:
        return torch.bincount(cells, weights=values, minlength=len(eyes) * count)

    distances = distances - divide(sums(distances), numbers.double())[cells]
    sizes = sizes - divide(sums(sizes), numbers.double())[cells]
    products = (sums(distances.square()) * sums(sizes.square())).sqrt()
    correlations = divide(sums(distances * sizes), products)
    enough = (numbers >= _LEAST_IN_CELL) & (products > 0)
    shape = len(eyes), count
    of_eyes = zip(correlations.view(shape), enough.view(shape), strict=True)
    some = [own[there] for own, there in of_eyes]
    return [float(own.mean()) if len(own) >= least_cells else 0.0 for own in some]


def _cells_of_cube(offsets: Float[Tensor, "n 3"]) -> Tensor:
    """Return the cell of each direction on a cube around the point."""
    axes = offsets.abs().argmax(dim=1)
    depth = offsets.gather(1, axes[:, None])[:, 0]
    others = torch.stack(
        [
            torch.where(axes == 0, offsets[:, 1], offsets[:, 0]),
            torch.where(axes == 2, offsets[:, 1], offsets[:, 2]),
        ]
    )
    rows, columns = ((others / depth.abs() + 1) * 0.5 * _CELLS).long().clamp(0, _CELLS - 1)
    cells: Tensor = ((2 * axes + (depth > 0)) * _CELLS + rows) * _CELLS + columns
    return cells


SAMPLE_SIZE = 30_000  # largest number of Gaussians of a sample; larger scenes are reduced to it
_HEAVIEST = 5_000
_MOST_POSITIONS = 100_000
_VISIBLE = 0.1
_BOUNDED = 3.2
_FAR = 4.0
_FAR_SHARE = 0.02
_HEIGHTS = (0.02, 0.98)
_LARGEST = 1e14  # units beyond which directions of length 1 vanish beside positions in float64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneLayout:
    """Position, extent and orientation of the content of a scene, float64, in scene units."""

    sample: GaussianScene  # covers the same area as the scene; SH degree 0, on the CPU
    device: torch.device  # of the scene
    sized: SizedPoints
    frame: RobustFrame  # of the visible Gaussians
    voxels: Voxels  # the surfaces near the middle
    up: Float[Tensor, "3"]  # unit length
    bounded: bool  # nearly all is within about three robust radii: an object, not a place
    center: Float[Tensor, "3"]  # middle of the content that views should show
    radius: float  # of this content
    height: float  # extent along ``up`` of the content near the middle
    floor: float | None  # height along ``up``; None without a floor
    room: Float[Tensor, "3"] | None  # eye point in its middle; None if not seen from inside
    cutaway: Float[Tensor, "3"] | None  # middle of a room that is open to a side, else None

    __repr__ = short_repr

    @property
    def subject(self) -> Float[Tensor, "3"]:
        """The point that views show: the eye point of a room, else the middle of the content."""
        return self.center if self.room is None else self.room

    @property
    def is_open(self) -> bool:
        """Whether people who see the scene stand in it, and look far: a garden, not an object."""
        return not self.bounded and self.room is None


def find_layout(scene: GaussianScene) -> SceneLayout:
    """Return the layout of a scene, from robust statistics of its visible Gaussians."""
    valid = viewable_part(scene)
    sample, _ = covering_sample(valid, SAMPLE_SIZE)
    positions = _visible_positions(valid)
    frame = robust_frame(positions)
    width = 2 * float(sample.scales.amax(dim=1).median())  # the extent if all centres coincide
    largest = max(float(frame.center.abs().amax()), frame.radius, width)
    if largest > _LARGEST:
        raise InvalidSceneError(
            f"automatic views need a scene within {_LARGEST:g} units of the origin, found one of "
            f"{largest:.3g} units; scale it first (cvtgs.edit.move, convert --scale)."
        )
    voxels, local = voxelize(sample, frame), frame.normalize(positions)
    distances = torch.linalg.vector_norm(local, dim=1)
    bounded = float(distances.quantile(0.97)) < _BOUNDED
    far, enclosed = _far_directions(local, distances), is_enclosed(voxels.points)
    up = find_up(voxels, far, enclosed=enclosed)
    positions = voxels.points if len(voxels.points) else local[:1]
    heights = (positions @ up).quantile(positions.new_tensor(_HEIGHTS))
    together = among_others(positions)
    positions = positions[together] if bool(together.any()) else positions
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    middle = 0.5 * (low + high) if bounded else torch.zeros_like(low)
    spread = torch.linalg.vector_norm(positions - middle, dim=1)
    radius = float(spread.amax()) if bounded else 1.0
    center = frame.center + frame.radius * middle
    floor = find_floor(voxels, up)
    sized = sized_points(sample)
    room, cutaway = find_room(voxels, sized, frame, middle=middle, up=up)
    return SceneLayout(
        sample=sample,
        device=scene.device,
        sized=sized,
        frame=frame,
        voxels=voxels,
        up=up,
        bounded=bounded,
        center=center,
        radius=max(frame.radius * radius, width),
        height=frame.radius * float(heights[1] - heights[0]),
        floor=None if floor is None else float(frame.center @ up) + frame.radius * floor,
        room=None if room is None else frame.center + frame.radius * room,
        cutaway=None if cutaway is None else frame.center + frame.radius * cutaway,
    )


def level_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return two level directions, fixed by ``up`` alone."""
    least = torch.eye(3, dtype=up.dtype, device="cpu")[up.abs().argmin()]
    right = torch.nn.functional.normalize(torch.linalg.cross(up, least), dim=0)
    return right, torch.linalg.cross(right, up)


def viewable_part(scene: GaussianScene) -> GaussianScene:
    """Return the valid rows of a scene that has some."""
    part = valid_part(scene)
    if len(part) == 0:
        found = f"none of {len(scene):,} is valid" if len(scene) else "found none"
        raise InvalidSceneError(f"automatic views need a scene with valid Gaussians; {found}.")
    return part


def _visible_positions(scene: GaussianScene) -> Float[Tensor, "k 3"]:
    """Return positions of every k-th Gaussian, without faint ones unless all are faint."""
    step = -(-len(scene) // _MOST_POSITIONS)
    means = scene.means[::step].cpu()
    visible = means[(scene.opacities[::step] > _VISIBLE).cpu()]
    return visible if len(visible) else means


def _far_directions(
    positions: Float[Tensor, "k 3"], distances: Float[Tensor, "k"]
) -> Float[Tensor, "f 3"]:
    far = positions[distances > _FAR]
    few = len(far) < _FAR_SHARE * len(positions)
    return torch.nn.functional.normalize(far[:0] if few else far, dim=1)


def covering_sample(scene: GaussianScene, count: int) -> tuple[GaussianScene, Float[Tensor, "k 1"]]:
    """Return the heaviest and every k-th other Gaussian, on the CPU, of SH degree 0.

    They are enlarged to cover for the omitted ones, by the second value in log scales.
    """
    plain = scene.with_tensors({"shN": scene.shN[:, :0]}, {})
    enlargement = torch.zeros(len(scene), 1, dtype=scene.dtype, device=scene.device)
    if len(scene) > count:
        heaviest_first = torch.sort(scene.masses, descending=True, stable=True).indices
        rest = torch.sort(heaviest_first[_HEAVIEST:]).values
        step = -(-len(rest) // (count - _HEAVIEST))
        rows = torch.cat([heaviest_first[:_HEAVIEST], rest[::step]])
        enlargement = enlargement[: len(rows)]
        enlargement[_HEAVIEST:] = 0.5 * torch.log(
            enlargement.new_tensor(len(rest) / len(rest[::step]))
        )
        plain = plain.select(rows)
        plain = plain.with_tensors({"log_scales": plain.log_scales + enlargement}, {})
    return with_finite_opacities(plain.to("cpu")), enlargement.cpu()
