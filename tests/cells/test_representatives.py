"""Members that stand for their cell where the members hardly touch."""

import math

import pytest
import torch

from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.cells import Partition, keep_representatives, merge_cells
from cvtgs.config import MergeConfig
from hard_cases import CASES
from hard_scenes import ball
from scenes import random_scene, same_bits


def kept(scene: GaussianScene, labels: torch.Tensor) -> tuple[GaussianScene, Partition]:
    part = Partition.from_labels(labels, int(labels.amax()) + 1)
    merged = merge_cells(scene, part, config=MergeConfig())
    return keep_representatives(scene, merged, part, areas=scene.areas)


def balls(distance: float, *, size: float = 1.0) -> GaussianScene:
    """Two equal balls."""
    scene = random_scene(2, dtype=torch.float64).select(torch.tensor([0, 0]))
    means = torch.tensor([[0.0, 0, 0], [distance, 0, 0]]).double()
    log_scales = torch.full((2, 3), math.log(size)).double()
    return scene.with_tensors({"means": means, "log_scales": log_scales}, {})


def test_of_two_points_far_apart_the_one_that_shows_more_stays():
    scene = random_scene(6, dtype=torch.float64)
    means = 1e3 * torch.cat([torch.eye(3), -torch.eye(3)]).double()
    sizes = torch.tensor([1.0, 2.0, 1.0, 1.1, 1.0, 2.0]).double().log()[:, None].expand(-1, 3)
    logits = torch.tensor([2.0, 0.0, 2.0, 2.0, 2.0, -0.4]).double()
    # a^2 A is 0.776, then 0.25 * 4 = 1; 0.776, 0.939; and 0.776, 0.644, of more mass.
    tensors = {"means": means, "log_scales": sizes, "logit_opacities": logits}
    scene = scene.with_tensors(tensors, {"label": torch.arange(6)})
    small, part = kept(scene, torch.tensor([0, 0, 1, 1, 2, 2]))
    assert same_bits(small, scene.select(torch.tensor([1, 3, 4])))
    assert (part.order.tolist(), part.offsets.tolist()) == ([1, 3, 4], [0, 1, 2, 3])


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e3, 1e30])
def test_two_balls_part_where_their_merged_area_is_four_times_one(unit):
    """(2 m)^2 / 4 A is m^2 / A. The shadow of an ellipsoid of axes (s, 1, 1) is four times
    that of a ball at s = 5.01: half the surface of a prolate spheroid, over 2 pi."""
    s = 5.0075
    e = math.sqrt(1 - 1 / s**2)
    assert 0.5 * (1 + s / e * math.asin(e)) == pytest.approx(4, rel=1e-3)
    for reach, count in ((0.98 * s, 2), (1.02 * s, 1)):  # the formula for areas errs by 1 percent
        distance = 2 * math.sqrt(reach**2 - 1)
        scene = balls(unit * distance, size=unit)
        assert len(kept(scene, torch.tensor([0, 0]))[1].order) == count


def test_cells_whose_members_touch_and_cells_of_one_are_left_alone():
    scene = ball(40, torch.float64)
    alike = {"log_scales": torch.ones(40, 3), "logit_opacities": torch.ones(40)}
    scene = scene.with_tensors({name: values.double() for name, values in alike.items()}, {})
    labels = torch.arange(40) // 2
    labels[0] = 20
    part = Partition.from_labels(labels, 21)
    merged = merge_cells(scene, part, config=MergeConfig())
    small, members = keep_representatives(scene, merged, part, areas=scene.areas)
    assert small is merged
    assert members is part


def test_some_cells_of_many():
    near, far = balls(0.5), balls(1e3)
    tensors = {
        name: torch.cat([values, far.tensors()[name], values])
        for name, values in near.tensors().items()
    }
    scene = near.with_tensors(tensors, {})
    labels = torch.tensor([2, 2, 0, 0, 1, 1])
    small, part = kept(scene, labels)
    assert part.offsets.tolist() == [0, 1, 3, 5]
    assert part.order.tolist() == [2, 4, 5, 0, 1]
    assert torch.equal(small.means[0], scene.means[2])
    assert same_bits(small.select(torch.tensor([1, 2])), merged_of(scene, labels))


def merged_of(scene: GaussianScene, labels: torch.Tensor) -> GaussianScene:
    part = Partition.from_labels(labels, 3)
    return merge_cells(scene, part, config=MergeConfig()).select(torch.tensor([1, 2]))


@pytest.mark.parametrize("network", [None, "standard"])
def test_points_stay_points(network):
    """Neither widened nor corrected: rows of the input, bit for bit."""
    scene = CASES["points"](200, torch.float32)
    small, report = Simplifier(network, device="cpu").run(scene, 0.2)
    rows = {tuple(row) for row in scene.means.tolist()}
    inside = torch.tensor([tuple(row) in rows for row in small.means.tolist()])
    assert int(inside.sum()) >= 38
    assert bool((small.log_scales[inside] == -40).all())
    assert report.single_member_cells == int(inside.sum())


def test_paper_keeps_moments():
    scene, paper = CASES["points"](200, torch.float32), SimplifyConfig.from_preset("paper")
    assert not paper.merge.representatives
    small = Simplifier(None, config=paper, device="cpu").simplify(scene, 0.2)
    assert bool((small.log_scales[:, 0] > -10).all())
