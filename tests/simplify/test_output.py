"""The output of a simplification, its report, and arguments that are refused."""

import math
from io import BytesIO

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, ProgressEvent, Simplifier, SimplifyConfig
from cvtgs.errors import CvtgsError, DeviceError, InvalidSceneError
from cvtgs.validity import invalid_rows, standardized
from refine_cases import ring
from scenes import assert_standard, random_scene, same_bits

each_preset = pytest.mark.parametrize("preset", ["standard", "paper"])
STAGES = ["check", "plan", "filter", "weigh", "tessellate", "allocate", "merge", "network"]
INF = float("inf")


@each_preset
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.slow
def test_output_is_a_standard_scene(degree, dtype, preset):
    scene = random_scene(300, degree=degree, dtype=dtype)
    small = Simplifier(config=preset, device="cpu").simplify(scene, 0.1)
    assert small.sh_degree == degree
    assert small.dtype == dtype
    assert_standard(small)


@each_preset
def test_comments_layout_and_extras_are_kept(preset):
    plain = random_scene(100)
    scene = GaussianScene(
        **plain.tensors(),
        extras={"label": torch.arange(100) % 3, "heat": torch.linspace(0, 1, 100)},
        comments=("SplatRenderMode: mip", "made by hand"),
        layout=(("x", "float"), ("label", "int")),
    )
    result = Simplifier(config=preset, device="cpu").run(scene, 0.1)
    small = result.scene
    assert small.comments == scene.comments
    assert small.layout == scene.layout
    assert small.antialiased
    assert small.extras["label"].dtype == torch.int64
    assert set(small.extras["label"].tolist()) <= {0, 1, 2}
    assert bool(((small.extras["heat"] >= 0) & (small.extras["heat"] <= 1)).all())
    assert result.report.plan.mip.active
    assert result.report.plan.extras.active


def test_infinite_opacities_are_valid_input():
    scene = random_scene(100)
    logits = scene.logit_opacities.clone()
    logits[::2], logits[1::4] = INF, -INF
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    for rho in (0.1, 0.9, 1.0):
        result = Simplifier(device="cpu").run(scene, rho)
        assert result.report.invalid_count == 0
        assert bool(result.scene.logit_opacities.isfinite().all())


@pytest.mark.parametrize("preset", ["draft", "standard", "paper"])
def test_the_largest_valid_scales_stay_valid(preset):
    scene = random_scene(300, degree=0)
    scene = scene.with_tensors(log_scales=torch.full((300, 3), 88.5))
    small = Simplifier(preset=preset, device="cpu").simplify(scene, count=15)
    assert not invalid_rows(small)


def test_mass_of_haze_is_conserved_without_inflation_and_network():
    """In transparent cells, opacity equals optical depth, and depth times area is additive."""
    config = SimplifyConfig.from_mapping(
        {"filter": {"max_mass_share": 0.0}, "merge": {"inflation": 0.0}}
    )
    scene = random_scene(1000)
    scene = scene.with_tensors({"logit_opacities": 0.2 * scene.logit_opacities - 4.0}, {})
    report = Simplifier(None, config=config, device="cpu").run(scene, 0.3).report
    assert report.mass_in == pytest.approx(float(scene.masses.sum()))
    assert report.mass_out == pytest.approx(report.mass_in, rel=0.05)


@each_preset
@pytest.mark.parametrize("rho", [0.5, 0.1, 0.01])
def test_report_is_sane(preset, rho):
    scene = random_scene(1000)
    small, report = Simplifier(config=preset, device="cpu").run(scene, rho)
    assert report.mass_in == pytest.approx(float(scene.masses.sum()))
    assert report.mass_out == pytest.approx(float(small.masses.sum()))
    assert report.mass_out > 0
    assert 0 <= report.filtered_mass_share <= (1.0 if preset == "paper" else 0.01)
    assert 0 <= report.filtered_count <= 1000 - len(small)
    assert 0 <= report.single_member_cells <= len(small)
    members = 1000 - report.filtered_count
    assert members / len(small) <= report.largest_cell <= members - len(small) + 1
    assert list(report.energies) == sorted(report.energies, reverse=True)
    assert math.isfinite(report.energy)
    assert report.backend == "scipy"
    assert report.device == "cpu"
    assert report.config.preset == report.checkpoint == preset
    assert [stage.stage for stage in report.stages] == STAGES
    assert report.seconds == pytest.approx(sum(stage.seconds for stage in report.stages))
    assert all(stage.seconds >= 0 and stage.peak_memory_bytes >= 0 for stage in report.stages)


