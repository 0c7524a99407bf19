"""Scorers of benchmarks: how they are described, and what commands may print."""

import pytest
import torch

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
