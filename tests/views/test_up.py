"""Which way is up, from sizes of Gaussians where there is no floor."""

import math

import pytest
import torch
from torch import Tensor

import cvtgs
from cvtgs.views.layout import find_layout, is_enclosed
from cvtgs.views.up import Voxels, find_up

NO_SKY = torch.zeros(0, 3, dtype=torch.float64)
USUAL = {"-y": (0.0, -1.0, 0.0), "+y": (0.0, 1.0, 0.0), "+z": (0.0, 0.0, 1.0)}


def ball(correlation: float, unseen: Tensor) -> Voxels:
    """Return a ball whose sizes correlate with the coordinate towards an unseen side."""
    steps = torch.arange(2000).double() + 0.5
    heights, angles = 1 - 2 * steps / 2000, steps * math.pi * (3 - math.sqrt(5))
    widths = (1 - heights.square()).sqrt()
    points = torch.stack([widths * angles.cos(), widths * angles.sin(), heights], dim=1)
    noise = torch.randn(2000, generator=torch.Generator().manual_seed(0)).double()
    toward = math.sqrt(3) * (points @ unseen)  # of variance 1
    sizes = correlation * toward + math.sqrt(1 - correlation**2) * noise
    return Voxels(points=points, normals=points, log_sizes=sizes)


@pytest.mark.parametrize("name", USUAL)
def test_what_no_image_has_seen_is_below(name: str) -> None:
    """Captured statues have correlations of 0.25 to 0.55."""
    up = torch.tensor(USUAL[name]).double()
    assert find_up(ball(0.25, -up), NO_SKY).tolist() == list(USUAL[name])


def test_a_weak_sign_does_not_outweigh_what_is_usual() -> None:
    for up in USUAL.values():
        found = find_up(ball(0.05, -torch.tensor(up).double()), NO_SKY)
        assert found.tolist() == list(USUAL["-y"])


@pytest.mark.parametrize("name", USUAL)
def test_a_thin_scene_that_is_bare_on_both_sides_has_large_gaussians_below(name: str) -> None:
    """Such as a stone on grass, captured without what is around."""
    up = torch.tensor(USUAL[name]).double()
    side = torch.linspace(-2, 2, 45).double()
    flat = torch.cartesian_prod(side, side) @ torch.linalg.svd(up[None]).Vh[1:]
    points = torch.cat([flat, flat + 0.12 * up])
    sizes = torch.zeros(len(points)).double()
    sizes[: len(flat)] = 1.0
    normals = up.expand_as(points).clone()
    voxels = Voxels(points=points, normals=normals, log_sizes=sizes)
    assert find_up(voxels, NO_SKY).tolist() == list(USUAL[name])


@pytest.mark.parametrize("name", ["-y", "+y"])
def test_things_stand_on_wide_feet(name: str) -> None:
    """A cone, whose Gaussians are all of one size."""
    up = torch.tensor(USUAL[name]).double()
    voxels = ball(0.0, up)
    heights = voxels.points @ up
    points = voxels.points + (0.5 * (1 + heights).square() - heights)[:, None] * up
    cone = Voxels(points=points, normals=voxels.normals, log_sizes=torch.zeros(2000).double())
    assert find_up(cone, NO_SKY).tolist() == list(USUAL[name])


@pytest.mark.parametrize("side", [(1.0, 0, 0), (-1.0, 0, 0), (0, 0, 1.0)])
def test_an_unseen_back_is_not_below(side: tuple[float, ...]) -> None:
    """A file with y down of an object that was seen from one side only."""
    voxels = ball(0.9, torch.tensor(side).double())
    assert find_up(voxels, NO_SKY).tolist() == list(USUAL["-y"])


def test_sizes_say_nothing_of_a_scene_that_is_seen_from_its_middle() -> None:
    voxels = ball(0.9, torch.tensor([0.0, -1.0, 0.0]).double())
    assert find_up(voxels, NO_SKY).tolist() == list(USUAL["+y"])
    assert find_up(voxels, NO_SKY, enclosed=True).tolist() == list(USUAL["-y"])


@pytest.mark.slow
@pytest.mark.parametrize("count", [3000, 10_000, 30_000])
def test_rooms_are_not_upside_down(count: int) -> None:
    """Their ceilings consist of large Gaussians, like what no image has seen."""
    layout = find_layout(cvtgs.synthetic.scene("room", count, sh_degree=0, seed=2))
    assert is_enclosed(layout.voxels.points)
    assert layout.up.tolist() == list(USUAL["-y"])


def test_a_shell_is_enclosed_until_it_is_open_to_one_side() -> None:
    shell = ball(0.0, torch.tensor([0.0, 0.0, 1.0]).double()).points
    assert is_enclosed(shell)
    assert not is_enclosed(shell[shell[:, 2] > 0.0])
    assert not is_enclosed(shell[shell[:, 2] < 0.0])


@pytest.mark.parametrize("kind", ["object", "courtyard", "landscape"])
def test_objects_and_places_are_not_enclosed(kind: str) -> None:
    layout = find_layout(cvtgs.synthetic.scene(kind, 10_000, sh_degree=0, seed=2))
    assert not is_enclosed(layout.voxels.points)
    assert not is_enclosed(layout.voxels.points[:0])
