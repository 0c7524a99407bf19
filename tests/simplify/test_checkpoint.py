"""The network that corrects merged Gaussians: a shipped one, one from a file, or none."""

from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis import analyze
from cvtgs.cli.main import main
from cvtgs.clock import StageClock
from cvtgs.errors import CheckpointError, ConfigError, InvalidArgumentError
from cvtgs.mergenet import (
    Architecture,
    CheckpointInfo,
    MergeNet,
    correct_cells,
    encode_checkpoint,
    load_checkpoint,
)
from cvtgs.pipeline import reduce_scene
from cvtgs.train.cases import merge_scene
from cvtgs.validity import standardized
from mergenet_cases import lively_net
from scenes import random_scene, same_bits

each_preset = pytest.mark.parametrize("preset", ["standard", "paper"])


def saved(path: Path, net: MergeNet, preset: str = "standard") -> Path:
    info = CheckpointInfo(architecture=net.architecture, preset=preset)
    path.write_bytes(encode_checkpoint(net, info))
    return path


@pytest.fixture
def lively(tmp_path) -> Path:
    return saved(tmp_path / "lively.safetensors", lively_net(torch.float32))


@each_preset
def test_a_shipped_checkpoint_selects_its_preset(preset):
    simplifier = Simplifier(preset, device="cpu")
    assert simplifier.config == SimplifyConfig.from_preset(preset)
    assert simplifier.checkpoint.name == preset
    report = simplifier.run(random_scene(100), 0.1).report
    assert report.checkpoint == preset
    assert "network" in {stage.stage for stage in report.stages}


@each_preset
def test_auto_is_the_shipped_checkpoint_of_the_preset(preset):
    scene = random_scene(300)
    by_config, by_name = Simplifier(config=preset, device="cpu"), Simplifier(preset, device="cpu")
    assert by_config.checkpoint.digest == by_name.checkpoint.digest
    assert same_bits(by_config.simplify(scene, 0.1), by_name.simplify(scene, 0.1))
    assert Simplifier().checkpoint.name == "standard"


@each_preset
@pytest.mark.parametrize("how", ["ckpt", "config"])
def test_none_merges_by_moments_alone(preset, how):
    config = {"preset": preset, "merge": {"network": how != "config"}}
    ckpt = None if how == "ckpt" else "auto"
    simplifier = Simplifier(ckpt, config=SimplifyConfig.from_mapping(config), device="cpu")
    scene = random_scene(300)
    small, report = simplifier.run(scene, 0.1)
    assert simplifier.checkpoint is None
    assert report.checkpoint == "none"
    assert "network" not in {stage.stage for stage in report.stages}
    reference = merge_scene(scene, 30, SimplifyConfig.from_preset(preset))
    assert same_bits(small, standardized(reference.merged))


def test_none_alone_is_the_standard_configuration():
    assert Simplifier(None).config == SimplifyConfig()


@pytest.mark.parametrize("kind", [str, Path])
def test_a_file_corrects_and_is_named_in_the_report(lively, kind):
    scene = random_scene(300)
    small, report = Simplifier(kind(lively), device="cpu").run(scene, 0.1)
    assert report.checkpoint == str(lively)
    plain = Simplifier(None, device="cpu").simplify(scene, 0.1)
    assert float((small.log_scales - plain.log_scales).abs().amax()) > 0.1
    assert len(small) == len(plain) == 30


def test_a_file_selects_its_preset_unless_a_config_is_given(tmp_path):
    path = saved(tmp_path / "a.safetensors", lively_net(torch.float32), "paper")
    assert Simplifier(path).config.preset == "paper"
    with pytest.warns(UserWarning, match="trained on cells of the preset paper, not of standard;"):
        chosen = Simplifier(path, config="standard")
    assert (chosen.config.preset, chosen.checkpoint.name) == ("standard", str(path))


@pytest.mark.parametrize(("preset", "warns"), [("paper", 1), ("standard", 0), ("high", 0)])
def test_a_checkpoint_for_other_cells_is_used_with_a_warning(preset, warns, recwarn):
    Simplifier("standard", preset=preset)
    Simplifier("auto", preset=preset)
    assert len(recwarn) == warns


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@each_preset
@pytest.mark.slow
def test_an_untrained_network_changes_no_bit(tmp_path, preset, dtype, degree):
    path = saved(tmp_path / "zero.safetensors", MergeNet(Architecture()), preset)
    scene = random_scene(300, degree=degree, dtype=dtype)
    corrected = Simplifier(path, device="cpu").simplify(scene, 0.1)
    assert same_bits(corrected, Simplifier(None, config=preset, device="cpu").simplify(scene, 0.1))


