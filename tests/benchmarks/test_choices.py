"""The table of choices, and gains by the height of the view."""

import json
import math
import sys
from dataclasses import replace

import pytest
import torch

import cvtgs
from benchmarks import cameras as camera_files, choices, heights, upright
from cvtgs.edit import Motion, move
from cvtgs.evaluation import EvaluationSettings
from cvtgs.tags import ANTIALIASED
from cvtgs.views import automatic_views

SCENE = cvtgs.synthetic.scene("object", 600, sh_degree=0, seed=0)
VIEWS = automatic_views(SCENE, 2, width=40, height=30)


@pytest.fixture
def file(tmp_path):
    cvtgs.save(SCENE, tmp_path / "thing.ply")
    document = {
        "width": 40,
        "height": 30,
        "K": VIEWS.Ks[0].tolist(),
        "world_to_camera": VIEWS.viewmats.tolist(),
    }
    (tmp_path / "thing.cameras.json").write_text(json.dumps(document))
    return tmp_path / "thing.ply"


@pytest.mark.long
def test_rows_have_the_scores_of_evaluate_and_differences_to_the_base(file, tmp_path, capsys):
    place = tmp_path / "rows.json"
    common = ["--base", "merge.network=false", "--rho", "0.1", "--cache", str(tmp_path / "kept")]
    choices.main([str(file), *common, "--set", "cvt.color=0.5", "--json", str(place)])
    base, other = json.loads(place.read_text())
    config = cvtgs.SimplifyConfig.compose(
        preset="standard", settings={"merge.network": "false", "cvt.color": "0.5"}
    )
    small = cvtgs.Simplifier(config=config).simplify(SCENE, 0.1)
    wanted = cvtgs.evaluate(
        SCENE, {"small": small}, VIEWS, settings=EvaluationSettings(lpips="off")
    ).scenes[0]
    assert other["name"] == "cvt.color=0.5"
    assert other["psnr"] == pytest.approx(wanted.psnr.mean, abs=1e-3)
    assert other["alpha_error"] == pytest.approx(wanted.alpha_error.mean, abs=1e-5)
    assert other["alpha_bias"] == pytest.approx(wanted.alpha_bias.mean, abs=1e-5)
    assert other["seconds"] > 0
    last = capsys.readouterr().out.splitlines()[-1].split()
    assert last[:2] == ["thing", "0.1"]
    assert float(last[3]) == pytest.approx(other["psnr"] - base["psnr"], abs=0.006)


@pytest.mark.long
def test_presets_can_be_fitted_to_cameras_that_do_not_score(file, tmp_path):
    place = tmp_path / "rows.json"
    small = ["visibility.size=32", "visibility.stride=1", "visibility.views=4", "refine.steps=0"]
    common = ["--rho", "0.1", "--cache", str(tmp_path / "kept"), "--json", str(place), "--fit", "5"]
    choices.main([str(file), *common, "--base", "preset=matched", *small])
    (row,) = json.loads(place.read_text())
    cameras = camera_files.spread_cameras(SCENE, 5)
    assert len(cameras) == 5
    assert len(torch.unique(cameras.centers, dim=0)) == 5
    settings = dict(word.split("=") for word in small)
    config = cvtgs.SimplifyConfig.compose(preset="matched", settings=settings)
    found = cvtgs.Simplifier(config=config).simplify(SCENE, 0.1, cameras=cameras)
    scores = cvtgs.evaluate(
        SCENE, {"small": found}, VIEWS, settings=EvaluationSettings(lpips="off")
    ).scenes[0]
    assert row["psnr"] == pytest.approx(scores.psnr.mean, abs=1e-3)


@pytest.mark.long
def test_a_checkpoint_is_a_choice(file, tmp_path):
    place = tmp_path / "rows.json"
    common = ["--rho", "0.1", "--cache", str(tmp_path / "kept"), "--json", str(place)]
    networks = ["--set", "ckpt=none", "--set", "merge.network=false", "--set", "ckpt=standard"]
    choices.main([str(file), *common, *networks])
    base, none, without, shipped = (row["psnr"] for row in json.loads(place.read_text()))
    assert none == without != base == shipped


