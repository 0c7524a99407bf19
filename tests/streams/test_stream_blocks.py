"""Streams of files that do not fit into memory: parts, resumption, workers."""

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs import GaussianScene, Simplifier, SimplifyConfig, concatenate, load, save
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, OutputExistsError
from cvtgs.io.atomic import replace_file
from cvtgs.outofcore import LocalWorkers
from cvtgs.scene import FLAT_LOG_SCALE
from cvtgs.streams import plan_stream, stream_file, write_sog_stream
from cvtgs.synthetic import scene as make
from cvtgs.tags import TWO_SCALES

RHOS = [1.0, 0.25, 0.05, 0.0125]
COUNTS = [4000, 1000, 200, 50]
FAST = Simplifier(preset="draft", device="cpu")


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return make("courtyard", 4000, sh_degree=0, seed=3)


@pytest.fixture
def source(tmp_path: Path, scene: GaussianScene) -> Path:
    save(scene, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def stream(source: Path, folder: Path, **more: Any) -> Any:
    options = {"kind": "sog", "blocks": 3, "chunk_gaussians": 300, "simplifier": FAST} | more
    return stream_file(source, folder, RHOS, **options)


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
def test_counts_are_exact_and_the_finest_level_is_the_scene(
    tmp_path: Path, source: Path, scene: GaussianScene
) -> None:
    report = stream(source, tmp_path / "out")
    assert report.blocks == 3
    assert [level.gaussians for level in report.levels] == COUNTS
    assert json.loads((tmp_path / "out" / "lod-meta.json").read_text())["counts"] == COUNTS
    assert [len(load(tmp_path / "out", lod=lod)) for lod in range(4)] == COUNTS
    finest = load(tmp_path / "out")
    away = torch.cdist(scene.means.double(), finest.means.double()).amin(dim=1)
    assert float(away.max()) < 0.02
    assert names_in(tmp_path) == ["out", "scene.ply"]


def test_blocks_get_the_counts_of_one_piece(tmp_path: Path) -> None:
    """Half of the scene has one colour, so its Gaussians merge at less cost."""
    plain = make("object", 1500, sh_degree=0, seed=1)
    plain = plain.with_tensors({"sh0": torch.zeros_like(plain.sh0)}, {})
    generator = torch.Generator().manual_seed(0)
    colors = torch.randn(plain.sh0.shape, generator=generator)
    away = plain.means + torch.tensor([10 * float(plain.means.abs().max()), 0.0, 0.0])
    pair = concatenate([plain, plain.with_tensors({"means": away, "sh0": colors}, {})])
    save(pair, tmp_path / "scene.ply")
    stream(tmp_path / "scene.ply", tmp_path / "out", blocks=2)
    middle = float(away[:, 0].mean()) / 2
    for lod, level in enumerate(FAST.levels(pair, RHOS)[:2]):
        found = load(tmp_path / "out", lod=lod)
        count, wanted = (int((s.means[:, 0] > middle).sum()) for s in (found, level.scene))
        assert len(found) == len(level.scene)
        assert abs(count - wanted) <= 0.05 * len(found)
        assert lod == 0 or count > 0.55 * len(found)


@pytest.mark.slow
def test_every_level_has_the_mass_of_a_run_in_one_piece(tmp_path: Path) -> None:
    room = make("room", 4000, sh_degree=0, seed=3)
    save(room, tmp_path / "room.ply")
    stream(tmp_path / "room.ply", tmp_path / "out")
    for lod, level in enumerate(FAST.levels(room, RHOS)):
        mass = float(load(tmp_path / "out", lod=lod).masses.sum())
        assert math.isclose(mass, float(level.scene.masses.sum()), rel_tol=0.08)


@pytest.mark.slow
def test_parts_of_3d_tiles_share_a_root_without_content(tmp_path: Path, source: Path) -> None:
    report = stream(source, tmp_path / "out", kind="3dtiles")
    document = json.loads((tmp_path / "out" / "tileset.json").read_text())
    finest: list[int] = []

    def check(tile: dict[str, Any], error: float) -> None:
        assert tile["geometricError"] <= error
        children = tile.get("children", [])
        assert children or tile["geometricError"] == 0
        for child in children:
            check(child, tile["geometricError"])
        if not children:
            finest.append(len(load(tmp_path / "out" / tile["content"]["uri"])))

    assert "content" not in document["root"]
    check(document["root"], document["geometricError"])
    assert sum(finest) == 4000 == report.levels[0].gaussians


@pytest.mark.long
def test_workers_give_the_same_bytes(tmp_path: Path, source: Path) -> None:
    stream(source, tmp_path / "alone")
    with LocalWorkers(2) as workers:
        stream(source, tmp_path / "two", workers=workers)
    assert files_of(tmp_path / "alone") == files_of(tmp_path / "two")


class StoppedError(RuntimeError):
    """Ends a run before it is complete."""


def until(most: int, done: list[int]) -> Callable[..., Iterator[Any]]:
    """Return workers that fail once ``most`` blocks are written."""

    def work(function: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[Any]:
        for item in items:
            if isinstance(item, int):
                if len(done) == most:
                    raise StoppedError
                done.append(item)
            yield function(item)

    return work


@pytest.mark.slow
def test_an_interrupted_run_is_continued(tmp_path: Path, source: Path) -> None:
    stream(source, tmp_path / "whole")
    out, done = tmp_path / "out", list[int]()
    with pytest.raises(StoppedError):
        stream(source, out, workers=until(2, done))
    assert not out.exists()
    assert ".out.blocks" in names_in(tmp_path)
    report = stream(source, out, workers=until(9, done))
    assert done == [0, 1, 2]
    assert report.resumed_blocks == 2
    assert files_of(out) == files_of(tmp_path / "whole")
    assert names_in(tmp_path) == ["out", "scene.ply", "whole"]


@pytest.mark.slow
def test_a_damaged_part_is_written_again(tmp_path: Path, source: Path) -> None:
    done: list[int] = []
    with pytest.raises(StoppedError):
        stream(source, tmp_path / "out", workers=until(2, done))
    image = next((tmp_path / ".out.blocks").rglob("0_1_0/means_l.webp"))
    image.write_bytes(image.read_bytes()[:10])
    assert stream(source, tmp_path / "out").resumed_blocks == 1
    assert len(load(tmp_path / "out")) == 4000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["targets.json", "scan.safetensors"])
def test_a_stream_without_its_plan_starts_over(tmp_path: Path, source: Path, name: str) -> None:
    with pytest.raises(StoppedError):
        stream(source, tmp_path / "out", workers=until(2, []))
    plan = next((tmp_path / ".out.blocks").rglob(name))
    os.truncate(plan, plan.stat().st_size // 2)
    assert stream(source, tmp_path / "out").resumed_blocks == 0
    assert len(load(tmp_path / "out")) == 4000


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"chunk_gaussians": 200},
        {"sh_degree": 0},
        {"axes": ("rdf", "rub")},
        {"rhos": [1.0, 0.1, 0.05]},
    ],
)
def test_other_options_start_the_stream_over(tmp_path: Path, options: dict[str, Any]) -> None:
    save(make("courtyard", 300, sh_degree=0, seed=3), tmp_path / "scene.ply")
    usual = {"rhos": [1.0, 0.1], "kind": "sog", "blocks": 3, "simplifier": FAST}
    with pytest.raises(StoppedError):
        stream_file(tmp_path / "scene.ply", tmp_path / "out", **usual, workers=until(2, []))
    other = usual | options
    assert stream_file(tmp_path / "scene.ply", tmp_path / "out", **other).resumed_blocks == 0


