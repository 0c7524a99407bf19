"""Gaussians with two scales (2DGS), in files that keep three: the tag 2dgs of splat-transform."""

from dataclasses import replace
from pathlib import Path

import pytest

from cvtgs import GaussianScene, Simplifier, SimplifyConfig, load, save
from cvtgs.edit import merge
from cvtgs.errors import DroppedDataWarning
from cvtgs.scene import FLAT_LOG_SCALE
from cvtgs.tags import TWO_SCALES
from scenes import random_scene


def surfels(count: int = 300) -> GaussianScene:
    """Return a scene as read from a PLY without a third scale."""
    scene = random_scene(count)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = FLAT_LOG_SCALE
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    layout = [(name, "float") for name in [*names, *(f"rot_{i}" for i in range(4))]]
    tensors = {"log_scales": log_scales, "shN": scene.shN[:, :0]}
    return replace(scene.with_tensors(tensors, {}), layout=tuple(layout))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".glb", ".gltf"])
def test_merged_gaussians_of_any_format_are_flat(tmp_path: Path, suffix: str) -> None:
    save(surfels(), tmp_path / f"flat{suffix}")
    scene = load(tmp_path / f"flat{suffix}")
    assert scene.has_two_scales
    small = Simplifier(device="cpu").simplify(scene, 0.1)
    save(small, tmp_path / f"small{suffix}")
    again = load(tmp_path / f"small{suffix}")
    assert again.has_two_scales
    assert float(again.log_scales[:, 2].amax()) <= FLAT_LOG_SCALE + 1e-4


@pytest.mark.parametrize("suffix", [".spz", ".splat"])
def test_formats_without_the_tag_warn(tmp_path: Path, suffix: str) -> None:
    with pytest.warns(DroppedDataWarning, match="the tag 'SplatRenderMode: 2dgs', without which"):
        save(surfels(), tmp_path / f"flat{suffix}")


def test_thick_gaussians_have_no_tag() -> None:
    """Other tools draw all Gaussians of a file with the tag as flat."""
    tagged = replace(surfels(), comments=(TWO_SCALES.text, "mine"), layout=())
    both = merge([tagged, random_scene(5)])
    assert both.comments == ("mine",)
    assert merge([tagged, tagged]).has_two_scales
    config = SimplifyConfig.from_mapping({"effects": {"flat": "off"}})
    thick = Simplifier(config=config, device="cpu").simplify(tagged, 0.1)
    assert thick.comments == ("mine",)
    assert float(thick.log_scales[:, 2].amax()) > FLAT_LOG_SCALE + 1
