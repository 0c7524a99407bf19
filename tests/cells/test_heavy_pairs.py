"""Costs of pairs that hold much of the apparent mass of a scene that is mostly far."""

import pytest
import torch

from cvtgs import Simplifier, SimplifyConfig
from cvtgs.cells import Moments, merge_pairs
from cvtgs.config import AllocationConfig
from scenes import under_sky


def groups_at(places: list[float], masses: list[float]) -> Moments:
    count = len(places)
    means = torch.zeros(3, count)
    means[0] = torch.tensor(places)
    return Moments(
        counts=torch.ones(count),
        masses=torch.ones(count),
        apparent_masses=torch.tensor(masses),
        means=means,
        covariances=torch.full((6, count), 1e-4) * torch.tensor([1.0, 0, 0, 1, 0, 1])[:, None],
        colors=torch.zeros(3, count),
        view_colors=torch.zeros(0, count),
    )


def merged_pair(places: list[float], masses: list[float], **changes: float) -> list[int]:
    """Return the rows that merge, of two pairs that are not candidates for one another."""
    near = torch.tensor([[1], [0], [3], [2]])
    config = AllocationConfig(mass_power=0.0, widest=0.0, **changes)
    labels = merge_pairs(groups_at(places, masses), near, 3, config).tolist()
    return [row for row in range(4) if labels.count(labels[row]) == 2]


@pytest.mark.parametrize(("heaviest", "merged"), [(0.0, [2, 3]), (1.0, [0, 1]), (1e9, [2, 3])])
def test_a_heavy_pair_costs_more_where_mass_is_far(heaviest: float, merged: list[int]) -> None:
    """The far pair is a tenth closer, and has nearly all the mass."""
    places, masses = [0.0, 0.1, 9.0, 9.09], [1.0, 1.0, 50.0, 50.0]
    assert merged_pair(places, masses, heaviest=heaviest) == merged


@pytest.mark.parametrize("heaviest", [0.0, 1.0])
def test_a_bounded_scene_has_no_heavy_pairs(heaviest: float) -> None:
    places, masses = [0.0, 0.1, 0.9, 0.99], [1.0, 1.0, 50.0, 50.0]
    assert merged_pair(places, masses, heaviest=heaviest) == [2, 3]


def test_the_factor_by_hand() -> None:
    """A power of 1 from a share of 0.3 of far mass on, and in proportion below."""
    costs = merge_pairs.__wrapped__.__globals__["_pair_costs"]
    groups = groups_at([0.0, 0.1], [3.0, 4.0])
    table = torch.cat([torch.atleast_2d(values).float() for values in groups])
    pair, config = (torch.tensor([0]), torch.tensor([1])), AllocationConfig()
    plain = float(costs(table, *pair, config, (0.0, 0.0)))
    for mass, power in ((7.0, 1.0), (3.5, 0.5), (0.0, 1.0), (7.0, 0.0)):
        factor = (1.0 + 7.0 / mass) ** power if mass else 1.0
        found = float(costs(table, *pair, config, (mass, power)))
        assert found == pytest.approx(factor * plain, rel=1e-5)


def test_a_sky_of_few_gaussians_keeps_many_of_them() -> None:
    """Groups of few members would merge first."""
    colors = torch.rand(200, 1, 3, generator=torch.Generator().manual_seed(2))
    scene, kept = under_sky(200, distance=100.0, color=colors), []
    for heaviest in (0.0, 20.0):
        config = SimplifyConfig.from_mapping({"allocation": {"heaviest": heaviest}})
        small = Simplifier(None, config=config, device="cpu").simplify(scene, 0.1)
        kept.append(int((small.means.norm(dim=1) > 50.0).sum()))
    before, after = kept
    assert after > 1.3 * before
