"""What commands report besides their result, so that no option is ignored silently."""

import json
import sys
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.cli.display import TIE, report_notes, say_wrapped
from cvtgs.cli.main import main
from cvtgs.report import MatchReport, SimplifyReport
from scenes import random_scene


@pytest.fixture
def source(tmp_path: Path) -> Path:
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    return tmp_path / "in.ply"


def printed(capsys: pytest.CaptureFixture[str], *words: object, status: int = 0) -> str:
    """Run a command; return what it prints, without line breaks."""
    try:
        found = main([str(word) for word in words])
    except SystemExit as exit_:
        found = exit_.code
    assert found == status
    captured = capsys.readouterr()
    return " ".join((captured.out + captured.err).split())


def simplified(capsys: pytest.CaptureFixture[str], source: Path, *words: object) -> str:
    output = source.with_name("out.ply")
    return printed(capsys, "simplify", source, output, "--preset", "draft", "--overwrite", *words)


def write_cameras(path: Path, count: int = 2) -> Path:
    """Write cameras in front of the scene."""
    frames = [
        {
            "file_path": f"{row}.png",
            "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4 + row / 4], [0, 0, 0, 1]],
        }
        for row in range(count)
    ]
    path.write_text(json.dumps({"w": 48, "h": 36, "fl_x": 40.0, "frames": frames}))
    return path


@pytest.mark.parametrize(
    "command", [["simplify", "{}/in.ply", "{}/out.ply"], ["levels", "{}/in.ply", "-o", "{}/out"]]
)
def test_workers_have_no_effect_on_a_scene_in_one_piece(capsys, source, command):
    words = [word.format(source.parent) for word in command]
    words += ["--rho", "0.1", "--preset", "draft", "--overwrite", "--workers", "2"]
    words += ["--stream", "sog"] if command[0] == "levels" else []
    note = "In one piece: --workers has an effect on blocks only."
    assert note in printed(capsys, *words)
    assert note not in printed(capsys, *words, "--quiet")


def test_memory_has_no_effect_on_formats_that_are_read_whole(capsys, source):
    glb = source.with_name("in.glb")
    cvtgs.save(cvtgs.load(source), glb)
    assert "In one piece: --memory" in simplified(capsys, glb, "--rho", "0.1", "--memory", "4GB")
    assert "In one piece" not in simplified(capsys, source, "--rho", "0.1", "--memory", "4GB")


@pytest.mark.parametrize("words", [["--max-count", "1M"], ["--rho", "1"]])
def test_a_whole_scene_is_copied_whatever_the_memory(capsys, source, monkeypatch, words):
    monkeypatch.setattr("cvtgs.outofcore.memory.BASE_BYTES", 10)
    monkeypatch.setattr("cvtgs.outofcore.memory.LEAST_BYTES", 20)
    text = simplified(capsys, source, *words, "--memory", "20kB", "--workers", "1")
    assert "In one piece: --workers" in text
    assert source.with_name("out.ply").read_bytes() == source.read_bytes()


def test_the_number_of_kept_gaussians_is_printed(capsys, source):
    boxes = source.with_name("boxes.json")
    boxes.write_text('{"min": [1e5, 1e5, 1e5], "max": [2e5, 2e5, 2e5]}')
    words = ["--rho", "0.9", "--keep", boxes]
    command = ["simplify", source, source.with_name("out.ply"), *words, "--quiet", "--overwrite"]
    assert main(list(map(str, command))) == 0
    warned = f"cvtgs: warning: {boxes}: no Gaussian is in the boxes of --keep, so none is protected"
    assert capsys.readouterr().err == f"{warned}.\n"
    boxes.write_text('{"min": [0, -1e9, -1e9], "max": [1e9, 1e9, 1e9]}')
    kept = int((cvtgs.load(source).means[:, 0] >= 0).sum())
    assert f"{kept} Gaussians in the boxes of --keep." in simplified(capsys, source, *words)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "axes"),
    [(".ply", ()), (".compressed.ply", ()), (".spz", ()), (".spz", ("--axes", "rdf:rub"))],
)
def test_a_target_is_measured_in_the_file_over_the_given_cameras(capsys, source, suffix, axes):
    """All but plain PLY files round."""
    cameras, output = write_cameras(source.with_name("views.json")), source.with_name(f"o{suffix}")
    words = ["--preset", "draft", "--target-psnr", "12", "--cameras", cameras, *axes]
    text = printed(capsys, "simplify", source, output, *words)
    assert "over the given cameras; found in" in text
    assert "Seconds of all tries: check" in text
    small = cvtgs.load(output, axes="rub" if axes else None)
    settings = cvtgs.evaluation.EvaluationSettings(lpips="off")
    views = cvtgs.load_cameras(cameras)
    found = cvtgs.evaluate(source, {"small": small}, views, settings=settings).scenes[0]
    assert f"PSNR {found.psnr.mean:.2f} dB" in text
    assert found.psnr.mean >= 12


