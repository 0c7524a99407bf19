"""The cost model: rates fitted to seconds, and what they predict; all seconds are made up."""

import math
from pathlib import Path

import pytest

from cvtgs import SimplifyConfig
from cvtgs.budget import CostModel, Work, choose_preset, cost_model, shipped_model
from cvtgs.budget.calibrate import CPU_STEP, TRIALS, Trial, calibrate, undisturbed_seconds
from cvtgs.budget.costs import Measurement, fit_rates
from cvtgs.clock import StageCost
from cvtgs.errors import InvalidArgumentError


def preset(name: str) -> SimplifyConfig:
    return SimplifyConfig.from_preset(name)


def test_rates_are_fitted_and_never_negative():
    rows = [{"once": 1.0, "n": n} for n in (1.0, 2.0, 4.0)]
    assert fit_rates(rows, [5.0, 7.0, 11.0]) == pytest.approx({"once": 3.0, "n": 2.0})
    falling = fit_rates(rows, [11.0, 7.0, 5.0])
    assert min(falling.values()) >= 0.0
    assert falling["n"] == 0.0


def test_errors_are_weighted_relative_to_the_seconds():
    """One second in a hundred counts as little as a tenth of a second in ten."""
    rates = fit_rates([{"n": 1.0}, {"n": 10.0}], [1.0, 11.0])
    assert 1.0 < rates["n"] < 1.1


def test_a_prior_decides_what_measurements_leave_open():
    """One measurement, twice the prior, cannot tell two features apart; both rates double."""
    one = [{"once": 1.0, "n": 3.0}]
    assert fit_rates(one, [8.0], prior={"once": 1.0, "n": 1.0}) == pytest.approx(
        {"once": 2.0, "n": 2.0}
    )
    several = [{"once": 1.0, "n": float(n)} for n in (1, 10, 100, 1000) for _ in range(500)]
    seconds = [6.0 + 0.5 * row["n"] for row in several]
    assert fit_rates(several, seconds, prior={"once": 1.0, "n": 1.0}) == pytest.approx(
        {"once": 6.0, "n": 0.5}, rel=0.05
    )
    open_rates = fit_rates(several, seconds, prior={"once": 0.0, "n": 1.0})
    assert open_rates["once"] == 0.0


def test_stages_that_were_not_measured_keep_the_prior():
    prior = CostModel(rates={"merge": {"out": 3.0}, "check": {"in": 1.0, "in_values": 0.0}})
    work = Work(count=10, target=5)
    known = Measurement(work=work, config=preset("draft"), seconds={"check": 20.0})
    found = CostModel.fit([known], prior=prior)
    assert found.rates["merge"] == {"out": 3.0}
    assert found.rates["check"]["in"] == pytest.approx(2.0)


def test_loading_counts_once_and_images_need_more_libraries():
    model = CostModel(rates={"check": {"in": 1.0}}, start=0.25, image_start=1.0)
    work = Work(count=3, target=1)
    assert model.seconds(work, preset("standard")) == 3.25
    assert model.seconds(work, preset("matched")) == 4.25


@pytest.mark.parametrize(("name", "more"), [("matched", 1012.0), ("standard", 0.0)])
def test_given_cameras_make_cells_be_allocated_twice_by_errors_of_images(name, more):
    """One more allocation, network and pass over 10 Gaussians in; 100 for each of 10 images."""
    rates = {"check": {"in": 5.0}, "allocate": {"once": 1.0}, "merge": {"in": 1.0}}
    rates |= {"network": {"once": 1.0}, "refine": {"once": 7.0, "looks_out": 50.0}}
    model, work = CostModel(rates=rates), Work(count=10, target=2)
    config = preset(name).model_copy(update={"match": preset("matched").match})
    if name == "matched":
        visibility = config.visibility.model_copy(update={"views": 10})
        config = config.model_copy(update={"visibility": visibility})
    plain, given = (
        model.seconds(work, config, with_cameras=with_cameras) for with_cameras in (False, True)
    )
    assert given - plain == more
    whole = Work(count=10, target=10)
    assert model.seconds(whole, config, with_cameras=True) == model.seconds(whole, config)


def test_pixel_gaussian_pairs_grow_with_the_square_root_of_both():
    matched = preset("matched")
    few, many = (
        Work(count=10**6, target=count).features("match", matched)["view_pairs"]
        for count in (1000, 100_000)
    )
    assert few == pytest.approx(32 * 200 * math.sqrt(1000))
    assert many == pytest.approx(10 * few)