@pytest.mark.slow
def test_a_stream_is_replaced_only_with_overwrite(tmp_path: Path, source: Path) -> None:
    out = tmp_path / "out"
    stream(source, out)
    with pytest.raises(OutputExistsError, match=r"lod-meta.json: the output must not exist yet"):
        stream(source, out)
    (out / "index.html").write_text("a page of somebody's own")
    stream(source, out, blocks=2, overwrite=True)
    assert len(load(out)) == 4000
    assert (out / "index.html").exists()


@pytest.mark.slow
def test_invalid_rows_are_counted(tmp_path: Path, scene: GaussianScene) -> None:
    means = scene.means.clone()
    means[[5, 77]] = torch.nan
    save(scene.with_tensors({"means": means}, {}), tmp_path / "bad.ply")
    with pytest.warns(DroppedDataWarning, match="dropped 2 of 4,000 Gaussians"):
        report = stream(tmp_path / "bad.ply", tmp_path / "out")
    assert [level.gaussians for level in report.levels] == [3998, 1000, 200, 50]


@pytest.mark.long
def test_axes_and_sh_degree_are_applied(tmp_path: Path) -> None:
    save(make("courtyard", 1000, sh_degree=1, seed=3), tmp_path / "scene.ply")
    stream(tmp_path / "scene.ply", tmp_path / "full")
    stream(tmp_path / "scene.ply", tmp_path / "plain", sh_degree=0)
    stream(tmp_path / "scene.ply", tmp_path / "turned", axes=("rdf", "rub"), sh_degree=0)
    full, plain, turned = (load(tmp_path / name, lod=3) for name in ("full", "plain", "turned"))
    assert [scene.sh_degree for scene in (full, plain, turned)] == [1, 0, 0]
    flipped = plain.means * torch.tensor([1.0, -1.0, -1.0])
    assert float(torch.cdist(flipped, turned.means).amin(dim=1).max()) < 0.05


