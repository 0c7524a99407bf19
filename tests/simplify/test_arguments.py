"""Wrong arguments of Simplifier: the error names the right one."""

import math
import re
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis import analyze
from cvtgs.errors import (
    CheckpointError,
    ConfigError,
    CvtgsError,
    InputNotFoundError,
    InvalidArgumentError,
)
from cvtgs.grouping import tessellate_rows, weigh_rows
from cvtgs.prepared import check_cameras
from cvtgs.refinement import RefineConfig
from cvtgs.rendering import contributions
from scenes import random_scene, same_bits


def test_a_preset_is_chosen_by_its_name():
    fast = Simplifier(preset="fast", device="cpu")
    assert fast.config.preset == "fast"
    scene = random_scene(300)
    other = Simplifier(config="fast", device="cpu")
    assert same_bits(fast.simplify(scene, 0.1), other.simplify(scene, 0.1))
    with pytest.raises(InvalidArgumentError, match="either preset or config, found both"):
        Simplifier(preset="fast", config="fast")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -5}, r"seed: input should be greater than or equal to 0, found -5\."),
        ({"cvt": 3}, r"cvt: holds settings, found 3\."),
        ({"preset": "quick"}, "preset must be one of .*found 'quick'"),
    ],
)
def test_an_unchecked_copy_of_a_configuration_is_checked(changes, message):
    copy = SimplifyConfig().model_copy(update=changes)
    with pytest.raises(ConfigError, match=message):
        Simplifier(config=copy, device="cpu")


def test_sections_of_a_copied_configuration_may_be_mappings():
    fast = SimplifyConfig(preset="fast")
    copy = fast.model_copy(update={"merge": {"inflation": 0.2}})
    merge = fast.merge.model_copy(update={"inflation": 0.2})
    assert Simplifier(config=copy, device="cpu").config == SimplifyConfig(
        preset="fast", merge=merge
    )


def test_a_configuration_of_another_class_is_that_of_its_preset_or_refused():
    class Fast(SimplifyConfig):
        preset: str = "fast"

    class Tagged(SimplifyConfig):
        tag: str = "nightly"

    assert Simplifier(config=Fast(), device="cpu").config == SimplifyConfig(preset="fast")
    with pytest.raises(ConfigError, match="tag: is not a known setting"):  # reports would lose it
        Simplifier(config=Tagged(), device="cpu")


def test_one_call_takes_a_scene_or_a_path(tmp_path):
    scene, path = random_scene(300), tmp_path / "scene.ply"
    scene.save(path)
    wanted = Simplifier(preset="fast", device="cpu").simplify(scene, 0.1)
    for one in (scene, path, str(path)):
        small = cvtgs.simplify(one, 0.1, preset="fast", device="cpu")
        assert all(torch.equal(small.tensors()[k], wanted.tensors()[k]) for k in wanted.tensors())
    assert len(cvtgs.simplify(path, count=7, device="cpu")) == 7
    with pytest.raises(ConfigError, match="fastest"):
        cvtgs.simplify(tmp_path / "missing.ply", 0.1, preset="fastest")
    with pytest.raises(InputNotFoundError):
        cvtgs.simplify(tmp_path / "missing.ply", 0.1)


def test_a_preset_given_as_the_checkpoint_is_an_error():
    with pytest.raises(CheckpointError, match="For the preset, write preset='fast'"):
        Simplifier("fast")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"config": {}}, r"config must be a SimplifyConfig or the name of a preset, found {}\."),
        ({"config": 3}, "config must be a SimplifyConfig or the name of a preset, found 3"),
        ({"preset": 3}, "preset must be one of draft, .*; found 3"),
        ({"ckpt": 3}, r"ckpt must be the name of a checkpoint, a file or None, found int\."),
        ({"ckpt": SimplifyConfig()}, "found SimplifyConfig; for a configuration, give config."),
        ({"listener": None}, "listener must be a function of a progress event, found None"),
        ({"device": None}, "device must be a name such as 'cpu' or a torch.device, found None"),
    ],
)
def test_arguments_of_other_types_are_errors(arguments, message):
    with pytest.raises(CvtgsError, match=message):
        Simplifier(**arguments)


