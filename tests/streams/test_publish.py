"""How the files of a finished stream get to the output folder."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from cvtgs import Simplifier, load
from cvtgs.io.atomic import replace_file
from cvtgs.streams import StreamPlan, plan_stream, write_sog_stream
from cvtgs.synthetic import scene as make


@pytest.fixture(scope="module")
def plan() -> StreamPlan:
    scene = make("object", 300, sh_degree=0, seed=3)
    return plan_stream(Simplifier(preset="draft", device="cpu").levels(scene, [1.0, 0.1]))


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_new_stream_is_published_by_a_move_that_waits_on_windows(
    plan: StreamPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved: list[Path] = []

    def move(source: Path, target: Path) -> None:
        moved.append(target)
        replace_file(source, target)

    monkeypatch.setattr("cvtgs.streams.files.replace_file", move)
    write_sog_stream(plan, tmp_path / "out")
    assert moved == [tmp_path / "out"]


@pytest.mark.slow
@pytest.mark.parametrize("is_moved", [False, True])
@pytest.mark.parametrize("number", range(7))
def test_an_interrupted_replacement_keeps_the_old_stream(
    plan: StreamPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, is_moved: bool
) -> None:
    """An index and two chunks are set aside, two and an index take their place.

    An interrupt just before or after a move counts. After the last move, the stream is replaced.
    """
    numbers = iter(range(100))

    def move(source: Path, target: Path) -> None:
        stops = next(numbers) == number
        if is_moved or not stops:
            replace_file(source, target)
        if stops:
            raise KeyboardInterrupt

    other = make("object", 200, sh_degree=0, seed=4)
    levels = Simplifier(preset="draft", device="cpu").levels(other, [1.0, 0.1])
    write_sog_stream(plan_stream(levels), tmp_path / "out")
    before = files_of(tmp_path)
    monkeypatch.setattr("cvtgs.streams.files.replace_file", move)
    with nullcontext() if number == 6 else pytest.raises(KeyboardInterrupt):
        write_sog_stream(plan, tmp_path / "out", overwrite=True)
    if number < (5 if is_moved else 6):
        assert files_of(tmp_path) == before
    else:
        assert [len(load(tmp_path / "out", lod=lod)) for lod in (0, 1)] == [300, 30]
        assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_no_index_names_files_of_another_stream(
    plan: StreamPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even for a moment, in which a run may be killed."""
    write_sog_stream(plan, tmp_path / "out")
    before, found = files_of(tmp_path), list[bool]()

    def move(source: Path, target: Path) -> None:
        now = files_of(tmp_path / "out")
        old = {
            path: content for path, content in before.items() if (tmp_path / "out") in path.parents
        }
        found.append((tmp_path / "out" / "lod-meta.json").exists())
        assert now == old or not found[-1]
        replace_file(source, target)

    other = make("object", 200, sh_degree=0, seed=4)
    levels = Simplifier(preset="draft", device="cpu").levels(other, [1.0, 0.1])
    monkeypatch.setattr("cvtgs.streams.files.replace_file", move)
    write_sog_stream(plan_stream(levels), tmp_path / "out", overwrite=True)
    assert found == [True, False, False, False, False, False]


def test_a_link_to_a_missing_folder_stays_a_link(plan: StreamPlan, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_sog_stream(plan, tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert len(load(tmp_path / "real")) == 300


def test_a_folder_behind_a_link_in_a_replaced_stream_is_kept(
    plan: StreamPlan, tmp_path: Path
) -> None:
    write_sog_stream(plan, tmp_path / "out")
    (folder, *_) = (path for path in (tmp_path / "out").iterdir() if path.is_dir())
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    before = sorted((tmp_path / "elsewhere").iterdir())
    write_sog_stream(plan, tmp_path / "out", overwrite=True)
    assert sorted((tmp_path / "elsewhere").iterdir()) == before
    assert not folder.is_symlink()
    assert len(load(tmp_path / "out")) == 300