@pytest.mark.parametrize("name", ["matched", "high"])
def test_a_refinement_with_images_of_its_own_renders_held_out_ones_too(name):
    """Images that were made to match colours serve it as well, held-out ones included."""
    shared = preset(name)
    changes = {"visibility.size": str(2 * shared.visibility.size)}
    alone = SimplifyConfig.compose(preset=name, settings=changes)
    assert (shared.shares_images, alone.shares_images) == (True, False)
    counts = [
        Work(count=1000, target=9).features("refine", one)["images_in"] / 1000
        for one in (shared, alone)
    ]
    refine = shared.refine
    views = shared.visibility.views
    assert counts[0] == refine.new_images(refine.steps, shared=views)
    assert counts[1] == refine.new_images(refine.steps) + refine.heldout


def test_steps_on_few_gaussians_are_more_but_see_as_many_pixels():
    matched = preset("matched")
    once = SimplifyConfig.compose(preset="matched", settings={"refine.lengthening": "1"})
    for target, times in ((400, 4), (100_000, 1)):
        work = Work(count=10**6, target=target)
        usual, more = (work.features("refine", one) for one in (once, matched))
        assert more["look_pixels"] == usual["look_pixels"]
        steps = matched.refine.steps * matched.refine.images_per_step
        assert more["looks"] - usual["looks"] == (times - 1) * steps
        assert more["looks_out"] == target * more["looks"]


def test_the_shipped_rates_were_measured_on_the_trials_of_calibrations():
    """After a change of the trials: ``python -m benchmarks.cost_model --ship``."""
    found = shipped_model().trials
    assert list(found) == [trial.name for trial in TRIALS]
    for trial in TRIALS:
        assert {"check", "merge", "network"} <= set(found[trial.name])
        assert ("refine" in found[trial.name]) == trial.config.uses_images


def test_rates_of_a_preset_that_does_more_are_no_longer_those_of_its_trials(monkeypatch):
    """Twice as many images in a step are no slower machine."""
    before = [trial.name for trial in TRIALS]
    more = SimplifyConfig.compose(preset="matched", settings={"refine.images_per_step": "4"})
    changed = {"standard": preset("standard"), "matched": more}
    monkeypatch.setattr(SimplifyConfig, "from_preset", changed.__getitem__)
    same = [trial.name == name for trial, name in zip(TRIALS, before, strict=True)]
    assert same == [trial.preset == "standard" for trial in TRIALS]


def test_a_scene_that_stays_whole_is_only_checked_and_analysed():
    whole = Work(count=2_000_000, target=2_000_000, colors=48)
    assert set(shipped_model().stage_seconds(whole, preset("high"))) == {"check", "plan"}
    assert choose_preset(whole, 20.0, model=shipped_model()).preset == "high"


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"rates": None}, "rates: input should be a valid dictionary, found None."),
        (
            {"rates": {"check": {"in": -1}}},
            "rates.check.in: input should be greater than or equal to 0, found -1.",
        ),
        ({"rates": {"check": {"in": math.nan}}}, "should be a finite number, found nan."),
        ({"rates": {"draft": {"check": 1.0}}}, "rates.draft must be of once, in, out; found 'ch"),
        ({"rates": {"plan": {"out": 1.0}}}, "rates.plan must be of once, in; found 'out'."),
    ],
)
def test_cost_models_of_other_values_are_refused(values, text):
    with pytest.raises(InvalidArgumentError) as caught:
        CostModel(**values)
    assert str(caught.value).startswith("cost model: ")
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("sizes", "text"),
    [
        ({"count": -1}, "count must be a whole number above 0, found -1."),
        ({"count": 1.5}, "count must be a whole number above 0, found 1.5."),
        ({"count": "a"}, "count must be a whole number above 0, found 'a'."),
        (
            {"target": 11},
            "target must be a whole number between 1 and the 10 Gaussians of the input, found 11.",
        ),
        (
            {"target": 0},
            "target must be a whole number between 1 and the 10 Gaussians of the input, found 0.",
        ),
        ({"colors": 0}, "colors must be 3, 12, 27 or 48, found 0."),
    ],
)
def test_work_of_other_sizes_is_refused(sizes, text):
    with pytest.raises(InvalidArgumentError) as caught:
        Work(**{"count": 10, "target": 1} | sizes)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("work", "seconds", "model", "text"),
    [
        (Work(count=9, target=1), "20s", None, "the time must be above 0 and finite, found '20s'"),
        ("scene.ply", 9.0, None, "work must be of type GaussianScene or of type Work, found str."),
        (None, 9.0, None, "work must be of type GaussianScene or of type Work, found NoneType."),
        (Work(count=9, target=1), 9.0, {}, "model must be of type CostModel or None, found dict."),
        (Work(count=9, target=1), 9.0, CostModel(rates={}), "with rates, found CostModel(rates={}"),
    ],
)
def test_arguments_of_another_type_are_refused(work, seconds, model, text):
    with pytest.raises(InvalidArgumentError) as caught:
        choose_preset(work, seconds, model=model)
    assert text in str(caught.value)