@pytest.mark.parametrize("preset", ["standard", "fast"])
def test_a_report_says_how_to_repeat_the_run(preset):
    """Also without a network, where the checkpoint of the report is "none"."""
    scene = random_scene(300)
    small, report = Simplifier(None, config=preset, device="cpu").run(scene, 0.1)
    again = Simplifier(report.checkpoint, config=report.config, device="cpu")
    assert same_bits(again.simplify(scene, 0.1), small)


@pytest.mark.long
def test_paths_are_accepted_wherever_scenes_are(tmp_path):
    scene, path = random_scene(300), tmp_path / "scene.ply"
    scene.save(path)
    simplifier = Simplifier(preset="fast", device="cpu")
    (wanted,) = simplifier.levels(scene, [0.1])
    assert repr(simplifier) == "Simplifier(preset fast, checkpoint none, device cpu)"
    assert repr(Simplifier()) == "Simplifier(preset standard, checkpoint standard, device auto)"
    for one in (path, str(path)):
        assert same_bits(simplifier.simplify(one, 0.1), wanted.scene)
        assert same_bits(simplifier.levels(one, [0.1])[0].scene, wanted.scene)
        assert same_bits(simplifier.prepare(one).run(0.1).scene, wanted.scene)
        assert cvtgs.describe(one) == cvtgs.describe(scene)
    cameras = cvtgs.views.automatic_views(path, 2, width=32, height=24)
    assert torch.equal(cvtgs.render(path, cameras).rgb, cvtgs.render(scene, cameras).rgb)
    settings = cvtgs.evaluation.EvaluationSettings(lpips="off")
    small = wanted.scene
    by_paths = cvtgs.evaluate(path, {"same": str(path)}, cameras, settings=settings)
    assert by_paths.scenes[0].psnr.mean == float("inf")
    config = RefineConfig(size=32, heldout=2)
    assert cvtgs.refine(small, path, steps=1, config=config).report.steps == 1
    assert cvtgs.budget.find_count(path, psnr=1.0, simplifier=simplifier).psnr >= 1


@pytest.mark.parametrize(("preset", "count"), [("matched", 1), ("high", 0)])
def test_too_few_cameras_are_refused_before_the_work(preset, count):
    scene = random_scene(30)
    cameras = cvtgs.views.automatic_views(scene, 1, width=32, height=24).spread(max(1, count))
    cameras = cameras.select(torch.arange(count))
    with pytest.raises(InvalidArgumentError, match=f"at least 2 cameras, .*; found {count}"):
        Simplifier(config=preset, device="cpu").prepare(scene, cameras=cameras)
    assert len(Simplifier(device="cpu").simplify(scene, 0.1, cameras=cameras)) == 3


def test_one_camera_is_enough_without_a_refinement():
    cameras = cvtgs.views.automatic_views(random_scene(30), 1, width=32, height=24)
    matched = SimplifyConfig.from_mapping({"preset": "matched", "refine": {"steps": 0}})
    check_cameras(cameras, matched)
    with pytest.raises(InvalidArgumentError, match="at least 1 camera; found 0"):
        check_cameras(cameras.select(torch.arange(0)), matched)


def test_the_report_names_no_views_where_nothing_is_rendered():
    simplifier = Simplifier(config="matched", device="cpu")
    assert simplifier.run(random_scene(30), 1.0).report.views == "none"


def test_the_error_names_an_argument_that_is_not_a_scene():
    with pytest.raises(InvalidArgumentError, match="scene must be a GaussianScene or the path of"):
        Simplifier(device="cpu").levels(3, [0.1])
    with pytest.raises(InvalidArgumentError, match=r"found dict \(use cvtgs\.from_dict\)"):
        cvtgs.simplify(cvtgs.to_dict(random_scene(30)), 0.1)
    cameras = cvtgs.views.automatic_views(random_scene(30), 1, width=32, height=24)
    with pytest.raises(InvalidArgumentError, match=r"scene .small. must be .*, found int"):
        cvtgs.evaluate(random_scene(30), {"small": 3}, cameras)
    with pytest.raises(InvalidArgumentError, match=r"full must be .*, found NoneType"):
        cvtgs.refine(random_scene(30), None)
    with pytest.raises(InputNotFoundError, match=r"missing\.ply"):
        Simplifier(device="cpu").simplify("missing.ply", 0.1)


