"""A second allocation where a first result errs in the images of given cameras."""

from functools import cache

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.cameras import Cameras
from cvtgs.cells import Partition
from cvtgs.grouping import factors_by_errors, factors_of_members
from cvtgs.matching import mean_squared_error
from cvtgs.rendering import observe
from cvtgs.synthetic import scene as make
from cvtgs.views import automatic_views
from scenes import random_scene

COUNT = 300


@cache
def full() -> GaussianScene:
    return make("object", 3000, sh_degree=1, seed=0)


@cache
def given_cameras() -> Cameras:
    return automatic_views(full(), 6, width=64, height=64)


def matched(power: float, *, rounds: int = 1, **steps: int) -> Simplifier:
    settings = {
        "match": {"error_power": power, "opacity_rounds": rounds},
        "visibility": {"views": 8, "size": 64, "stride": 1},
        "refine": {"steps": 0, "size": 64, "stride": 1} | steps,
    }
    config = SimplifyConfig.model_validate({"preset": "matched"} | settings)
    return Simplifier(config=config, device="cpu")


@pytest.mark.slow
def test_cells_merge_less_where_the_given_cameras_see_errors():
    once, twice = (
        matched(power).run(full(), count=COUNT, cameras=given_cameras()) for power in (0.0, 1.0)
    )
    assert [len(once.scene), len(twice.scene)] == [COUNT, COUNT]
    stages = [stage.stage for stage in twice.report.stages]
    assert "errors" in stages
    assert "errors" not in [stage.stage for stage in once.report.stages]
    assert len(stages) == len(set(stages))  # stages that run twice have one cost
    views = observe(full(), given_cameras())
    errors = [mean_squared_error(result.scene, views) for result in (once, twice)]
    assert errors[1] < 0.95 * errors[0]


def test_errors_count_without_a_match_of_opacities():
    once, twice = (
        matched(power, rounds=0).run(full(), count=COUNT, cameras=given_cameras())
        for power in (0.0, 1.0)
    )
    assert not same(once.scene, twice.scene)
    assert twice.report.matching is None
    assert twice.report.stages[-1].stage == "errors"


@pytest.mark.slow
def test_errors_in_generated_views_do_not_count():
    found = [matched(power).simplify(full(), count=COUNT) for power in (0.0, 1.0)]
    assert same(*found)


def test_a_scene_that_stays_whole_and_a_preset_without_images_are_not_affected():
    simplifier = matched(1.0)
    assert len(simplifier.simplify(full(), 1.0, cameras=given_cameras())) == len(full())
    config = SimplifyConfig.model_validate({"match": {"error_power": 1.0}})
    plain = Simplifier(config=config, device="cpu").simplify(
        full(), count=COUNT, cameras=given_cameras()
    )
    assert same(plain, Simplifier(device="cpu").simplify(full(), count=COUNT))


@pytest.mark.long
def test_levels_and_repeated_runs_have_the_bits_of_single_runs():
    wanted = matched(1.0).simplify(full(), count=COUNT, cameras=given_cameras())
    prepared = matched(1.0).prepare(full(), cameras=given_cameras())
    for _ in range(3):
        assert same(prepared.run(count=COUNT).scene, wanted)
    levels = matched(1.0).levels(full(), [0.3, COUNT / len(full())], cameras=given_cameras())
    assert same(levels[1].scene, wanted)


def test_protected_gaussians_stay_and_come_first():
    keep = torch.zeros(len(full()), dtype=torch.bool)
    keep[::20] = True
    found = matched(1.0).simplify(full(), count=COUNT, cameras=given_cameras(), keep=keep)
    assert len(found) == COUNT
    assert torch.equal(found.means[: int(keep.sum())], full().means[keep])


def test_a_refinement_and_float64_follow():
    tensors = {name: tensor.double() for name, tensor in full().tensors().items()}
    scene = full().with_tensors(tensors, {})
    result = matched(1.0, steps=2).run(scene, count=COUNT, cameras=given_cameras())
    assert result.report.refinement is not None
    assert result.scene.dtype == torch.float64
    assert len(result.scene) == COUNT