def test_3d_tiles_may_have_an_input_of_other_axes(tmp_path: Path) -> None:
    save(make("courtyard", 300, sh_degree=0, seed=3), tmp_path / "scene.ply")
    options: dict[str, Any] = {"kind": "3dtiles", "blocks": 2, "simplifier": FAST}
    report = stream_file(
        tmp_path / "scene.ply", tmp_path / "out", [1.0], axes=("rub", "rdf"), **options
    )
    assert [level.gaussians for level in report.levels] == [300]


def test_an_unknown_kind_is_refused_before_the_work(tmp_path: Path, source: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="must be sog or 3dtiles, found 'tiles'"):
        stream_file(source, tmp_path / "out", [0.5, 0.1], kind="tiles", simplifier=FAST)
    assert names_in(tmp_path) == ["scene.ply"]


@pytest.mark.parametrize(
    ("kind", "option", "text"),
    [
        ("3dtiles", {"axes": ("rub", "rub")}, r"own \(z up\), .* must be rdf, found 'rub'"),
        ("3dtiles", {"environment_radii": 10.0}, "no environment, so environment_radii must be No"),
        ("3dtiles", {"transform": (1.0, 2.0)}, "must be 16 finite numbers, .* found .1.0, 2.0."),
        ("sog", {"transform": (1.0,) * 16}, "only 3D Tiles have a transform, found one for a SOG"),
        ("sog", {"chunk_gaussians": 0}, "chunk_gaussians must be a whole number above 0, found 0"),
        ("sog", {"chunk_gaussians": "9"}, "chunk_gaussians must be a whole number above 0, f"),
        ("sog", {"axes": "rdf"}, "axes must be those of the input file and those of the output, f"),
        ("sog", {"axes": ("rdf", "xyz")}, "axes must be the directions .*; found 'xyz'"),
        ("sog", {"sh_degree": 4}, "sh_degree must be a whole number between 0 and 3, found 4"),
        ("sog", {"blocks": "3"}, "blocks must be a whole number above 0, found '3'"),
        ("sog", {"memory": -1}, "memory must be a whole number of bytes above 0, found -1."),
        ("sog", {"memory": 4}, r"memory must be at least \d+ MB: .* the rest; found 4 bytes\."),
    ],
)
def test_impossible_options_are_refused_before_the_work(
    tmp_path: Path, source: Path, kind: str, option: dict[str, Any], text: str
) -> None:
    with pytest.raises(InvalidArgumentError, match=text):
        stream(source, tmp_path / "out", kind=kind, **option)
    assert names_in(tmp_path) == ["scene.ply"]


def test_all_blocks_give_one_warning(tmp_path: Path) -> None:
    """Each block has a tile of its finest level, and one of its coarsest: 300 and 4 in total."""
    scene = make("object", 300, sh_degree=1, seed=3)
    save(scene.with_tensors({"shN": scene.shN + 2.0}, {}), tmp_path / "scene.ply")
    with pytest.warns(DroppedDataWarning, match=r"which are clamped \(304 Gaussians\)") as caught:
        report = stream(tmp_path / "scene.ply", tmp_path / "out", kind="3dtiles")
    assert report.blocks == 3
    assert [warning.filename for warning in caught] == [__file__]


def test_levels_of_equal_size_are_refused(tmp_path: Path, source: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="needs levels of different sizes"):
        stream_file(source, tmp_path / "out", [0.1, 0.1], kind="sog", simplifier=FAST)
    assert names_in(tmp_path) == ["scene.ply"]


