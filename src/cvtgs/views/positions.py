"""Plausible camera positions in a scene: above its floor, not inside matter, not behind clutter."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from operator import index

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.checks import checked
from cvtgs.counts import checked_whole, is_truth_value, real_number
from cvtgs.devices import HOST, in_chunks
from cvtgs.errors import InvalidArgumentError
from cvtgs.scene import GaussianScene, SceneLike, as_scene
from cvtgs.text import short_repr, shown
from cvtgs.views.layout import (
    ENCLOSED,
    FREE,
    SceneLayout,
    are_hidden,
    covering_sample,
    enclosure,
    find_layout,
    level_axes,
    size_growths,
    viewable_part,
)
from cvtgs.views.scoring import (
    PIXELS,
    SMOOTH,
    cameras_at,
    image_device,
    measure_splats,
    splat_sizes,
    splat_widths,
)

REACH = (0.2, 3.0)  # distances of candidate positions from the centre of the frame, robust radii
_SEEDS = 1 << 32
_TRIED = 384
_SEED = 17
_EYES = 8  # positions per chunk
_STANDING_REACH = (0.2, 2.0)  # level distances of candidates in an open place, robust radii
_ELEVATIONS = (5.0, 35.0)  # angles at which these rise from the ground in the middle, degrees
_ABOVE = 0.1  # least height above a floor, in robust radii
_BURIED = 0.75  # share of the upper and of the lower hemisphere that is hidden inside matter
_SLACK = 0.25  # accepted difference from (nearly) the largest growth of all candidates
_TOP = 0.98
_SIDES = 32
_OUTSIDE = 1.1  # positions this many robust radii away see a side of the scene from outside
_SIDE_DISTANCE, _SIDE_FIELD = 2.2, 50.0  # of the cameras that check sides: robust radii, degrees
_ASKED = 32
_MEASURED = (16, 64)  # positions to look closely from: a few, then more where these see clutter
_SAMPLE = 60_000
_FEW = 20_000  # scenes of fewer Gaussians are coarse from everywhere
# Heights above the middle of a room, robust radii, at half of which or more a wall has no gap
_WALL_STEPS = (-0.15, -0.05, 0.05, 0.15)
_COARSE = 2.0  # the finest tenth of an image of clutter is over this many times that of clear ones
_SUSPECT, _SUSPECTED = 0.03, 0.25
_LARGE = 0.015  # least size of the finest splats of clutter, robust radii
_CLUTTERED = 0.4  # least share of the positions that see such splats
_FIELD = 50.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPositions:
    """Valid camera positions.

    Attributes:
        layout: Layout of the scene.
        least_growth: Least mean correlation of Gaussian size with distance at a good position.
        sharp_sides: ``(32,)`` whether the scene is sharp from each of 32 evenly spread directions.
        cluttered: ``(k, 3)`` positions with clutter before the scene, scene units; none unless a
            scene is clear from one side only.
        eyes: ``(p, 3)`` good positions among the candidates, scene units; at least one.
        distances: ``(p,)`` their distances from the centre of the frame, in robust radii.
    """

    layout: SceneLayout
    least_growth: float
    sharp_sides: Bool[Tensor, "d"]
    cluttered: Float[Tensor, "k 3"]
    eyes: Float[Tensor, "p 3"]
    distances: Float[Tensor, "p"]

    __repr__ = short_repr

    @checked
    def admit(self, eyes: Float[Tensor, "c 3"]) -> Bool[Tensor, "c"]:
        """Return a mask of the good positions.

        A good position is free, above the floor if there is one, and inside the room if the scene
        is one, else not enclosed. If the room is open to a side, no wall may hide its middle. Near
        Gaussians must also be smaller than distant ones, as is usual where images were taken,
        unless the position faces, from outside, a side of small Gaussians: the smooth back of an
        object. No position with clutter before the scene may be nearer than one without.

        Args:
            eyes: ``(c, 3)`` positions, scene units.

        Returns:
            ``(c,)`` mask.

        Raises:
            InvalidArgumentError: ``eyes`` is no tensor of floats of this shape.
        """
        eyes = eyes.to(self.eyes)
        free = stand_free(self.layout, eyes)
        unsure = free & ~_sees_sharp_sides(self.layout, eyes, self.sharp_sides)
        free[unsure] = _growths(self.layout, eyes[unsure]) >= self.least_growth
        if len(self.cluttered):
            gaps = torch.cdist(eyes, self.eyes).amin(dim=1)
            free &= gaps <= torch.cdist(eyes, self.cluttered).amin(dim=1)
            free &= gaps <= self.layout.frame.radius
        return free

    def near(self, count: int, reach: tuple[float, float], seed: int) -> Float[Tensor, "c 3"]:
        """Return random positions within a range of distances.

        Args:
            count: Number of positions.
            reach: Smallest and largest distance, robust radii; if no position is within, the
                nearest to this range are used.
            seed: Seed of the random numbers.

        Returns:
            Good positions, moved by up to a twentieth of a radius along each axis if still good.

        Raises:
            InvalidArgumentError: ``reach`` does not consist of two ascending numbers from 0, or
                count or seed are no whole numbers.
        """
        low, high = checked_reach(reach)
        count = checked_whole(count, "count", least=0)
        generator = torch.Generator().manual_seed(checked_seed(seed))
        beyond = (low - self.distances).clamp_min(self.distances - high).clamp_min(0)
        within = (beyond <= beyond.amin()).nonzero()[:, 0]
        picked = within[torch.randint(len(within), (count,), generator=generator, device="cpu")]
        eyes = self.eyes[picked]
        draws = torch.rand(count, 3, generator=generator, dtype=torch.float32, device="cpu")
        moved = eyes + 0.1 * self.layout.frame.radius * (draws - 0.5)
        return torch.where(self.admit(moved)[:, None], moved, eyes)


def checked_reach(reach: tuple[float, float]) -> tuple[float, float]:
    """Return a range of distances; raise unless it is one."""
    ends = tuple(map(real_number, reach)) if isinstance(reach, Sequence) else ()
    if len(ends) != 2 or not 0 <= ends[0] <= ends[1]:
        raise InvalidArgumentError(
            f"reach must be two ascending numbers of at least 0, found {shown(reach)}."
        )
    return ends[0], ends[1]


@torch.no_grad()
def find_view_positions(scene: SceneLike) -> CameraPositions:
    """Find valid camera positions, once for many sets of views.

    Args:
        scene: A scene with at least one valid Gaussian, or a file or folder of one.

    Returns:
        The positions, which view functions accept instead of a scene; if no candidate is good,
        one that is above the floor.

    Raises:
        InvalidSceneError: The scene has no valid row, or reaches beyond 1e14 units.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> positions = find_view_positions(scene("object", 1000))
        >>> len(positions.near(3, REACH, seed=0))
        3
    """
    scene = as_scene(scene)
    layout = find_layout(scene)
    radius, center = layout.frame.radius, layout.frame.center
    eyes = lifted(layout, _standing_eyes(layout) if layout.is_open else _surrounding_eyes(layout))
    free = stand_free(layout, eyes)
    eyes = eyes[free] if bool(free.any()) else eyes[:1]
    growths = _growths(layout, eyes)
    least = float(growths.quantile(_TOP)) - _SLACK
    grows = growths >= least
    sharp_sides = _sharp_sides(layout, eyes[~grows])
    eyes = eyes[grows | _sees_sharp_sides(layout, eyes, sharp_sides)]
    eyes, cluttered = split_by_clutter(scene, layout, eyes)
    distances = torch.linalg.vector_norm(eyes - center, dim=1) / radius
    return CameraPositions(
        layout=layout,
        least_growth=least,
        sharp_sides=sharp_sides,
        cluttered=cluttered,
        eyes=eyes,
        distances=distances,
    )


def _surrounding_eyes(layout: SceneLayout) -> Float[Tensor, "c 3"]:
    """Return random positions in all directions from the middle."""
    generator = torch.Generator().manual_seed(_SEED)
    directions = torch.nn.functional.normalize(
        torch.randn(_TRIED, 3, generator=generator, dtype=torch.float64, device="cpu"), dim=1
    )
    steps = torch.rand(_TRIED, 1, generator=generator, dtype=torch.float64, device="cpu")
    low, high = REACH
    return layout.frame.center + layout.frame.radius * (low + (high - low) * steps) * directions


def _standing_eyes(layout: SceneLayout) -> Float[Tensor, "c 3"]:
    """Return random positions of people who stand on the ground and may raise the camera."""
    generator = torch.Generator().manual_seed(_SEED)
    draws = torch.rand(3, _TRIED, 1, generator=generator, dtype=torch.float64, device="cpu")
    low, high = _STANDING_REACH
    distances = layout.frame.radius * (low + (high - low) * draws[0])
    angles = math.tau * draws[1]
    least, most = (math.tan(math.radians(angle)) for angle in _ELEVATIONS)
    heights = distances * (least + (most - least) * draws[2])
    right, ahead = level_axes(layout.up)
    level = angles.cos() * right + angles.sin() * ahead
    center = layout.frame.center
    ground = 0.0 if layout.floor is None else layout.floor - float(center @ layout.up)
    return center + distances * level + (ground + heights) * layout.up


def checked_seed(seed: int) -> int:
    """Return a seed in the range of random generators; raise unless it is a whole number."""
    with suppress(TypeError):
        if not is_truth_value(seed):
            return index(seed) % _SEEDS
    raise InvalidArgumentError(f"seed must be a whole number, found {shown(seed)}.")


def as_positions(scene: SceneLike | CameraPositions) -> CameraPositions:
    """Return the argument if it holds positions, or find those of a scene."""
    return scene if isinstance(scene, CameraPositions) else find_view_positions(scene)


def lifted(layout: SceneLayout, eyes: Float[Tensor, "c 3"]) -> Float[Tensor, "c 3"]:
    """Return positions, with those too low mirrored at the least height above the floor."""
    if layout.floor is None:
        return eyes
    least = layout.floor + _ABOVE * layout.frame.radius
    lacking = (least - eyes @ layout.up).clamp_min(0)
    is_low = (lacking > 0).float()  # not of the default dtype
    return eyes + (2 * lacking + 1e-9 * layout.frame.radius * is_low)[:, None] * layout.up


def stand_free(layout: SceneLayout, eyes: Float[Tensor, "c 3"]) -> Bool[Tensor, "c"]:
    """Return which positions are above the floor, free, and not behind walls or inside matter."""
    radius, points = layout.frame.radius, layout.voxels.points
    free = torch.ones(len(eyes), dtype=torch.bool, device="cpu")
    if layout.floor is not None:
        free &= eyes @ layout.up >= layout.floor + _ABOVE * radius
    if len(points) == 0:
        return free
    local = layout.frame.normalize(eyes)
    free &= torch.cdist(local, points).amin(dim=1) >= FREE
    if layout.cutaway is not None:
        free &= ~_behind_walls(layout, layout.cutaway, local)
    for row in free.nonzero()[:, 0].tolist():
        above = enclosure(local[row], points, layout.up)
        if layout.room is not None:
            free[row] = above >= ENCLOSED
        elif above >= _BURIED:
            free[row] = enclosure(local[row], points, -layout.up) < _BURIED
    return free


def _behind_walls(
    layout: SceneLayout, middle: Float[Tensor, "3"], local: Float[Tensor, "c 3"]
) -> Bool[Tensor, "c"]:
    """Return which positions, in robust radii, are behind the walls of a room open to a side.

    Images were taken inside or from this side, so no wall may hide the middle, nor be at its level.
    """
    target, points = layout.frame.normalize(middle[None])[0], layout.voxels.points
    level = local - ((local - target) @ layout.up)[:, None] * layout.up
    steps = [step * layout.up for step in _WALL_STEPS]
    walls = torch.stack([are_hidden(level + step, target + step, points) for step in steps])
    return are_hidden(local, target, points) | (2 * walls.sum(dim=0) >= len(steps))


def _sharp_sides(layout: SceneLayout, eyes: Float[Tensor, "c 3"]) -> Bool[Tensor, "d"]:
    """Return which of the sides that some positions face are sharp; sides from below are not.

    The back of an object may be all smooth: sizes shrink with distance, though images were taken.
    """
    directions = _side_directions()
    sides, is_outside = _sides(layout, eyes)
    sharp = torch.zeros(len(directions), dtype=torch.bool, device="cpu")
    if layout.room is None:
        sharp[sides[is_outside]] = True
    sharp &= directions @ layout.up >= 0
    if not bool(sharp.any()):
        return sharp
    center, radius = layout.frame.center, layout.frame.radius
    cameras = cameras_at(
        center + _SIDE_DISTANCE * radius * directions[sharp],
        -directions[sharp],
        layout.up,
        size=(PIXELS, PIXELS),
        field=_SIDE_FIELD,
    )
    sharp[sharp.nonzero()[:, 0]] = splat_sizes(layout, cameras).in_scene <= SMOOTH
    return sharp


def _sees_sharp_sides(
    layout: SceneLayout, eyes: Float[Tensor, "c 3"], sharp_sides: Bool[Tensor, "d"]
) -> Bool[Tensor, "c"]:
    sides, is_outside = _sides(layout, eyes)
    return is_outside & sharp_sides[sides]


def _sides(
    layout: SceneLayout, eyes: Float[Tensor, "c 3"]
) -> tuple[Int[Tensor, "c"], Bool[Tensor, "c"]]:
    """Return the side that each position faces, and whether the position is outside."""
    offsets = layout.frame.normalize(eyes)
    is_outside = torch.linalg.vector_norm(offsets, dim=1) >= _OUTSIDE
    return (offsets @ _side_directions().T).argmax(dim=1), is_outside


def _side_directions() -> Float[Tensor, "d 3"]:
    """Return evenly spread unit vectors (a Fibonacci lattice, Gonzalez 2010)."""
    steps = torch.arange(_SIDES, dtype=torch.float64, device="cpu") + 0.5
    heights, angles = 1 - 2 * steps / _SIDES, steps * math.pi * (3 - math.sqrt(5))
    widths = (1 - heights.square()).sqrt()
    return torch.stack([widths * angles.cos(), widths * angles.sin(), heights], dim=1)


def _growths(layout: SceneLayout, eyes: Float[Tensor, "c 3"]) -> Float[Tensor, "c"]:
    def growths_from(part: slice) -> list[float]:
        return size_growths(layout.sized, eyes[part], layout.frame.radius)

    growths = chain(*in_chunks(growths_from, len(eyes), _EYES, HOST))
    return torch.tensor(list(growths), dtype=torch.float64, device="cpu")


def split_by_clutter(
    scene: GaussianScene, layout: SceneLayout, eyes: Float[Tensor, "p 3"]
) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "k 3"]]:
    """Return positions with a clear view of the middle, and others that look through clutter.

    From behind, large floaters hide a wall or a street: even the finest splats of an image are
    large. These are all positions and none; or, in a capture from one side, at most 64 together.
    """
    none = eyes[:0]
    if len(scene) < _FEW:
        return eyes, none
    few = eyes[:: -(-len(eyes) // _ASKED)]
    finest = splat_sizes(layout, _facing_middle(layout, few)).finest
    if _are_coarse(finest, _SUSPECT).double().mean() < _SUSPECTED:
        return eyes, none  # the sample, which has larger splats, shows as much
    sample, enlargement = covering_sample(viewable_part(scene), _SAMPLE)
    widths = splat_widths(sample) * torch.exp(-enlargement[:, 0].double())
    device = image_device(layout)
    sample, widths = sample.to(device), widths.to(device)
    for most in _MEASURED:
        few = eyes[:: -(-len(eyes) // most)]
        cameras = _facing_middle(layout, few)
        sizes = measure_splats(sample, widths, layout.frame.radius, cameras)
        coarse = _are_coarse(sizes.finest, _LARGE)
        if coarse.double().mean() < _CLUTTERED:
            return eyes, none
    return few[~coarse], few[coarse]


def _facing_middle(layout: SceneLayout, eyes: Float[Tensor, "p 3"]) -> Cameras:
    directions = layout.subject - eyes
    return cameras_at(eyes, directions, layout.up, size=(PIXELS, PIXELS), field=_FIELD)


def _are_coarse(finest: Float[Tensor, "p"], least: float) -> Bool[Tensor, "p"]:
    return finest > (_COARSE * finest.quantile(0.1)).clamp_min(least)