@pytest.mark.long
def test_images_may_ignore_the_tag(tmp_path, file):
    """The images of the full scene, too, also if those with the tag are cached."""
    tagged = replace(SCENE, comments=(ANTIALIASED.text,))
    cvtgs.save(tagged, file, overwrite=True)
    place = tmp_path / "rows.json"
    common = ["--rho", "0.1", "--cache", str(tmp_path / "kept"), "--json", str(place)]
    small = cvtgs.Simplifier().simplify(tagged, 0.1)
    settings = EvaluationSettings(lpips="off")
    for more, comments in ([], (ANTIALIASED.text,)), (["--ignore-tag"], ()):
        choices.main([str(file), *common, *more])
        full, shown = (replace(scene, comments=comments) for scene in (SCENE, small))
        scores = cvtgs.evaluate(full, {"small": shown}, VIEWS, settings=settings).scenes[0]
        (row,) = json.loads(place.read_text())
        assert row["psnr"] == pytest.approx(scores.psnr.mean, abs=1e-3)


def test_full_scenes_are_rendered_once_and_then_read(file, tmp_path, monkeypatch):
    def images():
        cameras = camera_files.cameras_beside(file)
        full = camera_files.FullImages(scene=SCENE, cameras=cameras, folder=tmp_path / "kept")
        return [torch.cat([one.rgb, one.alpha[..., None]], dim=3) for one in full.images()]

    first = images()
    assert first[0].shape == (1, 30, 40, 4)
    monkeypatch.delattr(camera_files, "render_views")
    assert all(torch.equal(one, other) for one, other in zip(first, images(), strict=True))


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_rings_look_at_an_object_from_above_its_ground(up, tmp_path, capsys):
    scene = cvtgs.synthetic.scene("object", 2000, sh_degree=0, seed=0)
    quat = {"y": (0.0, 1.0, 0, 0), "-y": (1.0, 0, 0, 0), "z": (1.0, -1.0, 0, 0)}[up]
    axis = {"y": (0, 1.0, 0), "-y": (0, -1.0, 0), "z": (0, 0, 1.0)}[up]
    turned = move(scene, Motion(quat=quat))
    cvtgs.save(turned, tmp_path / "thing.ply")
    camera_files.main([str(tmp_path / "thing.ply"), "--transforms"])
    names = ["thing.cameras.json", "thing.transforms.json"]
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in names]
    cameras = camera_files.cameras_beside(tmp_path / "thing.ply")
    same = cvtgs.load_cameras(tmp_path / "thing.transforms.json")
    torch.testing.assert_close(same.viewmats.double(), cameras.viewmats, rtol=0, atol=1e-5)
    torch.testing.assert_close(same.Ks.double(), cameras.Ks, rtol=1e-6, atol=1e-6)
    assert len(cameras) == 12
    middle = turned.means.double().median(dim=0).values
    directions = torch.nn.functional.normalize(cameras.centers - middle, dim=1)
    heights = directions @ torch.tensor(axis, dtype=torch.float64)
    assert heights[:8].min() > 0.1
    assert heights[8:].min() > heights[:8].max()
    assert torch.unique(directions.round(decimals=3), dim=0).shape[0] == 12
    alphas = cvtgs.render(turned, cameras.fitted(40)).alpha
    assert alphas.mean(dim=(1, 2)).min() > 0.03  # each shows the object


def test_a_scene_without_cameras_is_refused_by_name(tmp_path):
    with pytest.raises(SystemExit, match=r"other\.ply: needs cameras beside it"):
        camera_files.cameras_beside(tmp_path / "other.ply")


@pytest.mark.parametrize("text", ["[]", "{}", "no JSON", '{"K": 1, "width": 1, "height": 1}'])
def test_cameras_of_another_format_are_refused_by_name(tmp_path, text):
    (tmp_path / "a.cameras.json").write_text(text)
    with pytest.raises(SystemExit, match=r"a\.cameras\.json: must have width, height, K and world"):
        camera_files.cameras_beside(tmp_path / "a.ply")


@pytest.mark.parametrize("words", [["--rho", "2"], ["--set", "nonsense=1"]])
def test_mistakes_are_found_before_anything_is_measured(tmp_path, capsys, words):
    cvtgs.save(SCENE, tmp_path / "thing.ply")
    with pytest.raises(SystemExit, match=r"nonsense|\b2\b"):
        choices.main([str(tmp_path / "thing.ply"), "--automatic", *words])
    with pytest.raises(SystemExit, match=r"none\.ply"):
        choices.main([str(tmp_path / "none.ply"), "--automatic"])
    assert capsys.readouterr().out == ""


