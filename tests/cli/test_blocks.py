"""What commands that work block by block print, and which files they leave."""

import argparse
import re
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.blocks import block_memory, block_workers
from cvtgs.cli.main import main
from cvtgs.errors import OutputBusyError, OutputError, RunError
from cvtgs.io.ply import PlyRows
from cvtgs.outofcore.memory import IMAGE_BYTES, LEAST_BYTES, WORKER_BYTES
from scenes import random_scene


@pytest.mark.parametrize("error", [KeyboardInterrupt, OutputError, RunError, MemoryError])
@pytest.mark.parametrize("has_steps", [True, False])
def test_an_interrupt_or_a_failure_says_where_the_finished_steps_are(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    error: type[BaseException],
    has_steps: bool,
) -> None:
    options = argparse.Namespace(output=tmp_path / "out.ply", scheduler=None, workers=1)
    folder = tmp_path / ".out.ply.blocks"
    (folder / "key").mkdir(parents=True)
    if has_steps:
        (folder / "key" / "sorted.json").touch()
    with pytest.raises(error), block_workers(options, 10**9):
        raise error
    text = f"cvtgs: {folder.resolve()} has the finished steps, with which the same command "
    assert capsys.readouterr().err.startswith(text) == has_steps
    assert folder.exists() == has_steps


def test_files_of_a_run_that_is_still_at_work_are_no_news(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = argparse.Namespace(output=tmp_path / "out.ply", scheduler=None, workers=1)
    (tmp_path / ".out.ply.blocks" / "key").mkdir(parents=True)
    (tmp_path / ".out.ply.blocks" / "key" / "sorted.json").touch()
    with pytest.raises(OutputBusyError), block_workers(options, 10**9):
        raise OutputBusyError
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("words", "left"),
    [
        (["simplify", "{}/in.ply", "{}/out.ply", "--rho", "0.1", "--preset", "draft"], "out.ply"),
        (["levels", "{}/in.ply", "-o", "{}/out", "--rho", "0.1", "--stream", "sog"], "out"),
    ],
)
def test_a_run_in_one_piece_removes_what_an_interrupted_one_left(
    tmp_path: Path, words: list[str], left: str
) -> None:
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    kept = tmp_path / f".{left}.blocks" / "key"
    kept.mkdir(parents=True)
    (kept / "rows_00000_00000").write_bytes(b"rows")
    (tmp_path / f".{left}.lock").touch()
    assert main([word.format(tmp_path) for word in (*words, "--quiet")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.ply", left]


def test_fewer_processes_than_wanted_are_a_warning(tmp_path: Path) -> None:
    options = argparse.Namespace(output=tmp_path / "out.ply", scheduler=None, workers=3)
    start = block_workers(options, 2 * WORKER_BYTES - 1)
    with pytest.warns(
        UserWarning, match=r"^--workers 3: the memory is enough for 1, at .* GB each"
    ):
        assert start.__enter__() == (None, 2 * WORKER_BYTES - 1)
    start.__exit__(None, None, None)


@pytest.mark.parametrize(
    "words",
    [
        ["simplify", "{}/in.ply", "{}/out.ply", "--rho", "0.1"],
        ["levels", "{}/in.ply", "-o", "{}/out", "--rho", "0.1", "--stream", "sog"],
    ],
)
def test_blocks_refuse_another_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words
) -> None:
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda *args, **kwargs: 4)
    given = [word.format(tmp_path) for word in (*words, "--memory", "2GB", "--device", "cuda")]
    assert main(given) == 1
    error = "cvtgs: error: --device cuda cannot be used with blocks, which are computed on the CPU."
    assert capsys.readouterr().err.strip() == error


def test_images_leave_less_memory_for_one_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rooms: list[int] = []

    def count(rows: PlyRows, memory: int, *, merging: int) -> int:
        rooms.append(memory)
        return 1

    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", count)
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    options = argparse.Namespace(
        input=tmp_path / "in.ply",
        rho=0.1,
        count=None,
        max_count=None,
        memory="2GB",
        workers=1,
        scheduler=None,
        device="auto",
        target_psnr=None,
        target_ssim=None,
    )
    for preset, target in (("standard", None), ("matched", None), ("standard", 0.9)):
        options.target_ssim = target
        assert block_memory(options, cvtgs.SimplifyConfig(preset=preset)) is None
    assert rooms == [2_000_000_000, *2 * [2_000_000_000 - IMAGE_BYTES]]


def test_a_time_budget_chooses_no_preset_whose_images_do_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--rho", "0.1"]
    words += ["--time-budget", "1h", "--shipped-rates", "--memory", "700MB"]
    assert main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Preset standard, the best that fits into 3600 s and, without images, into 700MB" in text


@pytest.mark.long
def test_a_quality_is_not_searched_in_less_memory_than_its_images_need(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--preset", "draft"]
    words += ["--target-psnr", "12", "--memory"]
    assert main([*words, "700MB"]) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert "blocks: it needs memory for the whole scene and 400 MB for images of it at" in error
    assert main([*words, "2GB"]) == 0


def test_images_leave_less_memory_for_a_stream_in_one_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fitting = 2_000_000_000 - IMAGE_BYTES
    monkeypatch.setattr(
        "cvtgs.outofcore.memory.block_count",
        lambda rows, memory, *, merging: 4 if memory <= fitting else 1,
    )
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    words = ["levels", str(tmp_path / "in.ply"), "-o", str(tmp_path / "out"), "--stream", "sog"]
    words += ["--preset", "matched", "--memory", "2GB", "--rho", "0.1"]
    assert main(words) == 1
    assert "streams in blocks need a preset without images" in capsys.readouterr().err
    assert main([*words, "--memory", "700MB"]) == 1
    error = capsys.readouterr().err
    assert f"--memory must be at least {(LEAST_BYTES + IMAGE_BYTES) / 1e6:g} MB: " in error
    assert "images of the scene 400 MB, " in error
    assert error.endswith("need the rest; found '700MB'.\n")


@pytest.mark.parametrize(("amount", "preset"), [("1MB", "draft"), ("700MB", "matched")])
def test_too_little_memory_is_refused_alike_with_and_without_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], amount: str, preset: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda *_, **__: 4)
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--rho", "0.1"]
    assert main([*words, "--preset", preset, "--memory", amount]) == 1
    least = LEAST_BYTES + (IMAGE_BYTES if preset == "matched" else 0)
    wanted = (
        rf"cvtgs: error: --memory must be at least {least / 1e6:g} MB: torch and scipy take "
        rf"\d+ MB, (images of the scene 400 MB, )?and .* need the rest; found '{amount}'\.\n"
    )
    assert re.fullmatch(wanted, capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


def test_a_level_of_a_stream_is_refused_in_blocks_as_in_one_piece(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda *_, **__: 4)
    cvtgs.save(random_scene(100), tmp_path / "in.ply")
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--rho", "0.5"]
    assert main([*words, "--lod", "3", "--memory", "1GB"]) == 1
    assert "lod must be 0 unless for a streamed SOG" in capsys.readouterr().err
