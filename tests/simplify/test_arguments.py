"""Wrong arguments of Simplifier: the error names the right one."""

from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier
from cvtgs.errors import CheckpointError, ConfigError, InputNotFoundError, InvalidArgumentError
from scenes import random_scene, same_bits


def test_a_preset_by_its_name():
    fast = Simplifier(preset="fast", device="cpu")
    assert fast.config.preset == "fast"
    scene = random_scene(300)
    other = Simplifier(config="fast", device="cpu")
    assert same_bits(fast.simplify(scene, 0.1), other.simplify(scene, 0.1))
    with pytest.raises(InvalidArgumentError, match="either preset or config, found both"):
        Simplifier(preset="fast", config="fast")


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


def test_a_preset_in_the_place_of_the_checkpoint():
    with pytest.raises(CheckpointError, match="For the preset, write preset='fast'"):
        Simplifier("fast")


@pytest.mark.parametrize("path", ["scene.ply", Path("scene.ply")])
def test_a_path_in_the_place_of_the_scene(path):
    text = r"scene must be a GaussianScene, found the path 'scene.ply'; read it with cvtgs.load"
    with pytest.raises(InvalidArgumentError, match=text):
        Simplifier(device="cpu").simplify(path, 0.1)
    with pytest.raises(InvalidArgumentError, match="found int"):
        Simplifier(device="cpu").levels(3, [0.1])
