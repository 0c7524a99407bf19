"""Effects on the command line, and parts of files that are not read."""

from dataclasses import replace
from importlib import import_module

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.analysis import plan_effects, restore_columns
from cvtgs.cli.main import main
from cvtgs.errors import InvalidArgumentError
from cvtgs.io.ply import assemble
from cvtgs.scene import FLAT_LOG_SCALE
from scenes import random_scene, same_bits


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.ply"
    columns = {"label": torch.arange(200), "nx": torch.ones(200)}
    cvtgs.save(random_scene(200, degree=2).with_tensors({}, columns), path)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bands_above_the_requested_degree_are_zero(source, degree):
    full, part = cvtgs.load(source), cvtgs.load(source, sh_degree=degree)
    kept = min((degree + 1) ** 2 - 1, 8)
    assert part.sh_degree == full.sh_degree == 2
    assert part.shN[:, :kept].equal(full.shN[:, :kept])
    assert not part.shN[:, kept:].any()
    assert part.layout == full.layout
    assert part.sh0.equal(full.sh0)


def test_extra_columns_are_left_in_the_file(source):
    assert set(cvtgs.load(source).extras) == {"label", "nx", "ny", "nz"}
    assert not cvtgs.load(source, extras=False).extras


def test_columns_that_are_not_needed_are_not_copied(source, monkeypatch):
    asked = []

    class Watched:
        def __init__(self, rows):
            self.rows = rows

        def __len__(self):
            return len(self.rows)

        def __getitem__(self, name):
            asked.append(name)
            return self.rows[name]

    original = assemble
    monkeypatch.setattr(
        "cvtgs.io.ply.read.assemble",
        lambda chunks, **options: original(map(Watched, chunks), **options),
    )
    cvtgs.load(source, sh_degree=1, extras=False)
    assert {"x", "f_dc_0", "f_rest_0", "f_rest_2", "f_rest_8", "rot_3"} <= set(asked)
    assert not {"f_rest_3", "f_rest_7", "f_rest_23", "label", "nx"} & set(asked)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".sog"])
def test_other_formats_give_the_same(source, suffix, tmp_path):
    path = tmp_path / f"scene{suffix}"
    with pytest.warns(cvtgs.errors.DroppedDataWarning):
        cvtgs.save(cvtgs.load(source), path)
    full, part = cvtgs.load(path), cvtgs.load(path, sh_degree=1)
    assert part.sh_degree == 2
    assert part.shN[:, :3].equal(full.shN[:, :3])
    assert not part.shN[:, 3:].any()
    assert same_bits(cvtgs.load(path, sh_degree=3, extras=False), full)


@pytest.mark.parametrize("degree", [-1, 4])
def test_an_invalid_degree_is_refused(source, degree):
    with pytest.raises(
        InvalidArgumentError, match=f"must be a whole number between 0 and 3, found {degree}"
    ):
        cvtgs.load(source, sh_degree=degree)


def test_simplify_takes_effects(source, tmp_path):
    output, report = tmp_path / "out.ply", tmp_path / "report.json"
    words = ["simplify", str(source), str(output), "--rho", "0.2", "--report", str(report)]
    assert main([*words, "--effects", "sh=1,mip=off, extras=off"]) == 0
    small = cvtgs.load(output)
    assert small.sh_degree == 2
    assert small.shN[:, :3].any()
    assert not small.shN[:, 3:].any()
    assert not small.extras
    plan = cvtgs.SimplifyReport.model_validate_json(report.read_text()).plan
    assert (plan.sh.degree, plan.sh.forced, plan.mip.forced) == (1, True, True)


def test_settings_override_effects(source, tmp_path):
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.2"]
    words += ["--effects", "sh=1", "--set", "effects.sh=2", "--report", str(report)]
    assert main(words) == 0
    assert cvtgs.SimplifyReport.model_validate_json(report.read_text()).plan.sh.degree == 2


