"""Far groups in costs: they count more where less far mass is hidden than near mass."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cvtgs import Simplifier, concatenate, load, save
from cvtgs.analysis import analyze
from cvtgs.cells import Moments, merge_pairs
from cvtgs.cells.allocate import far_visibility
from cvtgs.config import AllocationConfig, SimplifyConfig
from cvtgs.grouping import FULL_GAIN, allocation_at
from cvtgs.outofcore import simplify_file
from cvtgs.scene import GaussianScene
from cvtgs.synthetic import scene as make

# Two similar pairs: one near the middle, one far away, where groups lie as far apart.
PLACES = [0.0, 0.1, 6.0, 6.1]
NEAR = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def groups_at(far_mass: float) -> Moments:
    """Return four groups, of mass 1 near the middle and of another far away."""
    ones = torch.ones(4)
    means = torch.tensor([PLACES, [0.0] * 4, [0.0] * 4])
    shapes = 0.01 * torch.tensor([1.0, 0, 0, 1, 0, 1])[:, None].expand(6, 4)
    masses = torch.tensor([1.0, 1.0, far_mass, far_mass])
    colors = torch.zeros(3, 4)
    return Moments(ones, masses, masses, means, shapes, colors, torch.zeros(0, 4))


def merged_pair(far_mass: float, **options: float) -> list[int]:
    """Return the two of four groups that merge."""
    config = AllocationConfig(heaviest=0.0, far_relief=0.0, widest=0.0, far_gain=options["gain"])
    area = options.get("area")
    labels = merge_pairs(groups_at(far_mass), NEAR, 3, config, area=area).tolist()
    (twice,) = {label for label in labels if labels.count(label) == 2}
    return [row for row, label in enumerate(labels) if label == twice]


def test_far_visibility_of_thin_and_deep_mass():
    assert far_visibility(0.5, 1e-9) == pytest.approx(1.0)
    # Far mass has four times as many directions, so that it hides a quarter of what near mass does.
    assert far_visibility(0.5, 1e9) == pytest.approx(4.0)
    layers = 0.8 * 20.0 / (4.0 * math.pi), 0.2 * 20.0 / math.pi
    far, near = ((1.0 - math.exp(-x)) / x for x in layers)
    assert far_visibility(0.8, 20.0) == pytest.approx(far / near)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("area", [0.0, 1e300, math.inf])
def test_far_visibility_is_finite(share: float, area: float):
    assert math.isfinite(far_visibility(share, area))


def test_far_groups_of_half_the_mass_merge_last_if_near_ones_hide_each_other():
    assert merged_pair(0.5, gain=9.0, area=1000.0) == [0, 1]


@pytest.mark.parametrize(
    "options",
    [
        {"gain": 1.0, "area": 1000.0},  # no gain
        {"gain": 9.0},  # the area is not known
        {"gain": 9.0, "area": 0.1},  # nothing hides anything
    ],
)
def test_lighter_far_groups_merge_first_otherwise(options: dict[str, float]):
    assert merged_pair(0.5, **options) == [2, 3]


@pytest.mark.parametrize(
    ("share", "gain"),
    [
        (0.5, 9.0),  # four times as visible as near mass
        (2.0 / 3.0, 3.0),  # twice
        (0.8, 1.0),  # as visible
        (0.97, 1.0),  # far mass hides itself
        (0.0, 1.0),
    ],
)
def test_the_gain_depends_on_how_visible_far_mass_is(share: float, gain: float):
    found = merge_pairs.__wrapped__.__globals__["_far_gain"]
    config = AllocationConfig(far_gain=9.0)
    assert found(share, 1e9, config) == pytest.approx(gain)
    assert found(share, None, config) == 1.0


@pytest.mark.parametrize(
    ("strength", "gain"), [(0.0, 1.0), (0.2, 3.0), (FULL_GAIN, 9.0), (1.0, 9.0)]
)
def test_gain_sets_in_with_the_mass_far_away(strength: float, gain: float):
    found = allocation_at(0.1, AllocationConfig(far_gain=9.0), unbounded=strength)
    assert found.far_gain == pytest.approx(gain)


@pytest.fixture(scope="module")
def walled() -> GaussianScene:
    """Return an object within a sphere of 300 large Gaussians, six robust radii away."""
    inner = make("object", 3000, sh_degree=0, seed=0)
    frame = analyze(inner, SimplifyConfig()).frame
    directions = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    means = frame.center + 6.0 * frame.radius * torch.nn.functional.normalize(directions.double())
    walls = replace(
        inner.select(torch.arange(300)),
        means=means.float(),
        log_scales=torch.full((300, 3), math.log(0.5 * frame.radius)),
        logit_opacities=torch.full((300,), 4.0),
    )
    return concatenate([inner, walls])


def far_count(scene: GaussianScene, small: GaussianScene) -> int:
    """Return how many Gaussians of a small scene are far from the middle of the full one."""
    frame = analyze(scene, SimplifyConfig()).frame
    return int((frame.distances(small.means) > 3.0).sum())


def test_walls_of_few_gaussians_keep_more_of_them(walled: GaussianScene):
    kept = [
        far_count(walled, Simplifier(config=config).simplify(walled, 0.1))
        for config in (SimplifyConfig(), SimplifyConfig(allocation=AllocationConfig(far_gain=1.0)))
    ]
    assert kept[0] > 1.2 * kept[1] > 0, kept


def test_blocks_keep_as_many_as_one_piece(walled: GaussianScene, tmp_path: Path):
    save(walled, tmp_path / "full.ply")
    one = far_count(walled, Simplifier().simplify(walled, 0.1))
    simplify_file(tmp_path / "full.ply", tmp_path / "small.ply", 0.1, blocks=3)
    assert far_count(walled, load(tmp_path / "small.ply")) == pytest.approx(one, rel=0.1)


def test_masses_at_the_distance_of_viewers_by_hand(monkeypatch: pytest.MonkeyPatch):
    """The gain of 9 sets in from 2.5 to 3 radii, and a heavy pair is one of a third of all."""
    names = merge_pairs.__wrapped__.__globals__
    costs, seen = names["_pair_costs"], []

    def record(table, first, second, config, heavy):
        seen.append((table[2].tolist(), heavy))
        return costs(table, first, second, config, heavy)

    monkeypatch.setitem(names, "_pair_costs", record)
    means = torch.tensor([[0.0, 2.75, 3.25, 9.0], [0.0] * 4, [0.0] * 4])
    config = AllocationConfig(heaviest=1.0, far_gain=9.0)
    merge_pairs(groups_at(1.0)._replace(means=means), NEAR, 3, config, area=1e9)
    assert seen == [(pytest.approx([1.0, 3.0, 9.0, 9.0]), pytest.approx((20.0 / 3.0, 1.0)))]
