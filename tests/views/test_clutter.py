"""Clutter: floaters that hide a capture from all but one side."""

import math
from dataclasses import replace

import pytest
import torch

import cvtgs
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views, find_view_positions, mixed_views
from cvtgs.views.layout import covering_sample, find_layout
from cvtgs.views.positions import split_by_clutter

DETAIL = 0.005
FLOATER = 0.25


def wall(floaters: int) -> GaussianScene:
    """Return a finely textured wall at z = 0, with floaters around the side of larger z."""
    generator = torch.Generator().manual_seed(0)
    plane = 2 * torch.rand(30_000, 3, generator=generator) - 1
    plane[:, 2] *= 0.05
    around = torch.randn(4 * floaters + 4, 3, generator=generator)
    around = torch.nn.functional.normalize(around, dim=1)
    shell = around[around[:, 2] > 0.2][:floaters]
    means = torch.cat([plane, 1.2 * shell])
    log_scales = torch.full((len(means), 3), math.log(DETAIL))
    log_scales[len(plane) :] = math.log(FLOATER)
    return cvtgs.from_dict(
        {
            "means": means,
            "scales": log_scales,
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(means), 4),
            "opacities": torch.full((len(means),), 3.0),
            "sh0": torch.rand(len(means), 1, 3, generator=generator),
            "shN": torch.zeros(len(means), 0, 3),
        }
    )


def ring(*heights: float) -> torch.Tensor:
    """Return positions around the middle at several places along z."""
    angles = torch.arange(8).double() * (math.pi / 4)
    level = 0.3 * torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    return torch.cat([level + torch.tensor([0.0, 0.0, z]).double() for z in heights])


def test_positions_behind_floaters_are_cluttered():
    scene = wall(60)
    clear, cluttered = split_by_clutter(scene, find_layout(scene), ring(-2.5, 2.5))
    assert len(clear) == len(cluttered) == 8
    assert float(clear[:, 2].amax()) < 0 < float(cluttered[:, 2].amin())


@pytest.mark.slow
@pytest.mark.parametrize(("heights", "floaters"), [((-2.5, 2.5), 0), ((-2.5, -2.0, -3.0, 2.5), 60)])
def test_without_much_clutter_all_positions_stay(heights, floaters):
    """Without floaters, or where a quarter of all positions is behind them."""
    scene = wall(floaters)
    eyes = ring(*heights)
    clear, cluttered = split_by_clutter(scene, find_layout(scene), eyes)
    assert torch.equal(clear, eyes)
    assert len(cluttered) == 0


def test_scenes_of_few_gaussians_are_coarse_from_everywhere():
    scene = wall(60).select(torch.arange(30_000 - 10_500, 30_060))
    eyes = ring(-2.5, 2.5)
    assert torch.equal(split_by_clutter(scene, find_layout(scene), eyes)[0], eyes)


@pytest.mark.slow
def test_an_outdoor_place_without_clutter_keeps_its_positions():
    """Its sample alone would look coarse: grass and walls are thinned, haze is not."""
    scene = cvtgs.synthetic.scene("courtyard", 30_000, sh_degree=0, seed=0)
    assert len(find_view_positions(scene).cluttered) == 0


@pytest.mark.slow
def test_no_position_is_nearer_to_a_cluttered_one_than_to_a_clear_one():
    layout = find_layout(wall(0))
    radius = layout.frame.radius
    positions = replace(
        find_view_positions(wall(0)),
        eyes=torch.tensor([[0.0, 0.0, -2.0 * radius]]).double(),
        cluttered=torch.tensor([[0.0, 0.0, 2.0 * radius]]).double(),
        least_growth=-2.0,
    )
    eyes = radius * torch.tensor([[0.0, 0, -2.1], [0, 0, -2.9], [0, 0, -3.1], [0, 0, 2.1]]).double()
    assert positions.admit(eyes).tolist() == [True, True, False, False]
    free = replace(positions, cluttered=positions.cluttered[:0])
    assert free.admit(eyes).tolist() == [True, True, True, True]
    both = replace(
        positions,
        eyes=radius * torch.tensor([[0.0, 0.0, -0.5]]).double(),
        cluttered=radius * torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 9.0]]).double(),
    )
    eyes = radius * torch.tensor([[0.0, 0.0, -0.4], [0.0, 0.0, 0.4]]).double()
    assert both.admit(eyes).tolist() == [True, False]


def test_views_are_at_clear_positions(monkeypatch):
    """Positions with z above 0 are cluttered, whatever is there."""

    def split(_scene, _layout, eyes):
        return eyes[eyes[:, 2] < 0], eyes[eyes[:, 2] >= 0]

    monkeypatch.setattr("cvtgs.views.positions.split_by_clutter", split)
    scene = cvtgs.synthetic.scene("object", 3000, sh_degree=0, seed=0)
    positions = find_view_positions(scene)
    assert len(positions.eyes) == len(positions.distances) > 0
    for cameras in (
        automatic_views(positions, 6, width=64, height=48),
        mixed_views(positions, 12, size=64),
    ):
        eyes = cameras.centers
        clear, cluttered = (
            torch.cdist(eyes, others).amin(dim=1)
            for others in (positions.eyes, positions.cluttered)
        )
        assert bool((clear <= cluttered).all())


def test_a_sample_tells_by_how_much_it_is_enlarged():
    scene = wall(0)
    sample, enlargement = covering_sample(scene, 17_500)
    assert len(sample) == len(enlargement) <= 17_500
    assert enlargement[:5000].tolist() == [[0.0]] * 5000
    assert float(enlargement[-1]) == pytest.approx(0.5 * math.log(2), rel=1e-3)
    whole, none = covering_sample(scene, 30_000)
    assert len(whole) == 30_000
    assert not bool(none.any())