@each_preset
def test_the_listener_hears_every_stage_from_start_to_end(preset):
    events: list[ProgressEvent] = []
    Simplifier(config=preset, device="cpu", listener=events.append).simplify(random_scene(200), 0.1)
    assert list(dict.fromkeys(event.stage for event in events)) == STAGES
    for name in STAGES:
        of_stage = [event for event in events if event.stage == name]
        assert of_stage[0].done == 0
        assert of_stage[-1].done == of_stage[-1].total > 0
        done = [event.done for event in of_stage]
        assert done.count(of_stage[-1].total) == 1
        assert done == sorted(done)
        assert len({event.total for event in of_stage}) == 1


@pytest.mark.parametrize("stage", STAGES)
def test_an_exception_of_the_listener_ends_the_call(stage):
    class StopError(Exception):
        pass

    def stop(event: ProgressEvent) -> None:
        if event.stage == stage:
            raise StopError(event.stage)

    with pytest.raises(StopError, match=stage):
        Simplifier(device="cpu", listener=stop).simplify(random_scene(200), 0.1)


def test_config_may_be_an_object_or_a_name():
    config = SimplifyConfig.from_preset("paper")
    scene = random_scene(100)
    assert Simplifier(config=config).config == Simplifier(config="paper").config
    first, second = (
        Simplifier(config=c, device="cpu").simplify(scene, 0.1) for c in (config, "paper")
    )
    assert same_bits(first, second)


def test_an_unknown_preset_is_an_error():
    with pytest.raises(CvtgsError) as caught:
        Simplifier(config="best")
    presets = "draft, fast, standard, matched, high, paper"
    assert str(caught.value).startswith(f"preset must be one of {presets}")
    assert str(caught.value).endswith("; found 'best'.")


@pytest.mark.parametrize("device", ["gpu", "cpu:x", "", "meta", "hpu"])
def test_devices_that_do_not_exist_are_errors(device):
    with pytest.raises(DeviceError) as caught:
        Simplifier(device=device)
    assert str(caught.value).startswith(f"device {device!r} cannot be used here: ")
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    "call",
    [
        lambda scene: cvtgs.simplify(scene, 0.1, device="cpu"),
        lambda scene: cvtgs.simplify(scene, 0.1),
        cvtgs.describe,
        lambda scene: cvtgs.render(scene, ring(2)),
        lambda scene: cvtgs.evaluate(scene, {"same": scene}, ring(2)),
        lambda scene: cvtgs.rendering.observe(scene, ring(2)),
        lambda scene: cvtgs.rendering.contributions(scene, ring(2)),
        lambda scene: cvtgs.save(scene, BytesIO(), format="spz"),
        lambda scene: cvtgs.io.losses(scene, ".spz"),
    ],
)
def test_a_scene_without_values_is_an_error(call):
    with pytest.raises(InvalidSceneError, match="must hold values, found tensors on the device me"):
        call(random_scene(20).to("meta"))


def test_missing_cuda_is_an_error():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(DeviceError, match=r"device 'cuda' cannot be used here: .*; use another"):
        Simplifier(device="cuda")


@pytest.mark.cuda
@each_preset
def test_cuda_gives_a_standard_scene_on_the_device_of_the_input(preset):
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    scene = random_scene(2000, degree=2)
    first, second = (Simplifier(config=preset, device="cuda").simplify(scene, 0.1) for _ in "ab")
    assert first.device == scene.device
    assert len(first) == 200
    assert_standard(first)
    assert same_bits(first, second)


def test_every_image_of_contributions_is_an_event():
    events: list[ProgressEvent] = []
    images = {"views": 5, "size": 32, "stride": 1}
    config = SimplifyConfig.from_mapping(
        {"preset": "matched", "visibility": images, "refine": {"steps": 0}}
    )
    Simplifier(config=config, device="cpu", listener=events.append).simplify(random_scene(200), 0.1)
    found = [(event.done, event.total) for event in events if event.stage == "visibility"]
    assert found == [(done, 5) for done in range(6)]


def test_short_quaternions_are_normalized():
    scene = random_scene(3, degree=0)
    short = scene.with_tensors({"quats": 0.5 * scene.quats}, {})
    torch.testing.assert_close(standardized(short).quats.norm(dim=1), torch.ones(3))