def test_info_lists_every_effect_with_its_evidence(source, capsys):
    assert main(["info", str(source), "--effects", "haze=on"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    for name in cvtgs.EffectPlan.model_fields:
        assert lines[name].split()[1].rstrip(",") in ("on", "off")
        assert " on if " in lines[name]
    assert lines["effect"].split() == ["effect", "state", "measured", "rule"]
    assert "on, to degree 2 " in lines["sh"]
    assert "off, by setting " in lines["haze"], "there is none"
    assert "forced" not in lines["sh"]


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ("sh", "--effects needs NAME=VALUE, for example sh=1,mip=off; found 'sh'."),
        ("sh=1,,", "--effects needs NAME=VALUE, for example sh=1,mip=off; found ''."),
        (
            "fog=on",
            "effects.fog: is not a known setting; there are sh, mip, unbounded, haze, flat, "
            "duplicates, clamping, extras, visibility.",
        ),
        ("sh=4", "effects.sh: input should be 'auto', 'on', 'off', 0, 1, 2 or 3, found '4'."),
        ("mip=maybe", "effects.mip: input should be 'auto', 'on' or 'off', found 'maybe'."),
        ("flat=on", "effects.flat: input should be 'auto' or 'off', found 'on'."),
    ],
)
@pytest.mark.parametrize("command", ["simplify", "info"])
def test_unknown_effects_are_refused_in_one_sentence(
    source, tmp_path, capsys, command, effects, message
):
    words = [command, str(source), "--effects", effects]
    words += [str(tmp_path / "out.ply"), "--rho", "0.1"] if command == "simplify" else []
    assert main(words) == 1
    assert capsys.readouterr().err == f"cvtgs: error: {message}\n"


def simplified(scene: GaussianScene, flat: str) -> cvtgs.Simplified:
    config = SimplifyConfig.from_mapping({"effects": {"flat": flat}})
    return Simplifier(config=config, device="cpu").run(scene, 0.1)


def surfels(count: int) -> GaussianScene:
    """A scene as it is read from a file without ``scale_2``."""
    scene = random_scene(count)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = FLAT_LOG_SCALE
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", *(f"rot_{i}" for i in range(4))]
    layout = tuple((name, "float") for name in names)
    return GaussianScene(**{**scene.tensors(), "log_scales": log_scales}, layout=layout)


def test_surfels_stay_surfels():
    flat, thick = (simplified(surfels(400), flat) for flat in ("auto", "off"))
    assert flat.report.plan.flat.active
    assert bool((flat.scene.log_scales[:, 2] == FLAT_LOG_SCALE).all())
    assert float(thick.scene.log_scales[:, 2].median()) > FLAT_LOG_SCALE / 2
    assert flat.scene.log_scales[:, :2].equal(thick.scene.log_scales[:, :2])


def test_flattening_leaves_the_given_scene_as_it_is():
    full, small = surfels(20), random_scene(10)
    plan = plan_effects(full, full.masses, distances=torch.ones(20))
    before = small.log_scales.clone()
    found = restore_columns(small, full, plan)
    assert found.log_scales[:, 2].tolist() == [FLAT_LOG_SCALE] * 10
    assert torch.equal(small.log_scales, before)


def test_surfels_are_written_without_a_third_scale(tmp_path):
    """Warnings are errors here: nothing was left out."""
    scene = surfels(400)
    cvtgs.save(simplified(scene, "auto").scene, tmp_path / "small.ply")
    again = cvtgs.load(tmp_path / "small.ply")
    assert again.layout == scene.layout
    assert bool((again.log_scales[:, 2] == FLAT_LOG_SCALE).all())


@pytest.mark.parametrize("flat", ["auto", "off"])
def test_protected_surfels_of_a_file_with_three_scales_stay_as_they_are(flat):
    """Only the tag says that they are flat; it is lost if the others become thick."""
    scene = replace(GaussianScene(**surfels(400).tensors()), comments=("SplatRenderMode: 2dgs",))
    config = SimplifyConfig.from_mapping({"effects": {"flat": flat}})
    small = Simplifier(config=config, device="cpu").simplify(
        scene, 0.1, keep=torch.arange(400) < 20
    )
    assert same_bits(replace(small[:20], comments=scene.comments), scene[:20])
    assert small.comments == (scene.comments if flat == "auto" else ())
    is_flat = small.log_scales[20:, 2] == FLAT_LOG_SCALE
    assert bool(is_flat.all()) == (flat == "auto")


def test_flat_gaussians_of_a_file_with_three_scales_may_become_thick():
    """Thick ones are closer to the merged members."""
    scene = GaussianScene(**surfels(400).tensors())
    small, report = simplified(scene, "auto")
    assert not report.plan.flat.active
    assert float(small.log_scales[:, 2].median()) > FLAT_LOG_SCALE / 2


def test_thick_gaussians_stay_thick(monkeypatch):
    monkeypatch.setattr(import_module("cvtgs.analysis.effects"), "FLAT_LOG_SCALE", None)
    simplified(random_scene(400), "auto")