def test_a_target_out_of_reach_of_the_format_says_so(capsys, source):
    cameras = write_cameras(source.with_name("views.json"))
    words = ["--target-psnr", "60", "--cameras", cameras, "--preset", "draft"]
    text = printed(capsys, "simplify", source, source.with_name("o.splat"), *words, status=1)
    assert "These are scores of files of this format, which rounds; a plain .ply does not." in text
    text = printed(capsys, "simplify", source, source.with_name("o.ply"), *words, status=1)
    assert "no simplified scene reaches 60.00 dB" in text
    assert "These are scores" not in text


@pytest.mark.parametrize(
    ("views", "heldout", "blocks", "where"),
    [
        (4, 4, 1, ": +0.50 dB on the same images."),
        (8, 1, 1, ": +0.50 dB on 1 held-out image."),
        (32, 4, 1, ": +0.50 dB on 4 held-out images."),
        (13, 6, 2, " in all blocks together: +0.50 dB on average."),  # 8 and 5: 1 and all
    ],
)
def test_the_images_that_a_matching_is_scored_on_are_named(views, heldout, blocks, where):
    matched = MatchReport(
        views=views,
        heldout=heldout,
        opacities_kept=True,
        psnr_before=20.0,
        psnr_after=20.5,
        backend="numba",
    )
    report = SimplifyReport(
        input_count=10,
        output_count=1,
        target_count=1,
        rho=0.1,
        matching=matched,
        blocks=blocks,
        config=cvtgs.SimplifyConfig(),
    )
    assert f"Matched to {views} images of the scene{where}" in report_notes(report)


def test_settings_that_are_not_used_are_mentioned(capsys, source):
    words = ["--rho", "0.1", "--set", "visibility.size=64", "--set", "refine.size=64"]
    text = simplified(capsys, source, *words, "--set", "seed=1")
    assert "--set visibility.size refine.size had no effect: draft uses no such images." in text
    words += ["--set", "visibility.views=2", "--set", "refine.steps=0"]
    text = simplified(capsys, source, *words, "--overwrite")
    assert "--set refine.size had no effect" in text


def test_images_that_nothing_needs_are_mentioned(capsys, source):
    text = simplified(capsys, source, "--rho", "1", "--preset", "matched", "--overwrite")
    assert "No images were rendered, since no Gaussians had to merge." in text


def test_cameras_that_are_not_used_are_mentioned(capsys, source):
    cameras = write_cameras(source.with_name("views.json"))
    text = simplified(capsys, source, "--rho", "0.1", "--cameras", cameras)
    assert "--cameras was not used: draft renders no images." in text
    words = ("levels", source, "--preset", "draft", "--rho", "0.1", "--cameras", cameras)
    for name, more in (("plain", ["--no-scores"]), ("stream", ["--stream", "sog"])):
        text = printed(capsys, *words, "-o", source.with_name(name), *more)
        assert text.startswith("--cameras is not used: draft renders no images.")
    text = printed(capsys, *words, "-o", source.with_name("scored"), "--size", "48")
    assert "--cameras" not in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--refine", "1e-6"], "Not refined: rendering 8 held-out images first took "),
        (["--refine-steps", "1", "--set", "refine.rates.means=90"], "Not refined: none of 1 step"),
    ],
)
def test_a_refinement_without_effect_says_why(capsys, source, words, text):
    assert text in simplified(capsys, source, "--rho", "0.9", "--set", "refine.size=48", *words)


def test_a_folder_that_does_not_exist_is_not_skipped_by_dots(capsys, source):
    output = source.parent / "missing" / ".." / "out.ply"
    text = printed(capsys, "convert", source, output, status=1)
    assert "the output must be in an existing directory" in text
    assert not source.with_name("out.ply").exists()


def test_a_value_with_a_minus_gets_a_hint_or_is_taken(capsys, source):
    words = ["convert", source, source.with_name("out.ply"), "--translate", "-1,0,0"]
    if sys.version_info >= (3, 14):  # argparse takes it
        printed(capsys, *words)
        moved, still = cvtgs.load(source.with_name("out.ply")).means, cvtgs.load(source).means
        assert torch.equal(moved, still - torch.tensor([1.0, 0.0, 0.0]))
        return
    assert "with a minus sign, write --translate=-1,0,0" in printed(capsys, *words, status=2)


@pytest.mark.parametrize(
    ("value", "hint"),
    [("-small.ply", "; with a minus sign, write --suffix=-small.ply"), ("-o", "")],
)
def test_a_suffix_with_a_minus_gets_a_hint(capsys, source, value, hint):
    words = ["convert", source, "-o", source.parent / "out", "--suffix", value]
    text = printed(capsys, *words, status=2)
    assert text.endswith(f"argument --suffix: expected one argument{hint}")


