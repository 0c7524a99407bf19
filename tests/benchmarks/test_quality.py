"""Scorers of benchmarks: how they are described, and what commands may print."""

import sys

import pytest
import torch

import cvtgs
import lpips_cases
from benchmarks import quality
from benchmarks.measuring import digest_of


def test_the_judge_is_described(tmp_path):
    file = tmp_path / "thing.ply"

    def described(*arguments: str) -> str:
        options = quality.scoring_parser("").parse_args([str(file), *arguments])
        return quality.judge_of(options, options.files)

    assert described("--size", "64").endswith("8 automatic views of 64 x 64 pixels, over black")
    assert described("--cameras", "a", "--split", "test").endswith(
        "cameras of a (test), over black"
    )
    file.with_suffix(".cameras.json").touch()
    assert described("--size", "64").endswith("cameras beside the scenes at 64 pixels, over black")


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_the_judge_has_the_network_of_lpips_and_its_weights(tmp_path, network):
    path = tmp_path / "weights.pth"
    torch.save(dict(lpips_cases.random_state(network)), path)
    options = quality.scoring_parser("").parse_args(["--lpips", str(path)])
    text = f"over black, LPIPS of {network} ({digest_of(path)[:12]})"
    assert quality.judge_of(options, []).endswith(text)


def scorer_of(tmp_path, printed: str):
    (tmp_path / "judge.py").write_text(printed)
    return quality.command_scorer(f"{sys.executable} {tmp_path / 'judge.py'} '{{print}}' {{small}}")


def test_a_command_gets_files_and_other_braces_stay(tmp_path):
    printed = "import json, sys; print(json.dumps([{'psnr': len(sys.argv), 'ssim': 1}] * 2))"
    printed += "; assert sys.argv[1] == '{print}'"
    scene = cvtgs.synthetic.scene("object", 20, sh_degree=0, seed=0)
    found = scorer_of(tmp_path, printed)(scene, [scene, scene])
    assert found == [quality.Quality(psnr=4, ssim=1)] * 2


@pytest.mark.parametrize(
    ("printed", "text"),
    [
        ("print('[]')", r"a JSON list of 1 objects with psnr and ssim; found '\[\]'\."),
        ("print('PSNR 20')", "found 'PSNR 20'"),
        ("print('[{\"psnr\": 20}]')", "objects with psnr and ssim"),
        ("print(7)", "found '7'"),
        ("raise SystemExit('no GPU')", "failed: no GPU"),
    ],
)
def test_commands_that_do_not_score_end_in_one_sentence(tmp_path, printed, text):
    scene = cvtgs.synthetic.scene("object", 20, sh_degree=0, seed=0)
    with pytest.raises(SystemExit, match=text):
        scorer_of(tmp_path, printed)(scene, [scene])


def test_a_missing_command_ends_in_one_sentence():
    scene = cvtgs.synthetic.scene("object", 20, sh_degree=0, seed=0)
    with pytest.raises(SystemExit, match="could not be started"):
        quality.command_scorer("/no/such/scorer {full} {small}")(scene, [scene])


def test_a_setting_without_a_value_is_refused():
    options = quality.scoring_parser("").parse_args(["--set", "foo"])
    with pytest.raises(SystemExit, match=r"a setting must be KEY=VALUE; found 'foo'\."):
        quality.configuration(options, {})
