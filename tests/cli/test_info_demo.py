"""``cvtgs info`` and ``cvtgs demo``."""

from dataclasses import replace

import pytest
import torch

import cvtgs
from cvtgs.cli import demo
from cvtgs.cli.main import main
from cvtgs.mergenet import (
    Architecture,
    CheckpointInfo,
    LearnedScene,
    MergeNet,
    encode_checkpoint,
    load_checkpoint,
)


def test_info_prints_counts_and_statistics(tmp_path, capsys):
    path = tmp_path / "in.ply"
    scene = cvtgs.synthetic.scene("landscape", 2000, sh_degree=2, seed=0)
    cvtgs.save(scene, path)
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr().out
    for text in ("Gaussians        2,000", "SH degree        2", "robust radius", "opacity < 0.1"):
        assert text in printed


@pytest.mark.parametrize(
    ("comments", "words"),
    [
        (("by hand",), "none"),
        (("SplatRenderMode: mip",), "anti-aliased (mip)"),
        (("SplatRenderMode: 2dgs", "by hand"), "flat (2dgs)"),
    ],
)
def test_info_names_the_tags(tmp_path, capsys, comments, words):
    scene = cvtgs.synthetic.scene("object", 50, sh_degree=0, seed=0)
    cvtgs.save(replace(scene, comments=comments), tmp_path / "in.ply")
    assert main(["info", str(tmp_path / "in.ply")]) == 0
    assert f"tags             {words}" in capsys.readouterr().out.splitlines()


def test_info_names_the_file_of_a_folder(tmp_path, capsys):
    scene = cvtgs.synthetic.scene("object", 50, sh_degree=0, seed=0)
    for number in (7000, 30000):
        folder = tmp_path / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        cvtgs.save(scene, folder / "point_cloud.ply")
    assert main(["info", str(tmp_path)]) == 0
    assert f"{folder / 'point_cloud.ply'}, " in capsys.readouterr().out.splitlines()[0]


def test_info_as_json_equals_describe(tmp_path, capsys):
    path = tmp_path / "in.ply"
    scene = cvtgs.synthetic.scene("room", 300, sh_degree=0, seed=0)
    cvtgs.save(scene, path)
    assert main(["info", str(path), "--json"]) == 0
    facts = cvtgs.SceneInfo.model_validate_json(capsys.readouterr().out)
    assert facts == cvtgs.describe(cvtgs.load(path))


def test_info_shows_how_a_checkpoint_was_trained(tmp_path, capsys):
    path = tmp_path / "net.safetensors"
    scenes = (
        LearnedScene(name="yard", count=1500, sha256="ab" * 32),
        LearnedScene(name="generated-room-3", count=20_000, is_validation=True),
    )
    info = CheckpointInfo(
        architecture=Architecture(), preset="standard", training="a test", seed=7, steps=1200,
        version="0.2", config='{"seed":7}', start="cd" * 32, scenes=scenes,
    )  # fmt: skip
    path.write_bytes(encode_checkpoint(MergeNet(info.architecture), info))
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr().out.splitlines()
    for line in (
        "preset           standard",
        "seed, steps      7, 1,200",
        f"started from     {'cd' * 32}",
        'configuration    {"seed":7}',
        f"trained on       yard, 1,500, {'ab' * 32}",
        "validated on     generated-room-3, 20,000, generated",
    ):
        assert line in printed
    assert main(["info", str(path), "--json"]) == 0
    assert CheckpointInfo.model_validate_json(capsys.readouterr().out) == info


def test_info_of_a_shipped_checkpoint_and_of_a_damaged_one(tmp_path, capsys):
    assert main(["info", "standard"]) == 0
    digest = load_checkpoint("standard").digest
    assert f"digest           {digest}" in capsys.readouterr().out.splitlines()
    (tmp_path / "bad.safetensors").write_bytes(b"nothing")
    assert main(["info", str(tmp_path / "bad.safetensors")]) == 1
    assert "not a safetensors file, or it is damaged" in capsys.readouterr().err


@pytest.mark.slow
def test_demo_writes_three_scenes_and_a_page_and_prints_next_steps(tmp_path, capsys, monkeypatch):
    for name, value in (("VIEWS", 2), ("WIDTH", 64), ("HEIGHT", 48)):
        monkeypatch.setattr(demo, name, value)
    folder = tmp_path / "demo"
    words = ["demo", "-o", str(folder), "--count", "3k"]
    assert main(words) == 0
    counts = {path.name: len(cvtgs.load(path)) for path in folder.glob("*.ply")}
    assert counts == {
        "full.ply": 3000,
        "small_0.1.ply": 300,
        "small_0.01.ply": 30,
    }
    pages = sorted(path.name for path in folder.iterdir() if path.suffix != ".ply")
    assert pages == ["errors.png", "index.html", "sheet.png"]
    printed = capsys.readouterr().out
    page = (folder / "index.html").resolve().as_uri()
    for text in ("small_0.01.ply", "tessellate", "PSNR", "cvtgs simplify scene.ply", page):
        assert text in printed
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_demo_refuses_a_folder_that_cannot_be_created(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["demo", "-o", str(tmp_path / "file" / "demo"), "--count", "10"]) == 1
    assert "must be a folder or a new path" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["index.html", "sheet.png", "errors.png", "small_0.1.ply"])
def test_demo_replaces_only_files_of_an_earlier_demo(tmp_path, capsys, name):
    (tmp_path / name).write_text("mine")
    assert main(["demo", "-o", str(tmp_path), "--count", "50"]) == 1
    assert f"a new folder or that of an earlier demo, found {name}" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_info_tells_coordinates_far_from_the_origin_apart(tmp_path, capsys):
    scene = cvtgs.synthetic.scene("object", 500, seed=0)
    double = {name: tensor.double() for name, tensor in scene.tensors().items()}
    means = double.pop("means") + torch.tensor([5e6, 0.0, -3e5])
    cvtgs.save(scene.with_tensors(means=means, **double), tmp_path / "map.ply")
    assert main(["info", str(tmp_path / "map.ply")]) == 0
    text = capsys.readouterr().out.split("bounds")[1].splitlines()[0]
    low, high = (list(map(float, part.strip(" ()").split(","))) for part in text.split(" to "))
    for found, wanted in ((low, means.amin(dim=0)), (high, means.amax(dim=0))):
        assert found == pytest.approx(wanted.tolist(), abs=0.002)


def test_demo_keeps_a_generated_scene_of_the_user(tmp_path, capsys):
    mine = cvtgs.synthetic.scene("landscape", 50, seed=9)
    cvtgs.save(mine, tmp_path / "full.ply")
    assert main(["demo", "-o", str(tmp_path), "--count", "50"]) == 1
    assert "earlier demo, found full.ply" in capsys.readouterr().err
    assert len(cvtgs.load(tmp_path / "full.ply")) == 50


@pytest.mark.parametrize("words", [["--effects", "sh=1"], ["--lod", "0"]])
def test_options_of_scenes_are_no_matter_of_checkpoints(capsys, words):
    assert main(["info", "standard", *words]) == 1
    assert f"{words[0]} applies to scenes" in capsys.readouterr().err
