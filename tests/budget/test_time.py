"""The cost model and the choices made with it; all seconds are made up."""

import math
from functools import partial

import pytest

import cvtgs
from cvtgs.budget import CostModel, Work, choose_preset
from cvtgs.budget.calibrate import (
    CANDIDATES,
    LEAST_MEASURED,
    TRIALS,
    Trial,
    calibrate,
    measured_seconds,
)
from cvtgs.budget.costs import FEATURES
from cvtgs.errors import ConfigError, GoalError, InvalidArgumentError

NO_PRIOR = CostModel(rates={})
SMALL_TRIALS = [
    Trial(preset="draft", kind="object", count=50, sh_degree=0, rho=0.1),
    Trial(preset="standard", kind="object", count=50, sh_degree=0, rho=0.5),
    Trial(preset="standard", kind="object", count=200, sh_degree=3, rho=0.05),
    Trial(preset="draft", kind="object", count=200, sh_degree=3, rho=0.01),
    Trial(
        preset="matched", kind="object", count=50, sh_degree=0, rho=0.5, views=3, size=64, steps=4
    ),
    Trial(
        preset="matched", kind="object", count=400, sh_degree=1, rho=0.2, views=5, size=96, steps=5
    ),
    Trial(preset="high", kind="object", count=400, sh_degree=1, rho=0.1, views=3, size=64, steps=9),
]


def made_up(config, scene, count) -> dict[str, float]:
    """Return seconds that follow the features exactly."""
    work = Work.of(scene, count)
    seconds = {
        "check": 1e-6 * len(scene),
        "plan": 1e-6 * len(scene),
        "filter": 1e-7 * len(scene),
        "weigh": 1e-7 * len(scene),
        "tessellate": 0.01 + 2e-7 * work.features("tessellate", config)["search"],
        "allocate": 1e-6 * work.features("allocate", config)["pairs"],
        "merge": 1e-6 * (2 * len(scene) + 3 * count),
        "something new": 0.1 + 1e-6 * count,
    }
    if config.merge.network:
        seconds["network"] = 1e-5 * count
    if config.visibility.views:
        seconds["visibility"] = 1e-6 * config.visibility.views * len(scene)
    if config.match.enabled:
        seconds["match"] = 1e-3 + 1e-9 * work.features("match", config)["view_pixels"]
    if config.refine.enabled:
        seconds["refine"] = 1e-6 * work.features("refine", config)["look_pixels"]
    return seconds


def preset(name: str) -> cvtgs.SimplifyConfig:
    return cvtgs.SimplifyConfig.from_preset(name)


@pytest.fixture(scope="module")
def model() -> CostModel:
    return calibrate(made_up, trials=SMALL_TRIALS, prior=NO_PRIOR)


@pytest.mark.parametrize("name", ["draft", "fast", "standard"])
def test_seconds_that_follow_the_features_are_predicted_exactly(model, name):
    work, config = Work(count=1_000_000, target=10_000, colors=12), preset(name)
    search = work.features("tessellate", config)["search"]
    pairs = work.features("allocate", config)["pairs"]
    wanted = 0.11 + 1e-6 * (4_200_000 + 40_000 + pairs) + 2e-7 * search
    wanted += 0.1 * (name == "standard")
    assert model.seconds(work, config) == pytest.approx(wanted, rel=1e-3)
    parts = {"check", "plan", "filter", "weigh", "tessellate", "allocate", "merge", "something new"}
    wanted_stages = parts | {"network"} if name == "standard" else parts
    assert set(model.stage_seconds(work, config)) == wanted_stages


def test_trials_that_the_prior_does_not_fit_tell_the_speed_of_the_machine_only(model):
    """Views of these trials take half as long again as the prior predicts, on any machine."""

    def times(speed: float, config, scene, count) -> dict[str, float]:
        seconds = {name: speed * one for name, one in made_up(config, scene, count).items()}
        return {name: one * (1 + (name == "visibility") / 2) for name, one in seconds.items()}

    odd = calibrate(partial(times, 1.0), trials=SMALL_TRIALS, prior=NO_PRIOR)
    prior = model.model_copy(update={"trials": odd.trials})
    found = calibrate(partial(times, 2.0), trials=SMALL_TRIALS, prior=prior)
    work, high = Work(count=100_000, target=1000), preset("high")
    seen, wanted = (one.stage_seconds(work, high)["visibility"] for one in (found, model))
    assert seen == pytest.approx(2 * wanted, rel=0.1)


def test_the_cost_of_many_images_is_extrapolated_from_few(model):
    high, work = preset("high"), Work(count=100_000, target=1000)
    stages = model.stage_seconds(work, high)
    assert stages["visibility"] == pytest.approx(0.1 * high.visibility.views, rel=0.01)
    pixels = work.features("refine", high)["look_pixels"]
    assert stages["refine"] == pytest.approx(1e-6 * pixels, rel=0.01)
    assert model.seconds(work, high) > model.seconds(work, preset("matched"))