def save_open_scene(path: Path) -> None:
    """Write an object under a sky of 200 Gaussians."""
    near, far = make("object", 3000, sh_degree=0, seed=1), make("object", 200, sh_degree=0, seed=2)
    directions = torch.nn.functional.normalize(far.means - far.means.mean(dim=0))
    radius = float(near.means.norm(dim=1).quantile(0.7))
    sky = far.with_tensors({"means": 40 * radius * directions}, {})
    save(concatenate([near, sky]), path)


@pytest.mark.slow
def test_the_environment_of_all_blocks_fits_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_open_scene(tmp_path / "scene.ply")
    monkeypatch.setattr("cvtgs.streams.plan.ENVIRONMENT_GAUSSIANS", 150)
    stream(tmp_path / "scene.ply", tmp_path / "out", environment_radii=10)
    assert 3 <= len(load(tmp_path / "out" / "environment" / "meta.json")) <= 150


@pytest.mark.slow
def test_blocks_share_one_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if a run ends after all blocks and another one resumes it."""
    save_open_scene(tmp_path / "scene.ply")

    def stop(*_: Any, **__: Any) -> None:
        raise StoppedError

    with monkeypatch.context() as patch:
        patch.setattr("cvtgs.streams.blocks.publish", stop)
        with pytest.raises(StoppedError):
            stream(tmp_path / "scene.ply", tmp_path / "out", environment_radii=10)
    report = stream(tmp_path / "scene.ply", tmp_path / "out", environment_radii=10)
    assert report.resumed_blocks == 3
    assert 2500 < report.levels[0].gaussians <= 3000
    assert len(load(tmp_path / "out")) == 3200
    assert sorted(path.name for path in (tmp_path / "out").glob("[.e]*")) == ["environment"]


def test_blocks_are_kept_if_the_last_step_is_interrupted(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, moved = tmp_path / "out", []
    out.mkdir()

    def move(path: Path, target: Path) -> None:
        moved.append(target)
        if len(moved) == 3:
            raise StoppedError
        replace_file(path, target)

    with monkeypatch.context() as patch:
        patch.setattr("cvtgs.streams.files.replace_file", move)
        with pytest.raises(StoppedError):
            stream(source, out)
    assert names_in(out) == []
    assert stream(source, out).resumed_blocks == 3


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [None, 3])
def test_all_files_are_in_a_mounted_folder(
    tmp_path: Path, source: Path, scene: GaussianScene, blocks: int | None, monkeypatch: Any
) -> None:
    """Nothing can be moved there from beside it, nor can the folder be replaced."""
    out, moved, real = tmp_path / "out", [], Path.replace
    out.mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == out)
    monkeypatch.setattr(Path, "replace", lambda own, to: moved.append(own) or real(own, to))
    monkeypatch.setattr(Path, "rmdir", lambda own: pytest.fail(f"removed {own}"))
    for overwrite in (False, True):
        if blocks:
            stream(source, out, blocks=blocks, overwrite=overwrite)
        else:
            plan = plan_stream(FAST.levels(scene, RHOS), chunk_gaussians=300)
            write_sog_stream(plan, out, overwrite=overwrite)
        assert [len(load(out, lod=lod)) for lod in range(4)] == COUNTS
        assert not [name for name in names_in(out) if name.startswith(".")]
    assert moved
    assert all(path.is_relative_to(out) for path in moved)
    assert names_in(tmp_path) == ["out", "scene.ply"]


def test_flat_gaussians_that_become_thick_may_have_an_environment(tmp_path: Path) -> None:
    """Some blocks keep all of theirs at the finest level, others do not; both lose the tag."""
    scene = make("courtyard", 1200, sh_degree=0, seed=0)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = FLAT_LOG_SCALE
    flat = scene.with_tensors({"log_scales": log_scales}, {})
    save(replace(flat, comments=(TWO_SCALES.text,), layout=()), tmp_path / "flat.ply")
    config = SimplifyConfig.from_mapping({"preset": "draft", "effects": {"flat": "off"}})
    options = {"kind": "sog", "blocks": 6, "chunk_gaussians": 50, "environment_radii": 0.5}
    thick = Simplifier(config=config, device="cpu")
    stream_file(tmp_path / "flat.ply", tmp_path / "out", [0.999, 0.05], simplifier=thick, **options)
    assert (tmp_path / "out" / "environment").is_dir()
