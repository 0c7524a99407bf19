"""The whole tessellation."""

from inspect import unwrap

import pytest
import torch

from cvtgs.config import SimplifyConfig, TessellationConfig
from cvtgs.cvt import (
    Tessellation,
    choose_seeds,
    fill_empty_cells,
    lloyd,
    nearest_site,
    stratified_seeds,
    tessellate,
    weighted_seeds,
)
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import morton_order

CONFIGS = {name: SimplifyConfig.from_preset(name).cvt for name in ("standard", "paper")}
each_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)


def weighted_cloud(count: int, d: int = 3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    points = torch.randn(count, d, generator=g, dtype=torch.float64)
    points = points[morton_order(points[:, :3])]
    return points, torch.exp(torch.randn(count, generator=g, dtype=torch.float64))


def assert_complete(result: Tessellation, total: int, count: int) -> None:
    assert result.labels.shape == (total,)
    assert torch.equal(torch.unique(result.labels), torch.arange(count))
    assert len(result.sites) == count


def test_three_clusters_are_found():
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [9, 0, 0], [9.5, 0, 0], [0, 9, 0]])
    result = tessellate(points, torch.ones(5), 3, config=TessellationConfig())
    assert result.labels.tolist() == [0, 0, 1, 1, 2]
    assert result.sites.tolist() == [[0.25, 0, 0], [9.25, 0, 0], [0, 9, 0]]
    assert result.energy == 4 * 0.25**2
    assert result.refilled == 0


@each_config
@pytest.mark.parametrize("d", [3, 6])
@pytest.mark.parametrize(
    ("total", "count"), [(1, 1), (2, 1), (2, 2), (50, 49), (50, 50), (1000, 10), (2000, 333)]
)
def test_partition_is_complete_and_no_cell_is_empty(total, count, d, config):
    points, weights = weighted_cloud(total, d)
    result = tessellate(points, weights, count, config=config)
    assert_complete(result, total, count)
    assert result.energy >= 0


@each_config
@pytest.mark.parametrize("count", [1, 7, 99, 100])
def test_coincident_points(count, config):
    result = tessellate(torch.ones(100, 3).double(), torch.ones(100).double(), count, config=config)
    assert_complete(result, 100, count)
    assert result.energy == 0.0
    assert result.refilled == (count - 1 if count < 100 else 0)  # one each: nothing to fill


@each_config
def test_duplicates_and_weights_of_zero(config):
    points, _ = weighted_cloud(100)
    weights = torch.zeros(300, dtype=torch.float64)
    assert_complete(tessellate(points.repeat(3, 1), weights, 250, config=config), 300, 250)


def test_labels_name_the_nearest_site():
    points, weights = weighted_cloud(1000)
    result = tessellate(points, weights, 40, config=CONFIGS["standard"])
    assert result.refilled == 0
    distances = torch.cdist(points, result.sites)
    torch.testing.assert_close(
        distances.gather(1, result.labels[:, None])[:, 0], distances.amin(dim=1)
    )
    wanted = float((weights * distances.amin(dim=1).square()).sum())
    assert result.energy == pytest.approx(wanted)


@pytest.mark.parametrize("seeding", ["stratified", "weighted"])
def test_more_iterations_lower_the_energy(seeding):
    points, weights = weighted_cloud(3000)
    energies = [
        tessellate(
            points, weights, 100,
            config=TessellationConfig(
                iterations=iterations, seeding=seeding, tolerance=0.0, samples_per_site=0
            ),
        ).energy
        for iterations in (0, 1, 4, 12)
    ]  # fmt: skip
    assert energies == sorted(energies, reverse=True)
    assert energies[-1] < 0.8 * energies[0]


def test_a_sample_is_nearly_as_good_as_all_points(monkeypatch):
    monkeypatch.setitem(unwrap(tessellate).__globals__, "MIN_SAMPLES", 1)
    points, weights = weighted_cloud(20_000)
    of_sample, of_all, unmoved = (
        tessellate(
            points, weights, 100,
            config=TessellationConfig(iterations=iterations, samples_per_site=samples),
        )
        for iterations, samples in ((5, 24), (5, 0), (0, 0))
    )  # fmt: skip
    assert_complete(of_sample, 20_000, 100)
    assert not torch.equal(of_sample.labels, of_all.labels)
    assert of_sample.energy < 1.05 * of_all.energy < 0.95 * unmoved.energy


def test_a_sample_is_never_tiny(monkeypatch):
    points, weights = weighted_cloud(20_000)
    config = TessellationConfig(samples_per_site=24)
    monkeypatch.setitem(unwrap(tessellate).__globals__, "MIN_SAMPLES", 8000)
    some = tessellate(points, weights, 3, config=config)
    monkeypatch.setitem(unwrap(tessellate).__globals__, "MIN_SAMPLES", 1)
    few = tessellate(points, weights, 3, config=config)
    everything = tessellate(points, weights, 3, config=TessellationConfig(samples_per_site=0))
    errors = [(result.sites - everything.sites).abs().max() for result in (some, few)]
    assert errors[0] < errors[1]


def test_a_sample_that_saves_little_is_not_taken():
    points, weights = weighted_cloud(1000)
    few, all_points = (
        tessellate(points, weights, 100, config=TessellationConfig(samples_per_site=samples))
        for samples in (6, 0)
    )
    assert torch.equal(few.labels, all_points.labels)


