"""Gaussians with two scales (2DGS), in files that keep three: the tag 2dgs of splat-transform."""

import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cvtgs import Simplifier, SimplifyConfig, concatenate, load, save
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.scene import FLAT_LOG_SCALE
from cvtgs.streams import plan_stream, write_sog_stream, write_tiles
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from hard_cases import flat_file
from scenes import random_scene


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".glb", ".gltf"])
def test_merged_gaussians_of_any_format_are_flat(tmp_path: Path, suffix: str) -> None:
    save(flat_file(300, torch.float32), tmp_path / f"flat{suffix}")
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
        save(flat_file(300, torch.float32), tmp_path / f"flat{suffix}")


def test_a_sog_with_the_tag_mip_has_no_other(tmp_path: Path) -> None:
    flat, path = flat_file(300, torch.float32), tmp_path / "both.sog"
    both = replace(flat, comments=(ANTIALIASED.text, TWO_SCALES.text))
    with pytest.warns(DroppedDataWarning, match="the tag 'SplatRenderMode: 2dgs', without which"):
        save(both, path)
    assert load(path).comments == (ANTIALIASED.text,)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["meta.json"] = files["meta.json"].replace(b'"antialiased"', b'"2dgs"')
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    assert load(tmp_path / "meta.json").comments == (ANTIALIASED.text, TWO_SCALES.text)


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
def test_streams_of_flat_gaussians_have_the_tag(tmp_path: Path) -> None:
    levels = Simplifier(device="cpu").levels(flat_file(300, torch.float32), [0.5, 0.1])
    write_tiles(plan_stream(levels), tmp_path / "tiles")
    write_sog_stream(plan_stream(levels), tmp_path / "sog")
    tiles = sorted((tmp_path / "tiles").glob("*.glb"))
    assert len(tiles) == 2
    assert all(load(path).has_two_scales for path in [*tiles, tmp_path / "sog"])


def test_thick_gaussians_have_no_tag() -> None:
    """Other tools draw all Gaussians of a file with the tag as flat."""
    tagged = replace(flat_file(300, torch.float32), comments=(TWO_SCALES.text, "mine"), layout=())
    both = concatenate([tagged, random_scene(5)], fill=True)
    assert both.comments == ("mine",)
    assert concatenate([tagged, tagged], fill=True).has_two_scales
    flat = replace(flat_file(300, torch.float32), comments=("mine",))
    assert concatenate([flat, flat], fill=True).comments == ("mine",)  # its layout says so
    other = replace(flat, layout=flat.layout[::-1])
    assert concatenate([flat, other], fill=True).comments == ("mine", TWO_SCALES.text)
    config = SimplifyConfig.from_mapping({"effects": {"flat": "off"}})
    thick = Simplifier(config=config, device="cpu").simplify(tagged, 0.1)
    assert thick.comments == ("mine",)
    assert float(thick.log_scales[:, 2].amax()) > FLAT_LOG_SCALE + 1


def test_scenes_of_two_and_of_three_scales_are_only_concatenated_if_filled() -> None:
    """Joined, the thick ones would become flat in a file without a third scale."""
    flat = flat_file(30, torch.float32)
    thick = random_scene(20, degree=flat.sh_degree)
    for scenes in ([flat, thick], [thick, flat]):
        with pytest.raises(
            InvalidSceneError, match="scenes to concatenate must be alike, or filled"
        ):
            concatenate(scenes)
        merged = concatenate(scenes, fill=True)
        assert not merged.has_two_scales
        assert len(merged) == 50