PAGE = Path(__file__).parents[2] / "docs" / "method" / "index.md"


@pytest.fixture(scope="module")
def simplify_by_hand():
    """Return the function that the page defines."""
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names["simplify_by_hand"]


@pytest.mark.parametrize("preset", ["draft", "fast", "standard", "paper"])
@pytest.mark.parametrize(
    "scene",
    [
        random_scene(600, degree=2),
        random_scene(300, degree=1, dtype=torch.float64),
        cvtgs.synthetic.scene("landscape", 1500, sh_degree=1, seed=2),
    ],
    ids=["random", "float64", "landscape"],
)
@pytest.mark.slow
def test_stages_by_hand_give_the_bits_of_the_simplifier(simplify_by_hand, scene, preset):
    simplifier = cvtgs.Simplifier(preset=preset, device="cpu")
    whole = simplifier.simplify(scene, count=90)
    assert same_bits(simplify_by_hand(scene, 90, preset), whole)
    assert not same_bits(whole, simplifier.simplify(scene, count=89))


@pytest.mark.parametrize("target", [0, 0.05, 20.5, 31, math.nan])
def test_targets_of_a_tessellation_are_whole_numbers(target):
    scene, config = random_scene(30), SimplifyConfig()
    analysis = analyze(scene, config)
    points = weigh_rows(scene, torch.arange(30), analysis, config)
    with pytest.raises(InvalidArgumentError, match="target must be a whole number"):
        tessellate_rows(points, analysis, target, config)


def test_analyses_are_of_scenes():
    with pytest.raises(InvalidArgumentError, match="must be a GaussianScene of at least one"):
        analyze(random_scene(3)[:0], SimplifyConfig())
    with pytest.raises(InvalidArgumentError, match="must be of type GaussianScene, found str"):
        analyze("scene.ply", SimplifyConfig())
    with pytest.raises(InvalidArgumentError, match="config must be of type SimplifyConfig"):
        analyze(random_scene(3), None)


def test_arguments_of_another_kind_are_one_sentence(tmp_path):
    scene = random_scene(5)
    with pytest.raises(InvalidArgumentError, match="cameras must be Cameras, for example of"):
        cvtgs.render(scene, "cameras.json")
    for wrong in (None, b"bytes"):
        text = r"from a path or an open binary file \(io.BytesIO of bytes\), found"
        with pytest.raises(InvalidArgumentError, match=text):
            cvtgs.load(wrong)
    with pytest.raises(InvalidArgumentError, match=r"must be a GaussianScene, found 'a\.ply'"):
        cvtgs.save("a.ply", tmp_path / "z.ply")


@pytest.mark.parametrize("preset", ["standard", "paper"])
def test_the_random_numbers_of_the_program_are_left_alone(preset):
    torch.manual_seed(0)
    wanted = torch.rand(2)
    torch.manual_seed(0)
    Simplifier(config=preset, device="cpu").simplify(random_scene(50), 0.1)
    assert torch.equal(torch.rand(2), wanted)


def test_cameras_of_other_types_are_errors():
    scene, wrong = random_scene(20), [object()]
    for work in (
        lambda: Simplifier(config="matched", device="cpu").simplify(scene, 0.1, cameras=wrong),
        lambda: cvtgs.refine(scene, scene, steps=1, cameras=wrong),
        lambda: cvtgs.evaluate(scene, {"a": scene}, wrong),
        lambda: contributions(scene, wrong),
    ):
        with pytest.raises(InvalidArgumentError, match="cameras must be Cameras, for example of"):
            work()


def test_configurations_of_other_types_are_errors():
    scene = random_scene(20)
    with pytest.raises(InvalidArgumentError, match="config must be a RefineConfig, found 'high'"):
        cvtgs.refine(scene, scene, config="high")
    with pytest.raises(InvalidArgumentError, match="config must be of type SimplifyConfig or None"):
        cvtgs.describe(scene, "fast")
