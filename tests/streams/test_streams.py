"""Levels as streams: chunks that fit together, streamed SOG and 3D Tiles."""

import json
import math
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs import GaussianScene, Simplifier, concatenate, load
from cvtgs.errors import InvalidArgumentError, OutputExistsError
from cvtgs.io.atomic import replace_file
from cvtgs.progress import ProgressEvent, silent
from cvtgs.report import Level
from cvtgs.streams import (
    StreamNode,
    StreamPlan,
    geo_transform,
    plan_stream,
    write_sog_stream,
    write_tiles,
)
from cvtgs.streams.files import StreamPart
from cvtgs.streams.sog import SogFormat
from cvtgs.synthetic import scene as make

RHOS = [1.0, 0.25, 0.05, 0.0125]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    found = make("courtyard", 4000, sh_degree=1, seed=3)
    return found.with_tensors({"shN": found.shN / 2}, {})  # in the range of 3D Tiles


@pytest.fixture(scope="module")
def levels(scene: GaussianScene) -> tuple[Level, ...]:
    return Simplifier(preset="fast", device="cpu").levels(scene, RHOS)


@pytest.fixture(scope="module")
def plan(levels: tuple[Level, ...]) -> StreamPlan:
    return plan_stream(levels[::-1], chunk_gaussians=500)


def nodes(node: StreamNode) -> list[StreamNode]:
    return [node, *(below for child in node.children for below in nodes(child))]


def test_levels_assign_each_input_gaussian_to_one_of_theirs(
    scene: GaussianScene, levels: tuple[Level, ...]
) -> None:
    assert levels[0].assignment is None
    for level in levels[1:]:
        found = level.assignment
        assert found is not None
        assert (found.dtype, found.shape) == (torch.int32, (len(scene),))
        members = Counter(found.tolist())
        left_out = members.pop(-1, 0)
        assert left_out == level.report.filtered_count
        assert sorted(members) == list(range(len(level.scene)))


def test_every_row_of_every_level_is_in_one_chunk(plan: StreamPlan) -> None:
    assert [len(level.scene) for level in plan.levels] == [4000, 1000, 200, 50]
    for number, level in enumerate(plan.levels):
        rows = torch.cat([chunk.rows[number] for chunk in plan.chunks])
        assert torch.equal(rows.sort().values, torch.arange(len(level.scene)))
    sizes = [len(chunk.rows[0]) for chunk in plan.chunks]
    assert 8 <= len(sizes) <= 30
    single = [len(chunk.rows[3]) == 1 for chunk in plan.chunks]
    assert all(size <= 500 or alone for size, alone in zip(sizes, single, strict=True))


def test_levels_of_a_chunk_represent_nearly_the_same_gaussians(plan: StreamPlan) -> None:
    """Only fine Gaussians that several coarse ones share can be in the chunk of another."""
    finest, coarsest = plan.levels[1], plan.levels[3]
    assert finest.assignment is not None
    assert coarsest.assignment is not None
    pairs = zip(finest.assignment.tolist(), coarsest.assignment.tolist(), strict=True)
    chunk_of = [
        {row: number for number, chunk in enumerate(plan.chunks) for row in chunk.rows[k].tolist()}
        for k in (1, 3)
    ]
    both = [pair for pair in pairs if min(pair) >= 0]
    assert len(both) > 3000
    same = sum(chunk_of[0][fine] == chunk_of[1][coarse] for fine, coarse in both)
    assert same > 0.85 * len(both)


def test_boxes_enclose_their_children_and_gaussians(plan: StreamPlan) -> None:
    leaves = [node for node in nodes(plan.root) if node.chunk is not None]
    assert [leaf.chunk for leaf in leaves] == list(range(len(plan.chunks)))
    for node in nodes(plan.root):
        for child in node.children:
            assert all(a <= b for a, b in zip(node.box_min, child.box_min, strict=True))
            assert all(a >= b for a, b in zip(node.box_max, child.box_max, strict=True))
    chunk = plan.chunks[0]
    for level, rows in zip(plan.levels, chunk.rows, strict=True):
        for mean, scales in zip(
            level.scene.means[rows].tolist(), level.scene.scales[rows].tolist(), strict=True
        ):
            reach = 3 * min(scales)
            for axis in range(3):
                assert chunk.box_min[axis] <= mean[axis] - reach * 0.999
                assert chunk.box_max[axis] >= mean[axis] + reach * 0.999


