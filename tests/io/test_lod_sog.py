"""Streamed SOG: ``lod-meta.json`` and its SOGs, as other programs write them."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from cvtgs import GaussianScene, load, save
from cvtgs.cli.main import main
from cvtgs.errors import FileFormatError, InvalidArgumentError
from cvtgs.io import atomic_output, scene_size
from cvtgs.io.sog import encode_sog
from cvtgs.io.sog.write import palette
from cvtgs.text import shown
from format_cases import refusal, storable_scene
from scenes import same_bits

Change = Callable[[dict[str, Any]], None]


def write_folder(scene: GaussianScene, folder: Path) -> None:
    folder.mkdir()
    for name, content in encode_sog(scene).files():
        with atomic_output(folder / name) as file:
            file.write(content)


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """Write two chunks; level 0 is in two files, level 1 in one; two rows are in no chunk."""
    for name, seed, count in (("0_0", 0, 6), ("0_1", 1, 4), ("1_0", 2, 5), ("env", 3, 2)):
        write_folder(storable_scene(count, seed=seed, degree=1), tmp_path / name)
    near = {"0": {"file": 0, "offset": 0, "count": 3}, "1": {"file": 2, "offset": 0, "count": 2}}
    far = {"0": {"file": 1, "offset": 0, "count": 4}, "1": {"file": 2, "offset": 2, "count": 3}}
    bound = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    document = {
        "version": 1,
        "lodLevels": 2,
        "counts": [7, 5],
        "filenames": ["0_0/meta.json", "0_1/meta.json", "1_0/meta.json"],
        "environment": "env/meta.json",
        "tree": {
            "bound": bound,
            "children": [{"bound": bound, "lods": near}, {"bound": bound, "lods": far}],
        },
    }
    (tmp_path / "lod-meta.json").write_text(json.dumps(document))
    return tmp_path


def changed(folder: Path, change: Change) -> Path:
    path = folder / "lod-meta.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


def means(*parts: torch.Tensor) -> list[list[float]]:
    return torch.cat(parts).tolist()


def test_the_finest_level_is_read_with_its_environment(stream: Path) -> None:
    first, second, coarse, far = (
        load(stream / name / "meta.json").means for name in ("0_0", "0_1", "1_0", "env")
    )
    wanted = means(first[:3], second, far)
    assert load(stream / "lod-meta.json").means.tolist() == wanted
    assert load(stream).means.tolist() == load(stream, lod=0).means.tolist() == wanted
    assert load(stream, lod=1).means.tolist() == means(coarse, far)
    whole = load(stream)
    assert (whole.sh_degree, whole.antialiased) == (1, True)
    (stream / "1_0" / "bundled.sog").write_bytes(b"123")
    files = [path for path in stream.rglob("*") if path.is_file()]
    assert scene_size(stream) == sum(path.stat().st_size for path in files)


@pytest.mark.parametrize("name", ["", None])
def test_an_empty_name_is_no_environment(stream: Path, name: str | None) -> None:
    """PlayCanvas' engine and splat-transform take it so."""
    path = changed(stream, lambda document: document.update(environment=name))
    assert len(load(path)) == 7


def test_a_chunk_without_the_level_gives_its_next_level(stream: Path) -> None:
    def drop(document: dict[str, Any]) -> None:
        near, far = (child["lods"] for child in document["tree"]["children"])
        del near["0"], far["1"], document["environment"]

    path = changed(stream, drop)
    first, coarse = (load(stream / name / "meta.json").means for name in ("0_1", "1_0"))
    assert load(path).means.tolist() == means(first, coarse[:2])
    assert load(path, lod=1).means.tolist() == means(first, coarse[:2])


def test_a_chunk_without_the_level_gives_nothing_if_others_have_all_of_it(stream: Path) -> None:
    def drop(document: dict[str, Any]) -> None:
        del document["tree"]["children"][0]["lods"]["0"]
        document.update(counts=[4, 5])

    path = changed(stream, drop)
    second, coarse, far = (
        load(stream / name / "meta.json").means for name in ("0_1", "1_0", "env")
    )
    assert load(path).means.tolist() == means(second, far)
    assert load(path, lod=1).means.tolist() == means(coarse, far)


def test_an_empty_level_gives_the_next_one(stream: Path) -> None:
    def drop(document: dict[str, Any]) -> None:
        for child in document["tree"]["children"]:
            del child["lods"]["0"]
        document.update(counts=[0, 5])

    path = changed(stream, drop)
    coarse, far = (load(stream / name / "meta.json").means for name in ("1_0", "env"))
    assert load(path).means.tolist() == means(coarse, far)


def test_commands_accept_lod(stream: Path, tmp_path: Path) -> None:
    words = ["convert", str(stream), str(tmp_path / "a.ply"), "--quiet", "--lod", "1"]
    assert main(words) == 0
    assert same_bits(load(tmp_path / "a.ply"), load(stream, lod=1))
    assert main(["info", str(stream), "--lod", "1"]) == 0


def test_lod_is_refused_for_other_files_and_out_of_range(stream: Path, tmp_path: Path) -> None:
    save(storable_scene(3), tmp_path / "a.ply")
    assert len(load(tmp_path / "a.ply", lod=0)) == 3
    for other in (1, "0"):
        with pytest.raises(
            InvalidArgumentError, match=r"0 unless for a streamed SOG \(lod-meta.json\), found"
        ):
            load(tmp_path / "a.ply", lod=cast("Any", other))
    wrongs: tuple[Any, ...] = (-1, 2, 0.5, "1", True)
    for lod in wrongs:
        with pytest.raises(
            InvalidArgumentError, match=f"from 0 to 1, the levels of .*, found {lod!r}"
        ):
            load(stream, lod=lod)


