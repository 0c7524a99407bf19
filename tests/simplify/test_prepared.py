"""A scene is prepared once for any number of sizes: the bits of single runs, no repeated work."""

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig, pipeline
from cvtgs.analysis import analyze
from cvtgs.clock import StageClock
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError
from cvtgs.grouping import order_rows
from cvtgs.progress import silent
from scenes import random_scene, same_bits

SHARED = {"check", "plan", "visibility"}


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("room", 1500, sh_degree=1, seed=3)


def stages(report):
    return {cost.stage for cost in report.stages}


@pytest.mark.slow
@pytest.mark.parametrize(
    "preset", ["standard", "draft", "paper", pytest.param("high", marks=pytest.mark.long)]
)
def test_every_run_gives_the_bits_of_a_separate_run(scene, preset):
    quick = {"visibility.views": 4, "visibility.size": 32, "refine.steps": 2, "refine.size": 32}
    settings = {key: str(value) for key, value in quick.items()} if preset == "high" else {}
    config = SimplifyConfig.compose(preset=preset, settings=settings)
    simplifier = Simplifier(config=config, device="cpu")
    prepared = simplifier.prepare(scene)
    for count in (30, 150, 30):
        assert same_bits(prepared.run(count=count).scene, simplifier.simplify(scene, count=count))


@pytest.mark.slow
def test_shared_stages_run_only_the_first_time(scene):
    simplifier = Simplifier(config=SimplifyConfig(visibility={"views": 2, "size": 16}))
    prepared = simplifier.prepare(scene)
    first, second, third = (stages(prepared.run(0.1).report) for _ in range(3))
    assert first >= SHARED
    assert second == first - SHARED | {"order"}
    assert third == first - SHARED


def test_rows_are_ordered_again_only_if_the_filter_keeps_other_ones(scene, monkeypatch):
    config = SimplifyConfig(filter={"min_opacity": 0.99, "max_mass_share": 1.0})
    simplifier = Simplifier(config=config, ckpt=None, device="cpu")
    prepared, calls = simplifier.prepare(scene), []
    order = cvtgs.grouping.curve_order
    monkeypatch.setattr(
        "cvtgs.grouping.curve_order",
        lambda *args, **more: calls.append(len(args[1])) or order(*args, **more),
    )
    kept = int((scene.opacities >= 0.99).sum())
    for count in (30, 20, 10, kept + 5):
        small = prepared.run(count=count).scene
        seen = len(calls)
        assert same_bits(small, simplifier.simplify(scene, count=count))
        del calls[seen:]
    assert calls == [kept, kept, kept + 5]


def test_neighbours_of_single_gaussians_are_found_once(scene, monkeypatch):
    simplifier = Simplifier(preset="draft", device="cpu")
    wanted = [simplifier.simplify(scene, rho) for rho in (0.5, 0.4, 0.3, 0.05)]
    searched, search = [], cvtgs.cvt.nearest_neighbors
    monkeypatch.setattr(
        cvtgs.cvt,
        "nearest_neighbors",
        lambda sites, count: searched.append(len(sites)) or search(sites, count),
    )
    prepared, whole = simplifier.prepare(scene), []
    for rho, small in zip((0.5, 0.4, 0.3, 0.05), wanted, strict=True):
        searched.clear()
        assert same_bits(prepared.run(rho).scene, small)
        whole.append(searched.count(len(scene)))
    assert whole == [1, 1, 0, 0]


def test_warming_up_does_the_work_that_runs_share(scene, monkeypatch):
    simplifier = Simplifier(preset="draft", device="cpu")
    prepared, wanted = simplifier.prepare(scene), simplifier.simplify(scene, 0.5)
    prepared.warm_up(0.5)
    searched, search = [], cvtgs.cvt.nearest_neighbors
    monkeypatch.setattr(
        cvtgs.cvt,
        "nearest_neighbors",
        lambda sites, count: searched.append(len(sites)) or search(sites, count),
    )
    small, report = prepared.run(0.5)
    assert same_bits(small, wanted)
    assert {stage.stage for stage in report.stages} == {
        "filter",
        "weigh",
        "tessellate",
        "allocate",
        "merge",
    }
    assert len(scene) not in searched