def test_scenes_of_one_name_have_bases_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr(choices, "warm_up", lambda: None)
    for folder, scene in (("a", SCENE), ("b", SCENE[:300])):
        (tmp_path / folder).mkdir()
        cvtgs.save(scene, tmp_path / folder / "thing.ply")
    files = [str(tmp_path / folder / "thing.ply") for folder in ("a", "b")]
    output = tmp_path / "rows.json"
    given = ["--automatic", "--size", "32", "--rho", "0.1", "--set", "preset=draft"]
    choices.main([*files, *given, "--cache", str(tmp_path / "cache"), "--json", str(output)])
    rows = json.loads(output.read_text())
    assert [row["scene"] for row in rows] == [
        *["a-thing.ply"] * 2,
        *["b-thing.ply"] * 2,
        *["mean"] * 2,
    ]


def test_means_are_over_scenes():
    common = {"rho": 0.1, "name": "base", "ssim": 0.5, "lpips": None, "alpha_error": 0.1}
    common |= {"alpha_bias": -0.1, "seconds": 1.0}
    rows = [choices.Row(scene=str(psnr), psnr=psnr, **common) for psnr in (20.0, 30.0)]
    (found,) = choices.means(rows)
    assert (found.scene, found.psnr, found.lpips) == ("mean", 25.0, None)


def row_of(psnr: float, name: str = "base") -> choices.Row:
    return choices.Row(
        scene="a", rho=1.0, name=name, psnr=psnr, ssim=0.5, lpips=None, alpha_error=0.1,
        alpha_bias=-0.1, seconds=1.0,
    )  # fmt: skip


def test_columns_stay_in_place_where_lpips_has_no_weights():
    for mode in ("auto", "off"):
        options = choices.parser().parse_args(["a.ply", "--lpips", mode])
        head, row = choices.heads(options), choices.line(row_of(20.0), [row_of(20.0)], options)
        assert head.index("CPU s") + len("CPU s") == row.index(" 1.00") + len(" 1.00")
        assert ("-" in row.split()) == (mode == "auto")


def test_images_without_any_error_have_no_difference_and_are_null_in_json(tmp_path):
    rows = [row_of(math.inf), row_of(math.inf, "other")]
    options = choices.parser().parse_args(["a.ply"])
    assert choices.line(rows[1], rows, options).split()[2:4] == ["inf", "+0.00"]
    choices.save(rows, tmp_path / "rows.json")
    assert [one["psnr"] for one in json.loads((tmp_path / "rows.json").read_text())] == [None] * 2


pytestmark = pytest.mark.slow


def test_every_variant_is_compared_with_standard_at_every_height(tmp_path, monkeypatch, capsys):
    file = tmp_path / "thing.spz"
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0), file)
    given = [str(file), "--rho", "0.1", "--views", "2", "--size", "24", "standard"]
    given.append("standard merge.inflation=2")
    monkeypatch.setattr(sys, "argv", ["heights", *given])
    heights.main()
    head, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in capsys.readouterr().out.splitlines()
    ]
    assert len(head) == 3 + len(heights.HEIGHTS)
    assert [row[:2] for row in rows] == [["thing", name] for name in ("standard", *given[-2:])]
    assert all(5 < float(value) < 60 for value in rows[0][2:])
    assert {float(value) for value in rows[1][2:]} == {0.0}
    assert any(float(value) != 0.0 for value in rows[2][2:])
    given = [str(file), "--rho", "1", "--views", "1", "--size", "24", "draft"]
    monkeypatch.setattr(sys, "argv", ["heights", *given])
    heights.main()
    _, kept = capsys.readouterr().out.splitlines()[-2:]
    assert {cell.strip() for cell in kept.strip("|").split("|")[2:]} == {"+0.00"}


def test_up_is_looked_for_in_every_convention(tmp_path, capsys):
    """The same place, once as it is and once turned to z up."""
    scene, files = cvtgs.synthetic.scene("courtyard", 2000, sh_degree=0, seed=0), []
    half = 0.5**0.5
    for name, quat in (("down", (1, 0, 0, 0)), ("turned", (half, -half, 0, 0))):
        files.append(str(tmp_path / f"{name}.ply"))
        cvtgs.save(move(scene, Motion(quat=quat)), files[-1])
    upright.main([*files, "--up", "turned=+z"])
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| down | 0° | 0° | 0° |",
        "| turned | 0° | 0° | 0° |",
        "| wrong | 0 | 0 | 0 |",
    ]
    for wrong in ("turned", "turned=up"):
        with pytest.raises(SystemExit):
            upright.main([files[1], "--up", wrong])
        assert f"NAME=AXIS, an axis of +x, -x, +y, -y, +z, -z; found '{wrong}'." in (
            capsys.readouterr().err
        )
    upright.main([files[1]])
    assert capsys.readouterr().out.splitlines()[-1] == "| wrong | 1 | 1 | 1 |"