def rows(document: dict[str, Any], chunk: int = 0, level: str = "0") -> dict[str, Any]:
    return document["tree"]["children"][chunk]["lods"][level]


OUTSIDE = (
    "the files of a stream must be meta.json or .sog in its folder, with names of at most 255 "
    "characters, found "
)
DAMAGE: dict[str, tuple[Change, str]] = {
    "version": (lambda d: d.update(version=2), "'version' must be 1, found 2."),
    "levels": (lambda d: d.update(lodLevels=0), "'lodLevels' must be 1 or more, found 0."),
    "tree": (lambda d: d.update(tree=[]), "'tree' must be a JSON object, found []."),
    "node": (
        lambda d: d["tree"].update(children=[7]),
        "a node: must be a JSON object, found 7.",
    ),
    "children": (
        lambda d: d["tree"].update(children="many"),
        "a node: 'children' must be a list, found 'many'.",
    ),
    "lods": (
        lambda d: d.update(tree={"lods": 3}),
        "a node: 'lods' must be a JSON object, found 3.",
    ),
    "level": (
        lambda d: d.update(tree={"lods": {"fine": {}}}),
        "chunk 0: levels must be whole numbers, found 'fine'.",
    ),
    "level of many digits": (  # more than Python converts to a number
        lambda d: d.update(tree={"lods": {"9" * 5000: {}}}),
        f"chunk 0: levels must be whole numbers, found {shown('9' * 5000)}.",
    ),
    "count": (
        lambda d: rows(d).update(count=-1),
        "chunk 0, level 0: 'count' must be a whole number of at least 0, found -1.",
    ),
    "file": (
        lambda d: rows(d).update(file=9),
        "filenames has 3 entries, found number 9.",
    ),
    "sum": (
        lambda d: d.update(counts=[9, 5]),
        "'counts' must hold the number of Gaussians of each of 2 levels, found [9, 5] and 7 in "
        "the chunks of level 0.",
    ),
    "twice": (
        lambda d: rows(d, 1).update(file=0, offset=2),
        "each row of a file must be in one chunk, found row 2 of '0_0/meta.json' in two.",
    ),
    "a file again": (
        lambda d: d["filenames"].__setitem__(1, "./0_0/meta.json"),
        "each file must be in 'filenames' or 'environment' once.",
    ),
    "above": (
        lambda d: d["filenames"].__setitem__(0, "../0_0/meta.json"),
        OUTSIDE + "'../0_0/meta.json'.",
    ),
    "absolute": (
        lambda d: d["filenames"].__setitem__(0, "/0_0/meta.json"),
        OUTSIDE + "'/0_0/meta.json'.",
    ),
    "address": (
        lambda d: d.update(environment="https://x.org/meta.json"),
        OUTSIDE + "'https://x.org/meta.json'.",
    ),
    "foreign": (
        lambda d: d["filenames"].__setitem__(0, "0_0/scene.ply"),
        f"{OUTSIDE}'0_0/scene.ply'.",
    ),
    "long": (
        lambda d: d.update(environment="y" * 5000 + ".sog"),
        f"{OUTSIDE}{shown('y' * 5000)}.",
    ),
    "nothing": (
        lambda d: (d.pop("environment"), d.update(tree={}, counts=[0, 0])),
        "level 0 must hold at least one Gaussian, found none.",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_each_damage_has_its_own_message(stream: Path, name: str) -> None:
    change, said = DAMAGE[name]
    path = changed(stream, change)
    assert refusal(path) == f"{path}: {said}"


def test_missing_and_short_files_are_refused(stream: Path) -> None:
    shutil.rmtree(stream / "0_1")
    path = stream / "0_1" / "meta.json"
    assert refusal(stream) == f"{path}: the file to read must exist, found none."
    write_folder(storable_scene(2, degree=1), stream / "0_1")
    assert refusal(stream) == (f"{path}: the stream needs 4 Gaussians, found 2.")


def test_a_file_too_short_for_its_last_chunk_is_refused(stream: Path) -> None:
    shutil.rmtree(stream / "1_0")
    write_folder(storable_scene(4, degree=1), stream / "1_0")
    with pytest.raises(FileFormatError, match=r"the stream needs 5 Gaussians, found 4"):
        load(stream, lod=1)


def test_the_highest_degree_of_the_files_limits_their_expansion(
    stream: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: list[tuple[int, int]] = []

    def check(_path: Path, *, count: int, sh_degree: int, stored: int) -> None:
        assert stored == sum(scene_size(stream / name / "meta.json") for name in ("1_0", "env"))
        checked.append((count, sh_degree))

    shutil.rmtree(stream / "env")
    write_folder(storable_scene(2, degree=0), stream / "env")
    monkeypatch.setattr("cvtgs.io.sog.stream.check_expansion", check)
    load(stream, lod=1)
    assert checked == [(5, 1), (7, 1)]


def test_png_images_of_a_stream_count_as_stored_bytes(stream: Path) -> None:
    before = scene_size(stream)
    (stream / "0_0" / "means_l.png").write_bytes(bytes(1000))
    assert scene_size(stream) == before + 1000


def test_the_palette_splits_no_column_that_varies_by_rounding_only() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(0, 1e-2, (6000, 2)).astype(np.float32)
    rows[:, 0] = np.where(np.arange(6000) % 3 == 0, -1234.567, 987.654)
    found = palette(rows, 256)
    assert len(found.entries) == 256
    assert np.abs(found.entries[found.labels, 1] - rows[:, 1]).mean() < 2e-4