def test_the_cache_folder_may_be_a_text(tmp_path):
    made = cost_model(folder=str(tmp_path), calibration=shipped_model)
    assert cost_model(folder=tmp_path, calibration=pytest.fail) == made


def test_no_setting_may_name_the_preset_that_a_budget_chooses():
    work = Work(count=10_000, target=100)
    with pytest.raises(InvalidArgumentError, match=r"chooses the preset.*found preset = draft"):
        choose_preset(work, 9.0, settings={"preset": "draft"}, model=shipped_model())


def test_a_prior_rate_weighs_as_much_as_three_tenths_of_a_measurement():
    """The least squares of one feature by hand, in units of the prior rate, 2 seconds."""
    found = fit_rates([{"n": 1.0}, {"n": 1.0}], [2.0, 8.0], prior={"n": 2.0})["n"] / 2.0
    shares, factor = (1.0, 0.25), 2.0  # predicted by measured seconds; their mean ratio
    weight = 0.3 / factor**2
    by_hand = (sum(shares) + weight * factor) / (sum(one**2 for one in shares) + weight)
    assert found == pytest.approx(by_hand)


@pytest.mark.parametrize(("steps", "wanted"), [(100, 3.0), (0, 5.0)])
def test_a_limit_of_the_refinement_bounds_the_predicted_seconds(steps, wanted):
    config = SimplifyConfig.compose(preset="matched")
    refine = config.refine.model_copy(update={"steps": steps, "seconds": 5.0})
    work, config = Work(count=100, target=10), config.model_copy(update={"refine": refine})
    for once, seconds in ((3.0, wanted), (7.0, 5.0)):
        model = CostModel(rates={"refine": {"once": once}})
        assert model.stage_seconds(work, config)["refine"] == seconds


def test_a_first_run_that_is_faster_than_all_later_ones_costs_no_start():
    calls = []

    def run(config, scene, count):
        calls.append(count)
        return {"check": 1.0 if len(calls) == 1 else 2.0}

    trials = [Trial(preset="draft", kind="object", count=50, sh_degree=0, rho=0.1)]
    model = calibrate(run, trials=trials, prior=CostModel(rates={}), clock=lambda: 0.0)
    assert model.start == 0.0


@pytest.mark.parametrize(("device_bytes", "seconds"), [(0, 2.0), (1, 5.0)])
def test_only_a_stage_on_the_cpu_takes_no_longer_than_its_cpu_seconds(
    device_bytes: int, seconds: float
) -> None:
    """On a GPU, the process waits for its kernels."""
    cost = StageCost(
        stage="merge",
        seconds=5.0,
        cpu_seconds=2.0,
        peak_memory_bytes=0,
        peak_device_memory_bytes=device_bytes,
    )
    assert undisturbed_seconds(cost) == seconds


def test_the_coarse_cpu_clock_of_windows_is_not_read_for_short_stages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def found(seconds: float) -> float:
        memory = {"peak_memory_bytes": 0, "peak_device_memory_bytes": 0}
        cpu = seconds // CPU_STEP * CPU_STEP
        return undisturbed_seconds(StageCost(stage="x", seconds=seconds, cpu_seconds=cpu, **memory))

    assert found(0.01) == 0
    monkeypatch.setattr("sys.platform", "win32")
    assert found(0.01) == 0.01
    assert found(1.01) == 1.0


def test_another_number_of_threads_is_measured_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[int] = []
    for threads in (1, 2, 2):
        monkeypatch.setattr("torch.get_num_threads", lambda count=threads: count)

        def calibration(count: int = threads) -> CostModel:
            measured.append(count)
            return shipped_model()

        cost_model("cpu", calibration=calibration, folder=tmp_path)
    assert measured == [1, 2]