@each_config
def test_points_in_any_order_give_a_complete_partition(config):
    points, weights = weighted_cloud(800)
    shuffle = torch.randperm(800, generator=torch.Generator().manual_seed(5))
    result = tessellate(points[shuffle], weights[shuffle], 60, config=config)
    assert_complete(result, 800, 60)


@each_config
def test_results_are_deterministic(config):
    points, weights = weighted_cloud(700)
    first, second = (tessellate(points, weights, 50, config=config, seed=3) for _ in range(2))
    assert torch.equal(first.labels, second.labels)
    assert torch.equal(first.sites, second.sites)
    assert first.energies == second.energies


def test_only_weighted_seeding_uses_the_seed():
    points, weights = weighted_cloud(700)
    for name, equal in (("standard", True), ("paper", False)):
        first, second = (
            tessellate(points, weights, 50, config=CONFIGS[name], seed=seed) for seed in (0, 1)
        )
        assert torch.equal(first.labels, second.labels) is equal


def test_input_is_not_changed():
    points, weights = weighted_cloud(300)
    before = points.clone(), weights.clone()
    tessellate(points, weights, 200, config=CONFIGS["standard"])
    assert torch.equal(points, before[0])
    assert torch.equal(weights, before[1])


def test_iterations_are_reported():
    told: list[int] = []
    points, weights = weighted_cloud(300)
    config = TessellationConfig(iterations=4, tolerance=0.0)
    tessellate(points, weights, 20, config=config, on_iteration=told.append)
    assert told == [1, 2, 3, 4]


def test_labels_that_fill_empty_cells_may_be_int32():
    labels = torch.zeros(3, dtype=torch.int32)
    found, squared, refilled = fill_empty_cells(labels, torch.ones(3), torch.arange(3.0), 3)
    assert (found.tolist(), found.dtype) == ([0, 2, 1], torch.int32)
    assert (squared.tolist(), refilled) == ([0.0, 0.0, 0.0], 2)


P, W, CONFIG = torch.randn(20, 3), torch.ones(20), TessellationConfig()
LABELS = torch.zeros(20, dtype=torch.int64)
BAD_ROW = torch.arange(20)[:, None] == 3


def many_iterations(**changes):
    given = {"nearest": nearest_site, "iterations": 2, "tolerance": 0.0}
    return lloyd(P, changes.pop("weights", W), P[:5], **(given | changes))


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: tessellate(P, W, 0, config=CONFIG), "count must be a whole number between 1 and "
         "the 20 points, found 0."),
        (lambda: tessellate(P, W, 1.5, config=CONFIG), "20 points, found 1.5."),
        (lambda: tessellate(P.numpy(), W, 5, config=CONFIG), "points must be a tensor of floats of "
         "shape (n, d), found ndarray."),
        (lambda: tessellate(P[:, 0], W, 5, config=CONFIG), "found torch.float32 of shape (20,)."),
        (lambda: tessellate(P, W[:7], 5, config=CONFIG), "weights must be a tensor of floats of "
         "shape (20,), found torch.float32 of shape (7,)."),
        (lambda: tessellate(P, W, 5, config="draft"), "config must be of type TessellationConfig, "
         "found str."),
        (lambda: tessellate(P, W, 5, config=CONFIG, seed="a"), "seed must be a whole number at "
         "least 0, found 'a'."),
        (lambda: tessellate(P, -W, 5, config=CONFIG), "weights must be finite and at least 0, "
         "found -1.0 in row 0."),
        (lambda: tessellate(P, W * torch.nan, 5, config=CONFIG), "found nan in row 0."),
        (lambda: tessellate(P, W / BAD_ROW.logical_not()[:, 0], 5, config=CONFIG), "found inf in "
         "row 3."),
        (lambda: tessellate(P.where(~BAD_ROW, torch.nan), W, 5, config=CONFIG), "points and sites "
         "must be finite, found NaN or infinite coordinates."),
        (lambda: tessellate(P[:, :0], W, 5, config=CONFIG), "sites must hold at least one position,"
         " found shape (5, 0)."),
        (lambda: choose_seeds(W, 21, config=CONFIG, seed=0), "20 points, found 21."),
        (lambda: choose_seeds(W, 5, config=CONFIG, seed=-1), "seed must be"),
        (lambda: stratified_seeds(W, -1), "20 points, found -1."),
        (lambda: stratified_seeds(W, 0), "20 points, found 0."),
        (lambda: weighted_seeds(W, 21, torch.Generator()), "20 points, found 21."),
        (lambda: weighted_seeds(-W, 5, torch.Generator()), "weights must be finite"),
        (lambda: many_iterations(iterations=-1), "iterations must be a whole number at least 0"),
        (lambda: many_iterations(weights=-W), "points and weights must be finite, and weights at "
         "least 0, found an energy of -"),
        (lambda: fill_empty_cells(LABELS, W, W, 21), "20 points, found 21."),
        (lambda: fill_empty_cells(LABELS - 1, W, W, 5), "labels must be between 0 and 4"),
        (lambda: fill_empty_cells(LABELS, torch.nan * W, W, 20), "weights times squared distances "
         "must be between 0 and inf, found nan to nan."),
    ],
)  # fmt: skip
def test_wrong_arguments(call, text):
    with pytest.raises(InvalidArgumentError) as caught:
        call()
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_gradients_are_not_needed():
    plain = tessellate(P, W, 5, config=CONFIG)
    traced = tessellate(P.clone().requires_grad_(), W.clone().requires_grad_(), 5, config=CONFIG)
    assert torch.equal(traced.labels, plain.labels)
    assert torch.equal(traced.sites, plain.sites)
