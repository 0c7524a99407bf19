"""Files that commands write: no accidental replacement, and one run at a time per folder."""

import errno
import os
from contextlib import contextmanager
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.main import WRITE_SEVERAL, build_parser, main
from cvtgs.errors import OutputBusyError, OutputError
from cvtgs.io.locks import folder_lock, lock_path


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=3), path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("other", ["IN", "OUT", "--config", "--keep", "--cameras"])
@pytest.mark.parametrize("spelling", ["same", "dots", "symlink", "hard link"])
def test_the_report_never_replaces_another_file(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], other: str, spelling: str
) -> None:
    if other == "OUT" and spelling == "hard link":
        return  # OUT does not exist yet
    taken = {"IN": source, "OUT": tmp_path / "out.ply"}.get(other, tmp_path / "given.file")
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1", "--overwrite"]
    if other.startswith("--"):
        taken.write_text("")
        words += [other, str(taken)]
    report = {
        "same": taken,
        "dots": tmp_path / "folder" / ".." / taken.name,
        "symlink": tmp_path / "link",
        "hard link": tmp_path / "twin",
    }[spelling]
    (tmp_path / "folder").mkdir()
    if spelling == "symlink":
        report.symlink_to(taken)
    if spelling == "hard link":
        report.hardlink_to(taken)
    before = taken.read_bytes() if taken.exists() else None
    if other == "--config":
        taken.write_text("seed = 3\n")
        before = taken.read_bytes()
    words += ["--report", str(report)]
    if report.suffix == ".ply":
        with pytest.raises(SystemExit, match="2"):
            main(words)
        said = f"argument --report: must be a .json file, found {str(report)!r}\n"
    else:
        assert main(words) == 1
        said = f"--report and {other} must be different files, found {report} for both.\n"
    assert capsys.readouterr().err.endswith(f" error: {said}")
    assert (taken.read_bytes() if taken.exists() else None) == before


def test_the_output_may_replace_the_input_but_no_other_file(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["simplify", str(source), str(source), "--rho", "0.1", "--overwrite", "--quiet"]
    assert main(words) == 0
    assert len(cvtgs.load(source)) == 30
    boxes = tmp_path / "boxes.ply"
    boxes.write_text("[]")
    assert main(["simplify", str(source), str(boxes), *words[3:], "--keep", str(boxes)]) == 1
    assert "OUT and --keep must be different files" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (errno.ENOSPC, "must be writable, found: no space left on device"),
        (errno.EIO, "must be writable"),
    ],
)
def test_a_failed_report_keeps_the_scene_and_is_reported(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
    text: str,
) -> None:
    output, report, sync = tmp_path / "out.ply", tmp_path / "report.json", os.fsync

    def fail(descriptor: int) -> None:
        if output.exists():
            raise OSError(number, os.strerror(number))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fail)
    words = ["simplify", str(source), str(output), "--rho", "0.1", "--report", str(report)]
    assert main(words) == 1
    error = capsys.readouterr().err
    assert text in error
    assert "nothing was written" not in error
    assert error.endswith(f"; the scene {output} was written, the report was not.\n")
    assert len(cvtgs.load(output)) == 30
    assert not report.exists()


COMMANDS = {
    "levels": "levels {}/in.ply -o {}/out --rho 0.1 --no-scores --quiet",
    "stream": "levels {}/in.ply -o {}/out --rho 0.5,0.1 --stream sog --quiet",
    "render": "render {}/in.ply -o {}/out --views 1 --size 16 --quiet",
    "compare": "compare {}/in.ply {}/in.ply -o {}/out --quiet",
    "tradeoff": "tradeoff {}/in.ply -o {}/out --presets draft --quiet",
    "train": "train {}/tiny.toml -o {}/out.safetensors --quiet",
}


@pytest.fixture
def scene(tmp_path):
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0), tmp_path / "in.ply")
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_run_is_refused_before_it_writes(scene, capsys, name):
    words = COMMANDS[name].replace("{}", str(scene)).split()
    output = scene / ("out.safetensors" if name == "train" else "out")
    with folder_lock(output):
        assert main(words) == 1
    error = capsys.readouterr().err
    start = f"cvtgs: error: {output}: only one run at a time may work on it, found "
    assert error.startswith(start)
    assert error.count("\n") == 1
    assert sorted(path.name for path in scene.iterdir()) == ["in.ply"]


def test_a_refused_run_leaves_the_folder_of_the_other_one(scene, monkeypatch):
    """That run has made it since, and has not written to it yet."""

    @contextmanager
    def busy(options):
        options.output.mkdir()
        raise OutputBusyError("at work")
        yield

    monkeypatch.setattr("cvtgs.cli.main._lock", busy)
    assert main(COMMANDS["levels"].replace("{}", str(scene)).split()) == 1
    assert (scene / "out").is_dir()


@pytest.mark.parametrize("name", ["levels", "stream", "render"])
def test_no_lock_file_is_left(scene, name):
    assert main(COMMANDS[name].replace("{}", str(scene)).split()) == 0
    assert sorted(path.name for path in scene.iterdir()) == ["in.ply", "out"]
    assert not list((scene / "out").rglob(".*"))


@pytest.mark.parametrize("name", [*COMMANDS, "demo", "cameras"])
def test_a_name_that_is_too_long_is_one_sentence(scene, capsys, name):
    others = {"demo": "demo -o {}/out", "cameras": "render {}/in.ply -o {}/new --cameras {}/out"}
    words = (COMMANDS | others)[name].replace("{}/out", "{}/" + "x" * 300)
    assert main(words.replace("{}", str(scene)).split()) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "name too long" in error
    assert [path.name for path in scene.iterdir()] == ["in.ply"]


@pytest.mark.parametrize("name", ["levels", "stream", "render"])
def test_a_folder_may_have_the_longest_name(scene, name):
    """Its lock, and what is hidden beside it, would have more than 255 bytes."""
    longest = "x" * 255
    words = COMMANDS[name].replace("{}/out", "{}/" + longest).replace("{}", str(scene)).split()
    assert main(words) == 0
    assert sorted(path.name for path in scene.iterdir()) == ["in.ply", longest]


def test_every_command_with_a_lock_has_an_output():
    for command in WRITE_SEVERAL:
        assert "-o" in build_parser()._subparsers._group_actions[0].choices[command].format_help()


def test_the_lock_is_inside_if_the_parent_is_not_writable(tmp_path, monkeypatch):
    home = tmp_path / "home"
    (home / "out").mkdir(parents=True)
    allowed = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: str(path) != str(home) and allowed(path, mode)
    )
    with folder_lock(home / "out"):
        assert [path.name for path in (home / "out").iterdir()] == [".lock"]
        with pytest.raises(OutputBusyError), folder_lock(home / "out"):
            pass
    assert list((home / "out").iterdir()) == []


def test_a_missing_parent_is_left_to_the_command_to_report(tmp_path):
    with folder_lock(tmp_path / "missing" / "out"):
        assert list(tmp_path.iterdir()) == []
    assert lock_path(tmp_path / "out") == tmp_path / ".out.lock"


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="needs /dev/fd")
def test_a_link_to_a_pipe_is_no_output():
    reading, writing = os.pipe()
    with pytest.raises(OutputError, match="a regular file, found a device or a pipe"):
        cvtgs.io.check_output(f"/dev/fd/{writing}", overwrite=True)
    os.close(reading)
    os.close(writing)