def test_streamed_sog_holds_all_levels(plan: StreamPlan, tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    written = write_sog_stream(plan, tmp_path, file_gaussians=700, listener=events.append)
    document = json.loads((tmp_path / "lod-meta.json").read_text())
    assert document["version"] == 1
    assert document["lodLevels"] == 4
    assert document["counts"] == [4000, 1000, 200, 50]
    assert [one.gaussians for one in written] == document["counts"]
    assert [one.files for one in written] == [
        sum(name.startswith(f"{level}_") for name in document["filenames"]) for level in range(4)
    ]
    assert written[0].files >= 6
    assert written[3].files == 1
    assert sum(one.bytes for one in written) == sum(
        path.stat().st_size for path in tmp_path.glob("*/*")
    )
    assert (events[-1].done, events[-1].total) == (len(document["filenames"]),) * 2
    for number, level in enumerate(plan.levels):
        found = load(tmp_path, lod=number)
        assert len(found) == len(level.scene)
        away = torch.cdist(level.scene.means.double(), found.means.double()).amin(dim=1)
        assert float(away.max()) < 0.02
        assert math.isclose(
            float(found.masses.sum()), float(level.scene.masses.sum()), rel_tol=0.05
        )


def test_3d_tiles_hold_all_levels(plan: StreamPlan, tmp_path: Path) -> None:
    written = write_tiles(plan, tmp_path, tile_gaussians=400)
    document = json.loads((tmp_path / "tileset.json").read_text())
    assert document["asset"]["version"] == "1.1"
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert document["extensions"]["3DTILES_content_gltf"]["extensionsRequired"] == names
    assert document["root"]["refine"] == "REPLACE"
    assert len(load(tmp_path / document["root"]["content"]["uri"])) == 50

    finest: list[int] = []

    def check(tile: dict[str, Any]) -> None:
        count = len(load(tmp_path / tile["content"]["uri"]))
        below = tile.get("children", [])
        if not below:
            assert tile["geometricError"] == 0
            finest.append(count)
            return
        assert sum(len(load(tmp_path / one["content"]["uri"])) for one in below) > count
        for child in below:
            assert child["geometricError"] <= tile["geometricError"]
            check(child)

    check(document["root"])
    assert sum(finest) == 4000 == written[0].gaussians
    assert document["geometricError"] >= document["root"]["geometricError"] > 0
    assert sum(one.files for one in written) == len(list(tmp_path.glob("*.glb")))


def test_tiles_lie_in_their_boxes(plan: StreamPlan, tmp_path: Path) -> None:
    """3D Tiles rotate glTF content from y up to z up: (x, y, z) to (x, -z, y)."""
    write_tiles(plan, tmp_path, tile_gaussians=400)

    def check(tile: dict[str, Any]) -> None:
        x, y, z = load(tmp_path / tile["content"]["uri"], axes="rdf").means.unbind(1)
        points = torch.stack([x, -z, y], dim=1)  # the axes of the file, not turned
        box = tile["boundingVolume"]["box"]
        half = torch.tensor([box[3], box[7], box[11]])
        assert ((points - torch.tensor(box[:3])).abs() <= half + 1e-3).all()
        for child in tile.get("children", []):
            check(child)

    check(json.loads((tmp_path / "tileset.json").read_text())["root"])


def test_a_stream_may_have_one_level_and_one_chunk(
    levels: tuple[Level, ...], tmp_path: Path
) -> None:
    plan = plan_stream(levels[3:])
    assert len(plan.chunks) == 1
    write_sog_stream(plan, tmp_path / "sog")
    write_tiles(plan, tmp_path / "tiles")
    assert len(load(tmp_path / "sog")) == len(load(tmp_path / "tiles" / "0_0.glb")) == 50


def test_existing_files_are_replaced_only_with_overwrite(plan: StreamPlan, tmp_path: Path) -> None:
    write_sog_stream(plan, tmp_path)
    with pytest.raises(OutputExistsError, match=r"lod-meta.json: the output must not exist yet"):
        write_sog_stream(plan, tmp_path)
    write_sog_stream(plan, tmp_path, overwrite=True)
    with pytest.raises(OutputExistsError, match=r"needs an empty folder, or one with ti"):
        write_tiles(plan, tmp_path, overwrite=True)


def test_an_existing_folder_is_kept(plan: StreamPlan, tmp_path: Path) -> None:
    """It has permissions, and may be the current one of a shell."""
    out = tmp_path / "out"
    out.mkdir(mode=0o700)
    before = out.stat()
    write_sog_stream(plan, out)
    assert os.path.samestat(out.stat(), before)
    assert out.stat().st_mode == before.st_mode
    assert len(load(out)) == plan.counts[0]


def test_an_interrupt_empties_an_existing_folder(
    plan: StreamPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def move(source: Path, target: Path) -> None:
        if source.suffix == ".json":  # the index, the last one
            raise KeyboardInterrupt
        replace_file(source, target)

    monkeypatch.setattr("cvtgs.streams.files.replace_file", move)
    (tmp_path / "out").mkdir()
    with pytest.raises(KeyboardInterrupt):
        write_sog_stream(plan, tmp_path / "out")
    assert [*tmp_path.rglob("*")] == [tmp_path / "out"]


@pytest.mark.parametrize("kind", ["sog", "3dtiles"])
@pytest.mark.slow
def test_a_new_stream_removes_the_files_of_the_old_one(
    levels: tuple[Level, ...], tmp_path: Path, kind: str
) -> None:
    write = write_sog_stream if kind == "sog" else write_tiles
    few, many = plan_stream(levels[2:]), plan_stream(levels, chunk_gaussians=500)
    more = {"file_gaussians": 500} if kind == "sog" else {"tile_gaussians": 500}
    write(few, tmp_path / "few")
    write(many, tmp_path / "out", **more)
    (tmp_path / "out" / "own.html").touch()
    (tmp_path / "out" / "9_9_9").mkdir()
    write(few, tmp_path / "out", overwrite=True)
    names = [{path.name for path in (tmp_path / name).iterdir()} for name in ("out", "few")]
    assert names[0] == names[1] | {"own.html", "9_9_9"}


def test_levels_of_several_scenes_are_refused(levels: tuple[Level, ...]) -> None:
    other = Simplifier(device="cpu").levels(levels[1].scene, [0.05])
    with pytest.raises(InvalidArgumentError, match="must be of one scene, found scenes of"):
        plan_stream([*levels, *other])
    scenes: list[Any] = [level.scene for level in levels]
    with pytest.raises(InvalidArgumentError, match=r"that Simplifier\.levels returns, found Gauss"):
        plan_stream(scenes)


def test_wrong_levels_and_chunk_sizes_are_refused(levels: tuple[Level, ...]) -> None:
    for wrong in ([], [levels[0], levels[0]]):
        with pytest.raises(InvalidArgumentError, match="needs levels of different sizes"):
            plan_stream(wrong)
    with pytest.raises(InvalidArgumentError, match="chunk_gaussians must be a whole number"):
        plan_stream(levels, chunk_gaussians=0)


def test_the_transform_of_tiles_is_written_and_checked(plan: StreamPlan, tmp_path: Path) -> None:
    place = geo_transform(8.5, 47.4, 400.0)
    write_tiles(plan, tmp_path / "a", transform=place)
    write_tiles(plan, tmp_path / "unplaced")
    placed, unplaced = (
        json.loads((tmp_path / name / "tileset.json").read_text())["root"]
        for name in ("a", "unplaced")
    )
    one, other = (
        torch.tensor(of, dtype=torch.float64).view(4, 4).T for of in (place, unplaced["transform"])
    )
    wanted = (one @ other).T.flatten().tolist()
    assert placed["transform"] == pytest.approx(wanted)
    assert placed["children"] == unplaced["children"]
    wrongs: list[Any] = [(1.0,) * 3, (0.0,) * 15 + (1.0,), (1.0,) * 16, "1,0", 3, torch.eye(4)]
    for wrong in wrongs:
        with pytest.raises(InvalidArgumentError, match="must be 16 finite numbers"):
            write_tiles(plan, tmp_path / "b", transform=wrong)
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("write", [write_sog_stream, write_tiles])
def test_arguments_of_other_types_are_refused(plan: StreamPlan, tmp_path: Path, write: Any) -> None:
    most = "file_gaussians" if write is write_sog_stream else "tile_gaussians"
    for words, options, text in (
        ((3, tmp_path), {}, "plan must be of type StreamPlan, found int"),
        ((plan, 3), {}, "a path must be a str or Path, found int"),
        ((plan, tmp_path), {"listener": None}, "listener must be a function of a progress event"),
        ((plan, tmp_path), {most: "9"}, f"{most} must be a whole number above 0, found '9'"),
    ):
        with pytest.raises(InvalidArgumentError, match=text):
            write(*words, **options)
    with pytest.raises(InvalidArgumentError, match="found 'east', 1"):
        geo_transform("east", 1.0)  # type: ignore[arg-type]


def test_a_failed_stream_leaves_no_files(plan: StreamPlan, tmp_path: Path) -> None:
    def fail(event: ProgressEvent) -> None:
        if event.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sog_stream(plan, tmp_path / "out", listener=fail)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def open_levels() -> tuple[Level, ...]:
    """Levels of an object under a sky of 200 Gaussians, 40 times as far away."""
    near, far = make("object", 3000, sh_degree=0, seed=1), make("object", 200, sh_degree=0, seed=2)
    directions = torch.nn.functional.normalize(far.means - far.means.mean(dim=0))
    radius = float(near.means.norm(dim=1).quantile(0.7))
    far = far.with_tensors({"means": 40 * radius * directions}, {})
    scene = concatenate([near, far])
    return Simplifier(preset="draft", device="cpu").levels(scene, [1.0, 0.25, 0.05])


def test_tiles_have_no_environment(open_levels: tuple[Level, ...], tmp_path: Path) -> None:
    """Its Gaussians are in no chunk, and were left out without a word."""
    plan = plan_stream(open_levels, environment_radii=10)
    with pytest.raises(
        InvalidArgumentError, match="3D Tiles have no environment, so environment_radii"
    ):
        write_tiles(plan, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_far_gaussians_become_the_environment_of_all_levels(
    open_levels: tuple[Level, ...], tmp_path: Path
) -> None:
    plan = plan_stream(open_levels, chunk_gaussians=500, environment_radii=10)
    assert plan.environment is not None
    assert len(plan.environment) == 200
    assert plan.counts[0] == 3000
    reach = max(math.dist(chunk.box_min, chunk.box_max) for chunk in plan.chunks)
    assert reach < 5 * float(open_levels[0].scene.means[:3000].norm(dim=1).quantile(0.7))
    written = write_sog_stream(plan, tmp_path)
    assert [one.gaussians for one in written] == list(plan.counts)
    document = json.loads((tmp_path / "lod-meta.json").read_text())
    assert document["environment"] == "environment/meta.json"
    assert document["counts"] == list(plan.counts)
    for lod, count in enumerate(plan.counts):
        found = load(tmp_path, lod=lod)
        assert len(found) == count + 200
    assert len(load(tmp_path)) == len(open_levels[0].scene)
    assert sorted(path.name for path in tmp_path.glob(".*")) == []


def test_there_is_no_environment_if_nothing_is_far(
    levels: tuple[Level, ...], tmp_path: Path
) -> None:
    plan = plan_stream(levels, environment_radii=1e6)
    assert plan.environment is None
    write_sog_stream(plan, tmp_path)
    assert "environment" not in json.loads((tmp_path / "lod-meta.json").read_text())


def test_a_large_environment_uses_a_coarser_level(
    open_levels: tuple[Level, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cvtgs.streams.plan.ENVIRONMENT_GAUSSIANS", 100)
    plan = plan_stream(open_levels, environment_radii=10)
    assert plan.environment is not None
    assert 1 <= len(plan.environment) <= 100
    assert plan.counts[0] == 3000


def test_a_level_without_far_gaussians_has_no_file(plan: StreamPlan, tmp_path: Path) -> None:
    """A resumed run looks for the named files."""
    some, none = torch.tensor([0]), torch.zeros(0, dtype=torch.int64)
    far = (some, none, *(some for _ in plan.levels[2:]))
    write = SogFormat().write_part
    part = write(plan._replace(far=far), tmp_path, part=0, listener=silent)
    assert part.far[:2] == (1, 0)
    assert sorted(part.environments) == [0, *range(2, len(far))]
    assert all((tmp_path / name).exists() for name in part.environments.values())
    assert StreamPart.model_validate_json(part.model_dump_json()) == part