def test_factors_follow_the_errors_of_a_cell_and_its_neighbours():
    means = random_scene(30, seed=1).means
    cells = Partition.from_labels(torch.arange(60) % 30, 30)
    pixels, errors = torch.full((30,), 1e6), torch.ones(30, dtype=torch.float64)

    def factors(errors: torch.Tensor, pixels: torch.Tensor, power: float = 1.0) -> torch.Tensor:
        found = factors_by_errors(means, errors=errors, pixels=pixels, power=power)
        return factors_of_members(found, cells, 62)

    even = factors(errors, pixels)
    assert even.tolist() == pytest.approx([1.0] * 62)
    assert factors(0 * errors, pixels).tolist() == pytest.approx([1.0] * 62)
    overflow = errors.clone()
    overflow[3:5] = torch.tensor([torch.nan, torch.inf])
    assert bool(factors(overflow, pixels).isfinite().all())
    errors[3] = 50.0
    found = factors(errors, pixels)
    assert int(found.argmax()) in (3, 33)
    assert float(found[3]) == float(found[33])
    assert found[60:].tolist() == [1.0, 1.0]  # rows in no cell
    errors[3] = 1e9
    assert float(factors(errors, pixels, power=2.0).max()) == 12.0
    hidden = pixels.clone()
    hidden[3] = 0.0  # no image shows it
    assert float(factors(errors, hidden)[3]) == 1.0


def same(one: cvtgs.GaussianScene, other: cvtgs.GaussianScene) -> bool:
    pairs = zip(one.tensors().values(), other.tensors().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def test_errors_are_those_of_cells_and_not_of_protected_gaussians(monkeypatch):
    scene, seen = make("object", COUNT, sh_degree=0, seed=0), []

    def factors(means, **values):
        seen.append(values["errors"].tolist())
        return torch.ones(len(means), dtype=torch.float64)

    monkeypatch.setattr(cvtgs.prepared, "factors_by_errors", factors)
    monkeypatch.setattr(cvtgs.rendering, "error_shares", lambda drawn, _: torch.arange(len(drawn)))
    values = {
        "preset": "matched",
        "match": {"error_power": 1.0},
        "visibility": {"views": 2, "size": 32, "stride": 1},
        "refine": {"steps": 0},
    }
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(values), device="cpu")
    cameras = automatic_views(scene, 2, width=32, height=32)
    simplifier.simplify(scene, count=30, keep=torch.arange(COUNT) < 10, cameras=cameras)
    assert seen == [list(range(10, 30))]


def test_factors_of_errors_have_a_geometric_mean_of_one():
    """Of those that images show: the others have a factor near 1 and do not count."""
    found = factors_by_errors(
        random_scene(30, seed=1).means,
        errors=torch.linspace(1, 3, 30).double(),
        pixels=torch.where(torch.arange(30) < 15, 1e6, 1.0),
        power=1.0,
    )
    assert float(found.log().sum()) == pytest.approx(0.0, abs=1e-9)


def test_half_of_the_errors_of_neighbours_and_a_fiftieth_of_the_mean_are_added():
    """Of four cells, each with the others as neighbours; the last one is not seen."""
    found = factors_by_errors(
        torch.eye(4)[:, :3],
        errors=torch.tensor([1.0, 0.0, 0.0, torch.nan]).double(),
        pixels=torch.tensor([1e12, 1e12, 1e12, 0.0]).double(),
        power=0.5,
    )
    high, low = 1.0 + 0.02 * 0.625, 0.5 + 0.02 * 0.625
    common = (high * low * low) ** (1 / 3)
    wanted = [(high / common) ** 0.5, (low / common) ** 0.5, (low / common) ** 0.5, 1.0]
    assert found.tolist() == pytest.approx(wanted)
