"""``cvtgs evaluate``, ``cvtgs render`` and ``cvtgs compare``."""

import json
import re
import sys

import numpy as np
import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.evaluation import Evaluation
from cvtgs.evaluation.images import encode

SMALL = ["--views", "2", "--size", "48"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A full scene, two simplified ones, and cameras with photographs."""
    place = tmp_path_factory.mktemp("scenes")
    scene = cvtgs.synthetic.scene("object", 2000, sh_degree=0, seed=0)
    cvtgs.save(scene, place / "full.ply")
    for rho in (0.1, 0.01):
        cvtgs.save(cvtgs.Simplifier(device="cpu").simplify(scene, rho), place / f"{rho}.ply")
    pose = [[1, 0, 0, 0], [0, -1, 0, -1], [0, 0, -1, -5], [0, 0, 0, 1]]
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": pose} for n in range(9)]
    document = {"w": 64, "h": 48, "fl_x": 60.0, "frames": frames}
    (place / "transforms.json").write_text(json.dumps(document))
    (place / "images").mkdir()
    for number in range(9):
        image = np.full((96, 128, 3), 20 * number, np.uint8)
        (place / "images" / f"{number}.png").write_bytes(encode(image, "png"))
    return place


@pytest.fixture
def scenes(folder):
    return [str(folder / name) for name in ("full.ply", "0.1.ply", "0.01.ply")]


def test_evaluate_prints_a_row_per_scene(scenes, capsys):
    assert main(["evaluate", *scenes, *SMALL, "--lpips", "off"]) == 0
    printed = capsys.readouterr().out
    assert "2 views of 48 x 36 pixels, rendered by" in printed
    assert "against full.ply, 2,000 Gaussians:" in printed
    assert re.search(
        r"0\.1\.ply +200 +[\d.]+ kB +\d+\.\d\d +0\.\d{4}  +-  0\.\d{4}  [+-]0\.\d{4}\n", printed
    )
    assert "LPIPS" in printed


def test_patterns_are_expanded_where_the_shell_does_not(folder, capsys):
    """As on Windows."""
    words = ["evaluate", str(folder / "full.ply"), str(folder / "0.*.ply")]
    assert main([*words, *SMALL, "--lpips", "off", "--json"]) == 0
    found = Evaluation.model_validate_json(capsys.readouterr().out)
    assert [scores.name for scores in found.scenes] == ["0.01.ply", "0.1.ply"]
    assert main([*words[:2], str(folder / "no*.ply"), *SMALL]) == 1
    assert "the pattern must match a file, found none" in capsys.readouterr().err


def test_the_note_on_missing_lpips_weights_is_wrapped(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("CVTGS_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setattr(sys.modules["cvtgs.evaluation.lpips"], "find_spec", lambda name: None)
    assert main(["evaluate", *scenes[:2], *SMALL]) == 0
    lines = capsys.readouterr().out.splitlines()
    start = next(row for row, line in enumerate(lines) if line.startswith("LPIPS was not"))
    assert max(map(len, lines[start:])) <= 80
    text = " ".join(" ".join(lines[start:]).split())
    assert text.startswith("LPIPS was not measured: the weights must be at the path ")
    assert text.count(":") == 1


def test_evaluate_as_json(scenes, capsys):
    assert main(["evaluate", *scenes, *SMALL, "--lpips", "off", "--json"]) == 0
    evaluation = Evaluation.model_validate_json(capsys.readouterr().out)
    assert [scores.count for scores in evaluation.scenes] == [200, 20]
    assert (evaluation.width, evaluation.height, len(evaluation.views)) == (48, 36, 2)


def test_evaluate_against_photographs(folder, scenes, capsys):
    words = ["--cameras", str(folder), "--images", str(folder), "--split", "train"]
    assert main(["evaluate", *scenes[:2], *words, "--lpips", "off", "--json"]) == 0
    evaluation = Evaluation.model_validate_json(capsys.readouterr().out)
    assert len(evaluation.views) == 7
    assert (evaluation.width, evaluation.height) == (64, 48)
    assert [scores.name for scores in evaluation.photographs] == ["full.ply", "0.1.ply"]
    assert main(["evaluate", *scenes[:2], *words, "--lpips", "off", *SMALL]) == 0
    against_full, against_photographs = capsys.readouterr().out.split("against photographs:")
    assert "alpha" in against_full
    assert "alpha" not in against_photographs


def test_downscaled_photographs_are_found_without_a_size(folder, scenes, capsys):
    half = folder / "images_2"
    half.mkdir()
    for number in range(9):
        image = np.full((24, 32, 3), 20 * number, np.uint8)
        (half / f"{number}.png").write_bytes(encode(image, "png"))
    words = ["--cameras", str(folder), "--images", str(half), "--views", "2", "--lpips", "off"]
    assert main(["evaluate", *scenes[:2], *words, "--json"]) == 0
    evaluation = Evaluation.model_validate_json(capsys.readouterr().out)
    assert (evaluation.width, evaluation.height) == (32, 24)
    assert main(["evaluate", *scenes[:2], *words, "--json", "--size", "64"]) == 0
    evaluation = Evaluation.model_validate_json(capsys.readouterr().out)
    assert (evaluation.width, evaluation.height) == (64, 48)


def test_another_aspect_ratio_is_refused_in_one_sentence(folder, scenes, tmp_path, capsys):
    for number in range(9):
        (tmp_path / f"{number}.png").write_bytes(encode(np.zeros((48, 48, 3), np.uint8), "png"))
    words = ["--cameras", str(folder), "--images", str(tmp_path)]
    assert main(["evaluate", *scenes[:2], *words]) == 1
    assert capsys.readouterr().err == (
        f"cvtgs: error: {tmp_path / '0.png'}: photographs must have the aspect ratio of the "
        f"cameras' images, 64 x 48, found 48 x 48.\n"
    )


@pytest.mark.long
def test_tradeoff_against_photographs(folder, scenes, tmp_path, capsys):
    words = ["--cameras", str(folder), "--images", str(folder), "--views", "2", "--lpips", "off"]
    words += ["--presets", "draft", "--rho", "0.1", "-o", str(tmp_path)]
    assert main(["tradeoff", scenes[0], *words]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"photo PSNR, dB +\d+\.\d\d\n", printed)
    assert re.search(r"photo SSIM +0\.\d{4}\n", printed)
    assert "against the photographs" in " ".join(printed.split())
    told = json.loads((tmp_path / "tradeoff.json").read_text())["evaluation"]["photographs"]
    assert [scores["name"] for scores in told] == ["full.ply", "draft 0.1"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--images", "."], "--images needs the cameras of the photographs: --cameras."),
        (["--views", "0"], "--views must be from 1 to 10,000, found 0."),
        (["--views", "10001"], "--views must be from 1 to 10,000, found 10,001."),
        (["--size", "-3"], "--size must be from 1 to 16,384, found -3."),
        (["--size", "20000"], "--size must be from 1 to 16,384, found 20,000."),
        (["--split", "test"], "--split chooses among cameras and needs --cameras."),
        (
            ["--background", "1,2,3"],
            "--background must be red,green,blue from 0 to 1, or black, gray",
        ),
        (["--background", "pink"], "--background must be 3 numbers red,green,blue from 0 to 1, or"),
        (["--cameras", "nowhere.json"], "nowhere.json: "),
    ],
)
def test_invalid_arguments_are_refused_in_one_sentence(scenes, capsys, words, text):
    assert main(["evaluate", *scenes[:2], *words]) == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"cvtgs: error: {text}")
    assert errors.count("\n") == 1


def test_a_size_of_two_numbers_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["render", "a.ply", "-o", "out", "--size", "400x300"])
    assert capsys.readouterr().err.endswith(
        "argument --size: must be a whole number, found '400x300'\n"
    )


def test_missing_photographs_are_counted_and_named(folder, scenes, tmp_path, capsys):
    words = ["--cameras", str(folder), "--images", str(tmp_path)]
    assert main(["evaluate", *scenes[:2], *words]) == 1
    assert "9 of 9 cameras have none, the first is 'images/" in capsys.readouterr().err


def test_a_scene_given_twice_is_refused(scenes, capsys):
    assert main(["evaluate", scenes[0], scenes[0]]) == 1
    assert "every scene must be given once" in capsys.readouterr().err


def test_scenes_of_the_same_name_are_printed_with_their_paths(scenes, tmp_path, capsys):
    (tmp_path / "full.ply").write_bytes((tmp_path / scenes[1]).read_bytes())
    words = [scenes[0], str(tmp_path / "full.ply"), *SMALL, "--lpips", "off"]
    assert main(["evaluate", *words]) == 0
    assert str(tmp_path / "full.ply") in capsys.readouterr().out


def test_names_of_wide_and_combining_letters_are_aligned(scenes, tmp_path, capsys):
    names = ["\u5ead\u5712.ply", "u\u0308ber.ply", "garden.ply"]  # 8, 8 and 10 columns
    for name in names:
        (tmp_path / name).write_bytes((tmp_path / scenes[1]).read_bytes())
    words = [scenes[0], *(str(tmp_path / name) for name in names), *SMALL, "--lpips", "off"]
    assert main(["evaluate", *words]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if ".ply   " in line]
    assert [row.partition("  200 ")[0].count(" ") for row in rows] == [10, 10, 8]


def test_render_writes_a_png_per_view(scenes, tmp_path, capsys):
    words = ["render", scenes[0], "-o", str(tmp_path / "new"), *SMALL]
    assert main([*words, "--background", "0,0,1"]) == 0
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["0.png", "4.png"], "the cameras that lie beside the scene"
    assert "2 images of 48 x 36 pixels" in capsys.readouterr().out
    assert main(words) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_render_names_images_after_photographs(folder, scenes, tmp_path):
    words = ["--cameras", str(folder), "--views", "3", "--size", "32"]
    assert main(["render", scenes[0], "-o", str(tmp_path), *words]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.png", "3.png", "6.png"]


def test_compare_writes_page_sheet_and_maps(scenes, tmp_path, capsys):
    words = ["compare", *scenes, "-o", str(tmp_path / "page"), *SMALL, "--lpips", "off"]
    assert main(words) == 0
    names = sorted(path.name for path in (tmp_path / "page").iterdir())
    assert names == ["errors.png", "index.html", "sheet.png"]
    assert f"Open {tmp_path / 'page' / 'index.html'} in a browser." in capsys.readouterr().out
    assert "full.ply" in (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert main(words) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0


@pytest.mark.long
def test_evaluate_and_compare_print_the_same_scores(folder, scenes, tmp_path, capsys):
    for number, words in enumerate(([], ["--cameras", str(folder / "transforms.json")])):
        words = [*scenes, *words, "--lpips", "off"]  # noqa: PLW2901
        assert main(["evaluate", *words]) == 0
        evaluated = capsys.readouterr().out
        assert main(["compare", *words, "-o", str(tmp_path / str(number))]) == 0
        assert capsys.readouterr().out.startswith(evaluated)


def test_compare_shows_at_most_eight_cameras(folder, scenes, tmp_path, capsys):
    words = ["--cameras", str(folder / "transforms.json"), "--lpips", "off"]
    assert main(["compare", *scenes[:2], "-o", str(tmp_path), *words]) == 0
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert page.count("images/") == 8


@pytest.fixture
def away(tmp_path):
    """Cameras that look away from the scene."""
    pose = [[1, 0, 0, 0], [0, 1, 0, -1], [0, 0, 1, -5], [0, 0, 0, 1]]
    frames = [{"file_path": f"{n}.png", "transform_matrix": pose} for n in range(2)]
    document = {"w": 64, "h": 48, "fl_x": 60.0, "frames": frames}
    (tmp_path / "away.json").write_text(json.dumps(document))
    return str(tmp_path / "away.json")


def test_images_that_show_nothing_are_a_warning(folder, scenes, away, tmp_path, capsys):
    for cameras, text in (
        (str(folder), ""),
        (away, "warning: no image shows anything of full.ply"),
    ):
        words = ["render", scenes[0], "-o", str(tmp_path / "images"), "--cameras", cameras]
        assert main([*words, "--size", "32", "--overwrite"]) == 0
        assert text in capsys.readouterr().err
        assert not text or len(list((tmp_path / "images").glob("*.png"))) == 9


def test_levels_are_not_made_if_the_cameras_that_score_them_see_nothing(
    scenes, away, tmp_path, capsys
):
    words = ["levels", scenes[0], "-o", str(tmp_path / "out"), "--rho", "0.1", "--cameras", away]
    assert main(words) == 1
    assert "the cameras must see full.ply, found nothing of it" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