@pytest.mark.parametrize(
    ("option", "hint"),
    [("--rho", "options come after the command"), ("--versoin", "did you mean --version?")],
)
def test_unknown_options_before_the_command_get_a_hint(capsys, source, option, hint):
    text = printed(capsys, option, "0.1", "simplify", source, "out.ply", status=2)
    assert text.endswith(f"cvtgs: error: unrecognized argument: {option}; {hint}")


def test_columns_that_a_merge_leaves_out_are_listed_as_lost(capsys, source):
    scene = cvtgs.load(source)
    more = scene.with_tensors({}, {"heat": torch.zeros(300), "id": torch.zeros(300)})
    cvtgs.save(more, source.with_name("more.ply"))
    words = ["convert", source.with_name("more.ply"), source.with_name("out.ply")]
    text = printed(capsys, *words, "--merge", source)
    assert "Lost: columns that not all scenes have (heat, id)." in text


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "text"),
    [
        (2, "Fitted to cameras beside in.ply, which favours them if these score: matched."),
        (32, "Fitted to the training cameras beside in.ply: matched."),
    ],
)
def test_presets_that_were_fitted_to_cameras_are_named(capsys, source, count, text):
    write_cameras(source.with_name("transforms.json"), count)
    words = ["tradeoff", source, "-o", source.with_name("t"), "--presets", "draft,matched"]
    words += ["--rho", "0.3", "--size", "48", "--lpips", "off"]
    assert text in printed(capsys, *words)
    found = json.loads((source.with_name("t") / "tradeoff.json").read_text())
    assert found["held_out"] == (count == 32)
    views = found["evaluation"]["views"]
    fitted = found["results"][1]["report"]["views"]
    if count == 32:
        assert views == ["0.png", "16.png", "23.png", "30.png"], "every eighth by name"
        assert fitted == "28 cameras"
    else:
        assert (views, fitted) == (["0.png", "1.png"], "2 cameras")


@pytest.mark.long
def test_given_cameras_that_presets_are_fitted_to_are_mentioned(capsys, source):
    """They are those beside the scene, but not only of their test split."""
    cameras = write_cameras(source.with_name("transforms.json"), 32)
    words = ["tradeoff", source, "-o", source.with_name("t"), "--rho", "0.3", "--size", "48"]
    words += ["--lpips", "off", "--overwrite", "--cameras", cameras]
    for presets, split, shared in (
        ("draft,matched", [], "6 of the 8 views"),
        ("draft,matched", ["--split", "test"], ""),
        ("draft", [], ""),
    ):
        assert main([*map(str, words), "--presets", presets, *split]) == 0
        text = " ".join(capsys.readouterr().err.split())
        wanted = (
            f"cvtgs: warning: presets that use images are fitted to {shared} that score, which "
            f"favours them; the test split of {cameras.parent} has other views."
        )
        assert (wanted in text) == bool(shared)
        assert ("presets that use images" in text) == bool(shared)
        found = json.loads((source.with_name("t") / "tradeoff.json").read_text())
        assert found["held_out"] == bool(split)


def test_one_gaussian_is_no_plural(capsys, source):
    one, again = source.with_name("one.ply"), source.with_name("again.ply")
    for path in (one, again):
        cvtgs.save(random_scene(1), path)
    views = ["--views", "1", "--size", "16"]
    text = printed(capsys, "evaluate", one, again, *views)
    assert "against one.ply, 1 Gaussian: " in text
    text = printed(capsys, "levels", one, "-o", source.with_name("levels"), *views, "--rho", "1")
    assert text.startswith("1 view of 16 x 12 pixels, rendered by ")
    assert " one.ply, 1 Gaussian: " in text


def test_dropped_rows_are_counted_with_separators(capsys, source):
    scene = random_scene(1200)
    scene.means[:1100] = torch.nan
    cvtgs.save(scene, source, overwrite=True)
    text = simplified(capsys, source, "--rho", "0.5")
    assert (
        "dropped 1,100 of 1,200 Gaussians with NaN, infinite or zero values (means 1,100)" in text
    )
    assert "Fewer than the requested 600: only 100 of 1,200 Gaussians are valid." in text


@pytest.mark.parametrize(("name", "is_said"), [("a.ply", False), ("a.sog", True), ("a.spz", True)])
def test_formats_that_change_protected_gaussians_are_mentioned(
    capsys: pytest.CaptureFixture[str], source: Path, name: str, is_said: bool
) -> None:
    box = source.with_name("box.json")
    box.write_text('{"min": [0, -9, -9], "max": [9, 9, 9]}')
    words = ["--rho", "0.8", "--preset", "draft", "--keep", box]
    said = printed(capsys, "simplify", source, source.with_name(name), *words)
    assert "in the boxes of --keep" in said
    assert ("Only a plain .ply has them first" in said) == is_said


def test_words_that_stay_together_have_an_ordinary_space(
    capsys: pytest.CaptureFixture[str],
) -> None:
    say_wrapped(f"{'x' * 76} 12{TIE}s")
    assert capsys.readouterr().out == f"{'x' * 76}\n  12 s\n"