def test_protected_gaussians_may_differ_from_run_to_run(scene):
    simplifier = Simplifier(device="cpu")
    prepared = simplifier.prepare(scene)
    for row in (3, 1400):
        keep = torch.arange(len(scene)) == row
        small = prepared.run(count=20, keep=keep).scene
        assert same_bits(small, simplifier.simplify(scene, count=20, keep=keep))
        assert torch.equal(small.means[0], scene.means[row])


def test_invalid_rows_are_warned_about_once_and_counted_in_every_run():
    scene = random_scene(50)
    means = scene.means.clone()
    means[7] = torch.inf
    bad = scene.with_tensors({"means": means}, {})
    prepared = Simplifier(device="cpu").prepare(bad)
    with pytest.warns(DroppedDataWarning) as heard:
        reports = [prepared.run(count=count).report for count in (50, 10, 49)]
    assert len(heard) == 1
    assert [report.output_count for report in reports] == [49, 10, 49]
    assert [report.invalid_count for report in reports] == [1, 1, 1]
    assert [report.shortfall for report in reports] == [
        "only 49 of 50 Gaussians are valid",
        "",
        "",
    ]


def test_a_size_out_of_range_is_refused(scene):
    with pytest.raises(InvalidArgumentError):
        Simplifier(device="cpu").prepare(scene).run(count=0)


def test_levels_take_any_iterable_of_ratios(scene):
    simplifier = Simplifier("standard", device="cpu")
    found = simplifier.levels(scene, (rho for rho in (0.2, 0.1)))
    wanted = simplifier.levels(scene, [0.2, 0.1])
    assert [len(level.scene) for level in found] == [len(level.scene) for level in wanted]
    for wrong in (None, 0.1, [], torch.tensor(0.5)):
        with pytest.raises(InvalidArgumentError, match="levels need a list of ratios"):
            simplifier.levels(scene, wrong)


def test_tensors_of_other_strides_give_the_same_bits(scene):
    tensors = {
        name: torch.stack([values, values], dim=-1)[..., 0]
        for name, values in scene.tensors().items()
    }
    assert not tensors["sh0"].is_contiguous()
    simplifier = Simplifier("standard", device="cpu")
    wanted = simplifier.simplify(scene, 0.1)
    assert same_bits(simplifier.simplify(scene.with_tensors(tensors), 0.1), wanted)


def test_a_further_attempt_computes_everything_again(monkeypatch):
    """What is cached is on a device that lacked memory."""
    notes = iter(["", "", "computed on the CPU", ""])
    monkeypatch.setattr(
        cvtgs.prepared, "within_memory", lambda compute, place, **_: compute(place, next(notes))
    )
    prepared = Simplifier(preset="draft", ckpt=None, device="cpu").prepare(random_scene(100))
    reports = [prepared.run(0.1).report for _ in range(4)]
    assert ["check" in stages(report) for report in reports] == [True, False, True, False]
    assert [report.device_note for report in reports] == ["", "", "computed on the CPU", ""]


def test_cached_moments_are_not_used_with_other_masses(monkeypatch):
    found, allocate = [], pipeline.allocate
    monkeypatch.setattr(
        pipeline, "allocate", lambda points, *rest: found.append(points) or allocate(points, *rest)
    )
    scene, config = random_scene(60), SimplifyConfig.from_preset("draft")
    analysis, clock = analyze(scene, config), StageClock(silent, torch.device("cpu"))
    ordered = order_rows(scene, analysis, config)
    for importance in (None, torch.full((60,), 3.0).double()):
        pipeline.reduce_scene(
            scene, analysis, 10, config,
            net=None, clock=clock, ordered=ordered, importance=importance,
        )  # fmt: skip
    assert found[0].moments is ordered.points.moments
    assert found[1].moments is None
    torch.testing.assert_close(found[1].apparent_masses, 3.0 * found[0].apparent_masses)
