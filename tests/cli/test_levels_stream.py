"""``cvtgs levels --stream``."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs import load, save, synthetic
from cvtgs.cli.main import main
from cvtgs.streams.files import INDEX_NAMES
from scenes import random_scene


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    save(random_scene(2000, degree=0), tmp_path / "a.ply")
    folder = str(tmp_path / "out")
    return ["levels", str(tmp_path / "a.ply"), "-o", folder, "--ckpt", "none", "--preset", "draft"]


@pytest.mark.parametrize("kind", ["sog", "3dtiles"])
def test_a_stream_holds_every_level(
    tmp_path: Path, words: list[str], kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--stream", kind, "--chunk", "300", "--rho", "1,0.1,0.01"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("a.ply in ")
    assert "chunks, the finest level first:" in lines[0]
    assert lines[2].split()[0] == "2,000"
    if kind == "sog":
        counts = [len(load(tmp_path / "out", lod=lod)) for lod in range(3)]
        assert counts == [2000, 200, 20]
    else:
        assert len(load(tmp_path / "out" / "0_0.glb")) == 20


def test_a_small_stream_is_one_chunk(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--stream", "3dtiles", "--rho", "0.1,0.01"]) == 0
    assert capsys.readouterr().out.startswith("a.ply in one chunk, the finest level first:")


@pytest.mark.parametrize(("radii", "has_one"), [("0.5", True), ("1000", False)])
def test_an_environment_is_mentioned_only_if_there_is_one(
    words: list[str], radii: str, has_one: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--stream", "sog", "--rho", "0.1", "--environment", radii]) == 0
    assert ("Not counted: the environment" in capsys.readouterr().out) == has_one


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--stream", "sog", "--suffix", ".spz"], "--suffix cannot be used with --stream"),
        (["--stream", "sog", "--views", "4"], "--views cannot be used with --stream"),
        (["--stream", "sog", "--no-scores"], "--no-scores cannot be used with --stream"),
        (["--chunk", "300"], "--chunk needs --stream."),
        (
            ["--stream", "3dtiles", "--environment", "9"],
            "--environment needs --stream sog, found 3dtiles.",
        ),
        (["--stream", "sog", "--environment", "-1"], "--environment must be above 0"),
        (["--stream", "sog", "--environment", "inf"], "--environment must be above 0"),
        (["--memory", "2GB"], "--memory needs --stream."),
        (["--transform", "1"], "--transform needs --stream 3dtiles."),
        (["--stream", "sog", "--place", "8,47"], "--place needs --stream 3dtiles, found sog."),
        (
            ["--stream", "3dtiles", "--place", "8"],
            "--place must be 2 or 3 numbers separated by commas",
        ),
        (["--stream", "3dtiles", "--place", "8,97"], "--place: a place on Earth needs"),
        (["--stream", "3dtiles", "--transform", "1,2"], "--transform must be 16 numbers"),
        (
            ["--stream", "3dtiles", "--axes", "rub:rub"],
            "--axes IN:OUT cannot be used with --stream",
        ),
        (["--stream", "3dtiles", "--workers", "0"], "--workers must be at least 1"),
        (["--stream", "sog", "--chunk", "0"], "--chunk must be at least 1, found 0."),
    ],
)
def test_invalid_options_are_refused_before_the_work(
    tmp_path: Path,
    words: list[str],
    more: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*words, *more]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_large_scene_is_streamed_in_blocks(
    tmp_path: Path,
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda *_, **__: 2)
    more = ["--stream", "3dtiles", "--workers", "1", "--rho", "1,0.1", "--place", "8.5,47.4"]
    assert main([*words, *more]) == 0
    first, _, finest, coarsest = capsys.readouterr().out.splitlines()
    assert first == "a.ply in 2 chunks and 2 blocks, the finest level first:"
    assert (finest.split()[0], coarsest.split()[0]) == ("2,000", "200")
    document = json.loads((tmp_path / "out" / "tileset.json").read_text())
    assert document["root"]["transform"][12:15] == pytest.approx((4276e3, 639e3, 4672e3), abs=2e3)


@pytest.mark.long
def test_the_suffix_of_a_scene_in_blocks_may_be_in_capitals(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.ply").rename(tmp_path / "A.PLY")
    words = [word.replace("a.ply", "A.PLY") for word in words]
    more = ["--stream", "sog", "--memory", "1GB", "--preset", "matched", "--rho", "0.1"]
    assert main([*words, *more]) == 0
    assert "In one piece" not in capsys.readouterr().out


def first_bytes(folder: Path) -> int:
    """Return the bytes that a viewer must fetch to show the whole scene at its coarsest level."""

    def files_of(node: dict[str, Any]) -> set[str]:
        if "content" in node:
            return {node["content"]["uri"]}
        if "lods" in node:
            place = node["lods"][max(node["lods"], key=int)]
            return {str(Path(index["filenames"][place["file"]]).parent)}
        return set[str]().union(*map(files_of, node["children"]))

    path = next(folder.glob("*.json"))
    index = json.loads(path.read_text())
    places = [folder / name for name in files_of(index.get("tree") or index["root"])]
    files = [file for place in places for file in ([place] if place.is_file() else place.iterdir())]
    return sum(file.stat().st_size for file in [path, *files])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sog", "3dtiles"])
def test_the_first_image_needs_a_twentieth_of_the_bytes(tmp_path: Path, kind: str) -> None:
    source, out = tmp_path / "a.ply", tmp_path / "out"
    save(synthetic.scene("courtyard", 20_000, sh_degree=1, seed=1), source)
    words = ["levels", str(source), "-o", str(out), "--preset", "draft", "--quiet"]
    assert main([*words, "--stream", kind, "--chunk", "2000"]) == 0
    total = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    assert 0 < first_bytes(out) <= 0.05 * total


@pytest.mark.parametrize("given", [["--no-scores"], ["--stream", "sog"]])
@pytest.mark.parametrize("words", [["--views", "3"], ["--background", "white"]])
def test_options_of_scores_need_scores(tmp_path, capsys, given, words):
    line = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "out"), *given, *words]
    assert main(line) == 1
    assert f"{words[0]} cannot be used with {given[0]}" in capsys.readouterr().err


def test_an_unknown_suffix_of_levels_is_named(tmp_path, capsys):
    line = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "out"), "--suffix", "xyz"]
    assert main(line) == 1
    assert "--suffix must end in .compressed.ply, " in capsys.readouterr().err


def test_cameras_beside_the_scene_are_read_only_if_levels_use_images(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "transforms.json").write_text("{")
    assert main([*words, "--rho", "0.1", "--no-scores"]) == 0
    assert "cameras are not used" not in capsys.readouterr().err
    scored = ["--rho", "0.1", "--overwrite", "--views", "1", "--size", "32"]
    assert main([*words, *scored]) == 0
    assert capsys.readouterr().err.count("cameras are not used") == 1


@pytest.mark.long
def test_levels_fitted_to_cameras_that_score_are_mentioned(tmp_path, capsys):
    save(random_scene(200), tmp_path / "a.ply")
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    frames = [{"file_path": f"{row}.png", "transform_matrix": pose} for row in range(9)]
    cameras = tmp_path / "transforms.json"
    cameras.write_text(json.dumps({"w": 48, "h": 36, "fl_x": 40.0, "frames": frames}))
    words = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "levels"), "--rho", "0.1"]
    words += ["--overwrite", "--views", "1", "--size", "32"]
    given, split = ["--cameras", str(cameras)], ["--split", "test"]
    for preset, more, is_mentioned in (
        ("matched", [], True),
        ("matched", ["--axes", "rdf"], True),
        ("matched", given, True),
        ("matched", [*given, *split], False),
        ("matched", [*given, "--split", "train"], True),
        ("draft", given, False),
    ):
        assert main([*words, "--preset", preset, *more]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert ("Levels were fitted to cameras of which some score" in printed) == is_mentioned


def test_levels_need_a_folder_to_write_to(tmp_path, capsys):
    save(random_scene(30), tmp_path / "a.ply")
    (tmp_path / "note").touch()
    assert main(["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "note")]) == 1
    assert "note: must be a folder or a new path, found: file exists" in capsys.readouterr().err


def test_a_level_does_not_replace_its_scene(tmp_path, capsys):
    path = tmp_path / "rho_0.5.ply"
    save(random_scene(30), path)
    line = ["levels", str(path), "-o", str(tmp_path), "--rho", "0.5", "--overwrite"]
    assert main(line) == 1
    assert "rho_0.5.ply: a level must not replace the scene; choose another" in (
        capsys.readouterr().err
    )
    assert len(load(path)) == 30
    assert [one.name for one in tmp_path.iterdir()] == ["rho_0.5.ply"]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "chunk"), [("sog", "0_0_0"), ("3dtiles", "0_0.glb")])
def test_a_stream_does_not_replace_its_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, chunk: str
) -> None:
    path, out = tmp_path / "a.ply", tmp_path / "out"
    save(random_scene(300), path)
    words = ["-o", str(out), "--stream", kind, "--preset", "draft", "--rho", "1,0.1"]
    assert main(["levels", str(path), *words]) == 0
    before = {one: one.read_bytes() for one in out.rglob("*") if one.is_file()}
    sources = [out / chunk, out] if kind == "sog" else [out / chunk]
    for source in sources:
        assert main(["levels", str(source), *words, "--overwrite"]) == 1
        error = " ".join(capsys.readouterr().err.split())
        assert f"{source}: a level must not replace the scene; choose another folder." in error
    assert before == {one: one.read_bytes() for one in out.rglob("*") if one.is_file()}
    (out / INDEX_NAMES[kind]).write_text("{}")  # of another tool, or damaged
    assert main(["levels", str(out / chunk), *words, "--overwrite"]) == 1
    before[out / INDEX_NAMES[kind]] = b"{}"
    assert before == {one: one.read_bytes() for one in out.rglob("*") if one.is_file()}
    beside = out / "b.ply"
    path.rename(beside)
    assert main(["levels", str(beside), *words, "--overwrite"]) == 0
    assert beside.exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize(
    ("count", "valid", "levels"),
    [(1, 1, [1]), (2, 2, [2, 1]), (10, 10, [10, 3, 1]), (10, 2, [2, 1]), (200, 40, [40, 12, 3])],
)
def test_the_levels_of_a_small_stream_differ_in_size(
    tmp_path: Path, count: int, valid: int, levels: list[int]
) -> None:
    path, out = tmp_path / "a.ply", tmp_path / "out"
    scene = random_scene(count)
    means = scene.means.clone()
    means[valid:] = torch.nan
    save(scene.with_tensors({"means": means}), path)
    words = ["levels", str(path), "-o", str(out), "--stream", "sog", "--preset", "draft"]
    assert main(words) == 0
    assert [len(load(out, lod=lod)) for lod in range(len(levels))] == levels


def test_a_page_shows_a_scene_that_is_named_like_a_level(tmp_path, monkeypatch):
    path, shown = tmp_path / "rho_0.5.ply", {}
    save(random_scene(30), path)
    monkeypatch.setattr("cvtgs.cli.levels.check_page", lambda options: None)
    monkeypatch.setattr("cvtgs.cli.levels.write_page", lambda options, scenes: shown.update(scenes))
    line = ["levels", str(path), "-o", str(tmp_path / "out"), "--rho", "0.5", "--no-scores"]
    assert main([*line, "--viewer"]) == 0
    assert {name: len(one) for name, one in shown.items()} == {str(path): 30, "rho_0.5.ply": 15}


@pytest.mark.long
@pytest.mark.parametrize("axes", [[], ["--axes", "rdf"], ["--axes", "rub"]])
def test_turned_scenes_are_not_scored_from_cameras_beside_them(
    tmp_path: Path, words: list[str], axes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    turn = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    entry = {"id": 0, "img_name": "a", "width": 48, "height": 36, "fx": 40.0, "fy": 40.0}
    entries = [{**entry, "position": [x, 0, -4], "rotation": turn} for x in (0, 1)]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    assert main([*words, "--rho", "0.1", *axes]) == 0
    assert ("cameras found in" in capsys.readouterr().err) == ("rub" not in axes)


def test_a_stream_is_written_into_new_folders_and_may_lack_gaussians(tmp_path, capsys):
    scene = random_scene(60)
    scene.means[3, 0] = float("nan")
    save(scene, tmp_path / "a.ply")
    words = ["levels", str(tmp_path / "a.ply"), "--rho", "1,0.5", "--stream", "sog"]
    assert main([*words, "-o", str(tmp_path / "new" / "out")]) == 0
    assert (tmp_path / "new" / "out" / "lod-meta.json").is_file()
    assert "Fewer than the requested 60: only 59 of 60 Gaussians are" in capsys.readouterr().out
    save(scene[4:], tmp_path / "a.spz")
    words[1] = str(tmp_path / "a.spz")
    assert main([*words, "-o", str(tmp_path / "other"), "--memory", "4GB"]) == 0
    assert "--memory has an effect on binary .ply files only." in capsys.readouterr().out


@pytest.mark.slow
def test_levels_without_bands_are_scored_against_the_whole_scene(tmp_path, capsys):
    save(synthetic.scene("object", 300, sh_degree=2), tmp_path / "a.ply")
    words = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path), "--rho", "1", "--views", "1"]
    assert main([*words, "--size", "64", "--sh-degree", "0"]) == 0
    (level,) = json.loads((tmp_path / "levels.json").read_text())["levels"]
    assert load(tmp_path / level["file"]).sh_degree == 0
    assert 10 < level["psnr"] < 60


@pytest.mark.parametrize("words", [["--size", "1"], ["--backend", "gsplat", "--device", "cpu"]])
def test_levels_that_cannot_be_scored_are_not_made(tmp_path, capsys, words):
    save(random_scene(30), tmp_path / "a.ply")
    line = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "out"), "--rho", "0.5"]
    assert main([*line, *words]) == 1
    assert list((tmp_path / "out").glob("*")) == []


def test_levels_of_fewer_gaussians_than_asked_for_say_why(tmp_path, capsys):
    scene = random_scene(20)
    means = scene.means.clone()
    means[:5] = torch.nan
    save(scene.with_tensors({"means": means}, {}), tmp_path / "a.ply")
    line = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path), "--rho", "0.9", "--no-scores"]
    assert main([*line, "--preset", "draft"]) == 0
    printed = capsys.readouterr().out
    assert "Fewer than the requested 18: only 15 of 20 Gaussians are valid." in printed
    assert "of an earlier run" not in printed