def test_the_checkpoint_is_not_changed_by_use(lively):
    """A float64 scene gets a float64 copy of the network."""
    simplifier = Simplifier(lively, device="cpu")
    before = {k: v.clone() for k, v in simplifier.checkpoint.net.state_dict().items()}
    first = simplifier.simplify(random_scene(200), 0.1)
    simplifier.simplify(random_scene(200, dtype=torch.float64), 0.1)
    after = simplifier.checkpoint.net.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert {values.dtype for values in after.values()} == {torch.float32}
    assert same_bits(simplifier.simplify(random_scene(200), 0.1), first)


def test_ratio_of_one_needs_no_network(lively):
    scene = random_scene(50, degree=2)
    small, report = Simplifier(lively, device="cpu").run(scene, 1.0)
    assert same_bits(small, scene)
    assert "network" not in {stage.stage for stage in report.stages}


def test_the_network_does_not_change_single_member_cells(lively):
    """Cells with one member stay unchanged, while others are corrected."""
    scene = random_scene(40)
    small, report = Simplifier(lively, device="cpu").run(scene, count=35)
    rows = {tuple(mean) for mean in scene.means.tolist()}
    kept = sum(tuple(mean) in rows for mean in small.means.tolist())
    assert kept == report.single_member_cells > 0


@pytest.mark.parametrize("image_size", [400, 900])
def test_the_reference_is_the_input_of_the_network(lively, image_size):
    """Correcting the reference by hand gives what the stages give."""
    scene = random_scene(300)
    config = SimplifyConfig.from_mapping({"merge": {"image_size": image_size}})
    net = load_checkpoint(lively).net
    reference = merge_scene(scene, 30, config)
    clock = StageClock(lambda event: None, torch.device("cpu"))
    analysis = analyze(scene, config, with_visibility=True)
    small = reduce_scene(scene, analysis, 30, config, net=net, clock=clock).scene
    by_hand = correct_cells(
        net,
        reference.scene,
        reference.merged,
        reference.partition,
        neighbors=reference.neighbors,
        visibility=reference.visibility,
        pixel_size=reference.radius / config.merge.image_size,
    )
    assert reference.neighbors.shape == (30, 8)
    assert reference.visibility.shape == (300,)
    assert same_bits(standardized(by_hand), small)


@pytest.mark.parametrize("target", [10, 11])
def test_a_reference_needs_fewer_cells_than_gaussians(target):
    with pytest.raises(InvalidArgumentError) as caught:
        merge_scene(random_scene(10), target, SimplifyConfig())
    assert str(caught.value) == f"target must be below the 10 valid Gaussians, found {target}."


@pytest.mark.parametrize("ckpt", ["net.safetensors", "best", Path("nowhere/net.safetensors")])
def test_a_missing_checkpoint_is_an_error(ckpt):
    with pytest.raises(CheckpointError) as caught:
        Simplifier(ckpt)
    assert str(caught.value) == (
        f"{ckpt}: no such checkpoint; it must be standard or paper, or a file."
    )


def test_a_damaged_checkpoint_is_an_error(lively):
    lively.write_bytes(lively.read_bytes()[:-1])
    with pytest.raises(CheckpointError) as caught:
        Simplifier(lively)
    assert (
        str(caught.value)
        == f"{lively}: the checkpoint is not a safetensors file, or it is damaged."
    )


def test_the_command_line_switches_the_network_off(tmp_path):
    source, small = tmp_path / "in.ply", {}
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=3), source)
    for word in ("true", "false"):
        output, report = tmp_path / f"{word}.ply", tmp_path / f"{word}.json"
        words = [str(source), str(output), "--rho", "0.1", "--report", str(report)]
        assert main(["simplify", *words, "--set", f"merge.network={word}", "--quiet"]) == 0
        small[word] = report.read_text()
    assert '"checkpoint": "standard"' in small["true"]
    assert '"checkpoint": "none"' in small["false"]


def test_a_checkpoint_for_a_configuration_without_network_is_an_error():
    config = SimplifyConfig.from_mapping({"merge": {"network": False}})
    with pytest.raises(ConfigError) as caught:
        Simplifier("standard", config=config)
    assert str(caught.value) == (
        "without a network (merge.network is false, as in draft and fast), the checkpoint must be "
        "auto or none; found 'standard'."
    )
