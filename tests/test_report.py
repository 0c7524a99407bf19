"""The report and the clock that measures stages."""

import json
from collections.abc import Hashable
from types import SimpleNamespace

import pydantic
import pytest
import torch

import cvtgs
from cvtgs import (
    Cameras,
    ProgressEvent,
    Simplifier,
    SimplifyConfig,
    SimplifyReport,
    describe,
    render,
)
from cvtgs.analysis import analyze
from cvtgs.cells import Descriptors, Partition
from cvtgs.clock import StageClock, StageCost, peak_memory_bytes
from cvtgs.cvt import Tessellation
from cvtgs.evaluation import Comparison, LpipsWeights
from cvtgs.mergenet import Residuals, load_checkpoint
from cvtgs.progress import silent
from cvtgs.rendering import ObservedViews
from cvtgs.streams import StreamChunk, plan_stream
from cvtgs.text import short_repr
from cvtgs.views import CameraPositions
from scenes import random_scene

CPU = torch.device("cpu")


def report_of(**changes: object) -> SimplifyReport:
    values = {"input_count": 10, "output_count": 1, "target_count": 1, "rho": 0.1}
    return SimplifyReport(**{**values, "config": SimplifyConfig(), **changes})


def test_seconds_are_the_sum_over_the_stages():
    stages = tuple(
        StageCost(stage=name, seconds=seconds, cpu_seconds=0.0, peak_memory_bytes=0)
        for name, seconds in (("plan", 0.5), ("merge", 1.25))
    )
    assert report_of(stages=stages).seconds == 1.75
    assert report_of().seconds == 0


def test_the_clock_reports_start_steps_and_end():
    events: list[ProgressEvent] = []
    clock = StageClock(events.append, CPU)
    with clock.stage("merge", 3) as advance:
        advance(2)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("merge", 0, 3),
        ("merge", 2, 3),
        ("merge", 3, 3),
    ]
    assert [cost.stage for cost in clock.costs] == ["merge"]
    assert clock.costs[0].seconds >= 0
    assert clock.costs[0].peak_device_memory_bytes == 0


def test_every_stage_has_its_own_device_memory_peak(monkeypatch):
    """On a simulated device, the memory peaks of the two stages are 50 and 20."""
    memory = {"now": 0, "peak": 0}

    def reset(device: torch.device) -> None:
        if not torch.cuda.is_initialized():
            raise RuntimeError("did you call init?")
        memory["peak"] = memory["now"]

    def take(count: int) -> None:
        memory["now"] += count
        memory["peak"] = max(memory["peak"], memory["now"])

    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: memory["peak"])
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: memory["now"] > 0)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", reset)
    clock = StageClock(silent, torch.device("cuda"))
    for name, count in (("merge", 50), ("network", 10)):
        with clock.stage(name):
            take(count)
            take(10 - count)
    assert [cost.peak_device_memory_bytes for cost in clock.costs] == [50, 20]


def test_a_stage_that_fails_has_no_cost_and_no_end():
    events: list[ProgressEvent] = []
    clock = StageClock(events.append, CPU)
    with pytest.raises(ZeroDivisionError), clock.stage("plan"):
        1 / 0  # noqa: B018
    assert clock.costs == []
    assert [event.done for event in events] == [0]


def test_a_stage_that_runs_again_adds_its_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    walls, cpus = iter([10.0, 12.0, 20.0, 20.5]), iter([1.0, 1.25, 2.0, 3.0])
    times = SimpleNamespace(perf_counter=lambda: next(walls), process_time=lambda: next(cpus))
    monkeypatch.setattr("cvtgs.clock.time", times)
    clock = StageClock(silent, CPU)
    for _ in range(2):
        with clock.stage("sort"):
            pass
    assert [(cost.seconds, cost.cpu_seconds) for cost in clock.costs] == [(2.5, 1.25)]


def test_peak_memory_never_falls():
    first = peak_memory_bytes()
    ballast = torch.ones(1_000_000)
    assert peak_memory_bytes() >= first
    assert len(ballast) == 1_000_000


def test_json_holds_every_field():
    report = Simplifier(device="cpu").run(random_scene(200), 0.1).report
    values = json.loads(report.to_json())
    assert set(values) == set(SimplifyReport.model_fields)
    assert values["output_count"] == 20
    assert values["plan"]["unbounded"]["active"] in (True, False)
    assert [stage["stage"] for stage in values["stages"]][-2:] == ["merge", "network"]
    assert values["checkpoint"] == "standard"
    assert values["version"] == cvtgs.__version__
    assert values["torch_version"] == torch.__version__
    assert report.to_json().endswith("}\n")


def test_json_reads_back():
    report = Simplifier(device="cpu", config="paper").run(random_scene(200), 0.1).report
    assert SimplifyReport.model_validate_json(report.to_json()) == report


def test_reports_are_frozen_and_refuse_unknown_fields():
    report = report_of()
    with pytest.raises(pydantic.ValidationError):
        report.rho = 0.5
    with pytest.raises(pydantic.ValidationError):
        report_of(colour="red")


def test_the_silent_listener_prints_nothing(capsys):
    assert silent(ProgressEvent(stage="plan", done=0, total=1)) is None
    assert capsys.readouterr().out == ""


def test_a_printed_report_is_one_line():
    report = report_of()
    assert f"{report}" == str(report) == repr(report)
    assert repr(report).startswith("SimplifyReport(10 -> 1 Gaussian, ")


def test_records_with_dictionaries_are_not_hashable():
    assert not isinstance(report_of(), Hashable)
    assert not isinstance(describe(random_scene(3)), Hashable)


@pytest.mark.parametrize(
    "kind",
    [
        CameraPositions,
        Comparison,
        Descriptors,
        LpipsWeights,
        ObservedViews,
        Residuals,
        StreamChunk,
        Tessellation,
    ],
)
def test_values_of_many_numbers_have_a_short_repr(kind):
    assert kind.__repr__ is short_repr


def test_objects_with_tensors_have_a_short_repr():
    scene = random_scene(1200)
    prepared = Simplifier(preset="draft", device="cpu").prepare(scene)
    level, coarse = prepared.levels([0.01, 0.005])
    assert repr(prepared) == f"Prepared({scene!r}, preset draft, device cpu)"
    assert repr(level) == f"Level({level.scene!r}, {level.report!r}, error {level[2]:.3g})"
    plan = plan_stream([level, coarse])
    assert repr(plan) == "StreamPlan(levels of 12, 6 Gaussians, 1 chunk)"
    eye = torch.eye(4)[None]
    cameras = Cameras(viewmats=eye, Ks=eye[:, :3, :3], width=30, height=20)
    assert repr(cameras) == "Cameras(1 of 30 x 20 pixels, cpu)"
    found = render(scene, cameras, backend="torch")
    assert repr(found) == "Rendering(1 image of 30 x 20 pixels, torch, cpu)"
    analysis = analyze(scene, SimplifyConfig())
    assert repr(analysis).startswith(f"SceneAnalysis(frame={analysis.frame!r}, farthest=")
    assert "opacities=float32 (1200,)" in repr(analysis)
    assert repr(analysis).endswith("plan=EffectPlan, observed=None)")
    cells = Partition.from_labels(torch.tensor([0, 1, 0]), 2)
    assert repr(cells) == "Partition(order=int64 (3,), offsets=int64 (3,), singles=1)"
    assert repr(load_checkpoint("standard")).startswith("Checkpoint(net=MergeNet, info=")
