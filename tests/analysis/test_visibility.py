"""Ambient visibility of Gaussians: boxes, haze, rooms, and invariances."""

import math

import pytest
import torch
from torch import Tensor

from cvtgs.analysis import ambient_visibility
from cvtgs.analysis.analyze import (
    add_depths,
    apparent_areas,
    empty_depth_grid,
    visibility_at,
    visibility_grid,
)
from cvtgs.config import TessellationConfig
from cvtgs.math.frames import RobustFrame

ORIGIN = torch.zeros(3, dtype=torch.float64)
UNIT = RobustFrame(center=ORIGIN, radius=1.0)


def box(half: float, step: float = 0.01) -> Tensor:
    """Points on the six faces of a cube."""
    line = torch.arange(-half, half + step / 2, step, dtype=torch.float64)
    u, v = (grid.flatten() for grid in torch.meshgrid(line, line, indexing="ij"))
    faces = []
    for axis in range(3):
        for side in (-half, half):
            face = torch.stack([u, v], dim=1)
            middle = torch.full((len(u), 1), side, dtype=torch.float64)
            faces.append(torch.cat([face[:, :axis], middle, face[:, axis:]], dim=1))
    return torch.cat(faces)


def light(points: Tensor, others: Tensor, *, mass: float, frame: RobustFrame = UNIT) -> Tensor:
    """Openness of points without mass among others of a mass."""
    means = torch.cat([points, others])
    masses = torch.cat([torch.zeros(len(points)), torch.full((len(others),), mass)]).double()
    return ambient_visibility(means, masses, frame)[: len(points)]


def test_one_wall_blocks_only_its_own_direction():
    """One heavy voxel two voxels to the right: five of six directions stay open."""
    points = torch.tensor([[0.02, 0.02, 0.02]], dtype=torch.float64)
    wall = points + torch.tensor([0.08, 0.0, 0.0])
    depth = 0.5
    found = light(points, wall, mass=depth * 0.04**2)
    assert found.item() == pytest.approx((5 + math.exp(-depth)) / 6, rel=1e-5)


def test_walls_that_contraction_shrinks_block_less():
    """A distance d above 1 becomes ``1 + log d``, so areas shrink by ``((1 + log d) / d)^2``."""
    places, depth = (2.02, 2.10), 0.5
    near, wall = (
        torch.tensor([[math.exp(place - 1), 0.001, 0.001]], dtype=torch.float64) for place in places
    )
    shrinkage = places[1] / math.exp(places[1] - 1)
    found = light(near, wall, mass=depth * (0.04 / shrinkage) ** 2)
    assert found.item() == pytest.approx((5 + math.exp(-depth)) / 6, rel=1e-5)


def test_matter_beyond_the_reach_is_ignored():
    points = torch.tensor([[0.02, 0.02, 0.02]], dtype=torch.float64)
    assert light(points, points + torch.tensor([6 * 0.04, 0, 0]), mass=1.0).item() < 0.9
    assert light(points, points + torch.tensor([7 * 0.04, 0, 0]), mass=1.0).item() == 1.0


def test_inside_a_small_box_is_dark_and_outside_is_bright():
    points = torch.tensor([[0.0, 0, 0], [0.5, 0.5, 0.5]], dtype=torch.float64)
    inside, outside = light(points, box(0.15), mass=1e-2).tolist()
    assert inside < 1e-3
    assert outside == 1.0


def test_the_middle_of_a_room_is_bright_and_its_walls_are_open_to_the_inside():
    walls = box(0.8)
    found = ambient_visibility(walls, torch.full((len(walls),), 1e-2).double(), UNIT)
    assert light(torch.zeros(1, 3).double(), walls, mass=1e-2).item() == 1.0
    faces = (walls.abs() > 0.79).sum(dim=1) == 1
    assert float(found[faces].median()) == pytest.approx(2 / 6)  # in front and behind
    assert float(found[faces].amin()) > 0.15  # along an edge, in front only


def test_haze_stays_open():
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    found = ambient_visibility(points, torch.full((20_000,), 1e-6).double(), UNIT)
    assert float(found.mean()) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_the_unit_of_length_and_the_place_do_not_matter(size):
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)).double()
    masses = torch.rand(500, generator=torch.Generator().manual_seed(2)).double() * 1e-2
    frame = RobustFrame(center=ORIGIN + 5.0, radius=size)
    moved = ambient_visibility(points * size + 5.0, masses * size**2, frame)
    torch.testing.assert_close(moved, ambient_visibility(points, masses, UNIT), atol=1e-4, rtol=0)


def test_the_order_does_not_change_a_bit():
    points = torch.randn(3000, 3, generator=torch.Generator().manual_seed(1)).double()
    masses = torch.rand(3000, generator=torch.Generator().manual_seed(2)).double()
    shuffle = torch.randperm(3000, generator=torch.Generator().manual_seed(3))
    shuffled = ambient_visibility(points[shuffle], masses[shuffle], UNIT)
    assert torch.equal(shuffled, ambient_visibility(points, masses, UNIT)[shuffle])


@pytest.mark.parametrize("far", [1e6, 3e38])
def test_flyaways_are_fully_visible_and_hide_nothing(far):
    points = torch.zeros(3, 3)
    points[1:, 0] = far
    found = ambient_visibility(points, torch.tensor([1.0, 1e30, 1.0]).double(), UNIT)
    assert found.tolist() == [1.0, 1.0, 1.0]


def test_parts_of_a_scene_add_up_to_the_same_grid():
    means = torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)).double()
    masses = torch.full((5000,), 1e-3).double()
    sums = empty_depth_grid(means.device)
    for rows in (slice(3000, None), slice(None, 3000)):
        add_depths(sums, means[rows], masses[rows], UNIT)
    found = visibility_at(visibility_grid(sums), means, UNIT)
    assert torch.equal(found, ambient_visibility(means, masses, UNIT))
    assert found.amin() < 0.9
    assert float(visibility_grid(empty_depth_grid(means.device)).amin()) == 1.0


def test_enclosed_and_far_gaussians_count_less() -> None:
    """By the share of an enclosed one, and by the square of the distance in robust radii."""
    areas, distances, seen = torch.tensor(
        [[8.0, 8.0, 8.0, 8.0], [0.5, 1.0, 1.0, 2.0], [1.0, 0.0, 0.5, 0.0]], dtype=torch.float64
    )
    config = TessellationConfig(hidden_share=0.25)
    found = apparent_areas(areas, distances, seen, config=config)
    assert found.tolist() == [8.0, 2.0, 5.0, 0.5]
    config = TessellationConfig(hidden_share=1.0, perspective=False)
    assert apparent_areas(areas, distances, seen[:0], config=config).tolist() == [8.0] * 4


def test_a_mass_beyond_whole_numbers_only_blocks_its_direction():
    means = torch.tensor([[0.01, 0.01, 0.01], [0.05, 0.01, 0.01]]).double()
    found = ambient_visibility(means, torch.tensor([0.0, 1e300]).double(), UNIT)
    assert found.tolist() == pytest.approx([5 / 6, 1.0])