def test_the_cost_of_matching_is_extrapolated_from_few_images(model):
    matched, work = preset("matched"), Work(count=100_000, target=1000)
    pixels = work.features("match", matched)["view_pixels"]
    stages = model.stage_seconds(work, matched)
    assert stages["match"] == pytest.approx(1e-3 + 1e-9 * pixels, rel=0.02)
    unmatched = cvtgs.SimplifyConfig.compose(
        preset="matched", settings={"match.opacity_rounds": "0", "match.color_iterations": "0"}
    )
    assert "match" not in model.stage_seconds(work, unmatched)


def test_settings_change_the_predicted_cost(model):
    work = Work(count=100_000, target=1000)

    def stages(name: str, **settings: str) -> dict[str, float]:
        texts = {name.replace("_", ".", 1): text for name, text in settings.items()}
        return model.stage_seconds(work, cvtgs.SimplifyConfig.compose(preset=name, settings=texts))

    high = stages("high")
    assert "refine" not in stages("high", refine_steps="0")
    for setting in ({"visibility_views": "0"}, {"effects_visibility": "off"}):
        assert set(high) - set(stages("high", **setting)) == {"visibility", "match"}
    few = stages("high", refine_steps=str(high_steps() // 2))
    assert 0.4 < few["refine"] / high["refine"] < 0.6
    assert 0.2 < stages("high", refine_size="200")["refine"] / high["refine"] < 0.3
    refine = preset("high").refine.model_dump(exclude={"rates"})
    added = stages("standard", **{f"refine_{name}": str(text) for name, text in refine.items()})
    assert set(added) - set(stages("standard")) == {"refine"}
    assert 1.0 < added["refine"] / high["refine"] < 1.1  # it renders all its own images
    assert stages("draft", refine_seconds="7")["refine"] == 7.0


def test_a_cheaper_setting_allows_a_better_preset(model):
    work = Work(count=1_000_000, target=10_000)
    budget = 1.3 * model.seconds(work, preset("high")) - 1
    assert choose_preset(work, budget, model=model).preset == "matched"
    fewer = {"refine.steps": str(high_steps() // 2)}
    choice = choose_preset(work, budget, settings=fewer, model=model)
    assert choice.preset == CANDIDATES[-1]
    assert choice.seconds < budget / 1.3
    with pytest.raises(ConfigError, match="refine"):
        choose_preset(work, budget, settings={"refine.steps": "-1"}, model=model)


def test_settings_that_need_images_do_not_fit_without_them(model):
    work, settings = Work(count=1000, target=10), {"visibility.views": "8"}
    with pytest.raises(InvalidArgumentError, match="with_images must be true where the settings"):
        choose_preset(work, 100.0, settings=settings, model=model, with_images=False)


def high_steps() -> int:
    return preset("high").refine.steps


def test_calibration_takes_few_images_and_steps():
    seen = []

    def run(config, scene, count):
        seen.append((config, len(scene)))
        return made_up(config, scene, count)

    model = calibrate(run)
    assert set(FEATURES) <= set(model.rates)
    assert max(config.refine.steps for config, _ in seen) < 10
    assert max(config.visibility.views for config, _ in seen) < 10
    assert max(size for _, size in seen) <= 100_000
    assert sum(config.shares_images for config, _ in seen) == sum(
        config.uses_renders for config, _ in seen
    )


FEW = [
    Trial(preset="draft", kind="object", count=count, sh_degree=0, rho=rho)
    for count in (50, 200)
    for rho in (0.1, 0.5)
]


def test_the_fastest_of_several_runs_counts():
    calls = []

    def run(config, scene, count):
        calls.append(config)
        return {"check": len(scene) * (1.0 if len(calls) % 3 == 0 else 3.0)}

    model = calibrate(run, trials=FEW, prior=NO_PRIOR, clock=lambda: 0.0)
    check = model.stage_seconds(Work(count=10, target=1), preset("draft"))["check"]
    assert check == pytest.approx(10.0)
    assert len(calls) == 1 + 3 * 4


def test_a_slow_machine_measures_once():
    calls, clock = [], iter(range(0, 10_000, 60))

    def run(config, scene, count):
        calls.append(config)
        return {"check": 60.0}

    calibrate(run, trials=FEW, prior=NO_PRIOR, clock=lambda: float(next(clock)))
    assert len(calls) == 1 + 4


def test_nothing_is_repeated_after_15_processor_seconds():
    """A start, four measurements and one repetition take 3 s each."""
    calls, events = [], []

    def run(config, scene, count):
        calls.append(config)
        return {"check": 3.0}

    calibrate(
        run,
        trials=FEW,
        prior=NO_PRIOR,
        clock=lambda: 0.0,
        cpu=lambda: 3.0 * len(calls),
        listener=events.append,
    )
    assert len(calls) == 6
    assert events[0].note == "load preset draft, 50 to 5 Gaussians"
    assert events[1].note == "preset draft, 50 to 5 Gaussians"


def test_the_last_trials_are_skipped_when_time_is_up():
    """A small and a large scene are measured, however long that takes."""
    calls = []

    def run(config, scene, count):
        calls.append((len(scene), count))
        return {"check": 9.0}

    model = calibrate(
        run, trials=FEW, prior=NO_PRIOR, clock=lambda: 0.0, cpu=lambda: 9.0 * len(calls)
    )
    assert calls == [(50, 5), (50, 5), (50, 25), (200, 20)]
    assert len(calls) == 1 + LEAST_MEASURED
    assert set(model.rates) == {"check"}


def test_what_is_measured_in_any_case_has_every_stage():
    stages = set()
    for trial in TRIALS[:LEAST_MEASURED]:
        stages |= made_up(trial.config, cvtgs.synthetic.scene("object", 20, sh_degree=0), 2).keys()
    assert stages >= {"tessellate", "network", "visibility", "match", "refine"}


def test_real_seconds_come_from_the_report():
    run = measured_seconds("cpu")
    scene = cvtgs.synthetic.scene("object", 200, sh_degree=0, seed=0)
    seconds = run(preset("draft"), scene, 20)
    assert {"check", "plan", "filter", "tessellate", "allocate", "merge"} <= set(seconds)
    assert all(value >= 0 for value in seconds.values())


def test_refinement_for_a_given_time_costs_that_time(model, monkeypatch):
    changed = {**cvtgs.PRESETS, "high": {"refine": {"seconds": 7.0}}}
    monkeypatch.setattr("cvtgs.config.simplify.PRESETS", changed)
    assert model.stage_seconds(Work(count=1000, target=10), preset("high"))["refine"] == 7.0


def test_the_best_preset_that_fits_is_chosen(model):
    work = Work(count=1_000_000, target=10_000)
    costs = [model.seconds(work, preset(name)) for name in CANDIDATES]
    assert costs == sorted(costs)
    for name, cost in zip(CANDIDATES, costs, strict=True):
        assert choose_preset(work, 1.31 * cost, model=model) == (name, cost)
    assert choose_preset(work, 1e9, model=model).preset == CANDIDATES[-1]


@pytest.mark.long
@pytest.mark.parametrize("count", [4, 50, 1000])
def test_few_given_cameras_cost_fewer_images(model, count):
    """Of 50 cameras, ``matched`` renders 32; ``high`` would render 72."""
    work, views = Work(count=1_000_000, target=10_000), cvtgs.views.automatic_views
    cameras = views(cvtgs.synthetic.scene("object", 300, seed=0), count, width=32, height=24)
    costs = {}
    for name in CANDIDATES:
        images = str(min(count, preset(name).visibility.views))
        config = cvtgs.SimplifyConfig.compose(
            preset=name, settings={"visibility.views": images} if images != "0" else None
        )
        costs[name] = model.seconds(work, config, with_cameras=True)
        found = choose_preset(work, 1.31 * costs[name], model=model, cameras=cameras)
        assert found == (name, pytest.approx(costs[name]))
    for name, most in (("matched", 32), ("high", 72)):
        many = model.seconds(work, preset(name), with_cameras=True)
        assert (costs[name] < many) is (count < most)


def test_a_scene_is_accepted_in_place_of_work(model):
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=2, seed=0)
    assert Work.of(scene, 3) == Work(count=300, target=3, colors=27)
    by_ratio = choose_preset(scene, 1e9, rho=0.01, model=model)
    assert by_ratio == choose_preset(scene, 1e9, count=3, model=model)
    assert by_ratio == choose_preset(Work.of(scene, 3), 1e9, model=model)


def test_a_time_too_short_for_every_preset_is_an_error(model):
    work = Work(count=1_000_000, target=10_000)
    with pytest.raises(GoalError) as caught:
        choose_preset(work, 0.5, model=model)
    assert str(caught.value) == (
        "no preset fits into 0.5 s: the fastest, draft, takes about 7.7 s to make 10,000 of "
        "1,000,000 Gaussians, and 1.3 times that is reserved."
    )


def test_long_times_are_whole_seconds(model):
    work = Work(count=1_000_000_000, target=10_000)
    with pytest.raises(GoalError, match=r"into 200 s: the fastest, draft, takes about [\d,]+ s to"):
        choose_preset(work, 200.0, model=model)


def test_invalid_arguments_of_the_choice_are_refused(model):
    work = Work(count=100, target=10)
    for seconds in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(InvalidArgumentError, match="the time must be above 0 and finite"):
            choose_preset(work, seconds, model=model)
    with pytest.raises(InvalidArgumentError, match="a Work has its target"):
        choose_preset(work, 1.0, rho=0.1, model=model)
