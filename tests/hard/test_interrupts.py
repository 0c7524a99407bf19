"""Interrupts, kills and full disks at any moment of writing: the old file, the new one, or none."""

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NoReturn

import pytest
import torch

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import OutputError
from cvtgs.io import atomic_output
from cvtgs.io.tensors import save_tensors
from cvtgs.processes import _hangup_ignored
from hard_cases import CASES

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
HOMES = ("/cvtgs/io/",)


def scene():
    return CASES["ball"](20, torch.float32)


WRITERS: dict[str, Callable[[Path, bool], None]] = {
    "scene": lambda path, overwrite: cvtgs.save(scene(), path, overwrite=overwrite),
    "tensors": lambda path, overwrite: save_tensors(path, {"a": torch.arange(99.0)}, {"by": "me"}),
}
STEPS = {"scene": 23, "tensors": 5}
"""Number of lines between the moments of signals, for a few dozen signals per writer."""


def leave(number: int, frame: FrameType | None) -> NoReturn:
    sys.exit(143)  # as the command line does


def in_child(action: Callable[[], None], *, moment: int, number: int) -> int:
    """Fork, send a signal at a given line of the writing code, and return the exit status."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the child starts no threads
        process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    lines = 0

    def trace(frame: FrameType, event: str, value: object) -> object:
        nonlocal lines
        if not any(home in frame.f_code.co_filename for home in HOMES):
            return None
        if event == "line":
            lines += 1
            if lines == moment:
                os.kill(os.getpid(), number)
        return trace

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, leave)
        sys.settrace(trace)
        action()
    except BaseException:  # of any kind; pytest must not see it
        os._exit(1)
    os._exit(0)


@pytest.fixture(params=[b"old", None], ids=["over an old file", "as a new file"])
def old(request) -> bytes | None:
    return request.param


@pytest.mark.long
@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM", "SIGKILL"])  # Windows lacks one
@pytest.mark.parametrize("name", WRITERS)
def test_an_interrupt_leaves_the_old_file_no_file_or_the_new_file(tmp_path, name, sent, old):
    write, number = WRITERS[name], signal.Signals[sent]
    write(tmp_path / "whole.ply", False)
    new, path, ends, litter = (tmp_path / "whole.ply").read_bytes(), tmp_path / "a.ply", set(), 0
    for moment in range(1, 100_000, STEPS[name]):
        path.unlink(missing_ok=True)
        if old is not None:
            path.write_bytes(old)
        code = in_child(lambda: write(path, True), moment=moment, number=number)
        found = path.read_bytes() if path.exists() else None
        assert found in (old, new)
        ends.add(found)
        rest = [p for p in tmp_path.iterdir() if p not in (path, tmp_path / "whole.ply")]
        assert all(p.name.startswith(".a.ply.") and p.suffix == ".tmp" for p in rest)
        litter += len(rest)
        if rest:
            write(path, True)  # the next run removes leftovers
            assert {*tmp_path.iterdir()} == {path, tmp_path / "whole.ply"}
        if code == 0:
            break
    assert code == 0  # the last moment was after the last line
    assert moment > 8 * STEPS[name]
    assert ends == {old, new}
    # A kill leaves its temporary file; other signals only at the lines that open or remove it.
    assert litter > 0 if sent == "SIGKILL" else litter <= 4


@pytest.mark.skipif(sys.platform != "linux", reason="limits the file size as Linux does")
@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_full_disk_leaves_the_old_file_or_no_file(tmp_path, write, old):
    import resource  # noqa: PLC0415 (not on Windows)

    write(tmp_path / "whole.ply", False)
    size, path = (tmp_path / "whole.ply").stat().st_size, tmp_path / "a.ply"
    if old is not None:
        path.write_bytes(old)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for room in sorted({0, 1, size // 3, size // 2, size - 1}):
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
            with pytest.raises(OutputError, match="must be writable, found: file too large"):
                write(path, True)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert (path.read_bytes() if path.exists() else None) == old
        assert len(list(tmp_path.iterdir())) == 1 + (old is not None)
    write(path, True)
    assert path.read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_an_invalid_scene_leaves_no_file(tmp_path):
    bad = cvtgs.GaussianScene(**scene().tensors(), comments=("two\nlines",))
    with pytest.raises(cvtgs.errors.InvalidSceneError):
        cvtgs.save(bad, tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_two_writers_of_the_same_file_do_not_mix(tmp_path):
    path = tmp_path / "a.bin"
    with (
        atomic_output(path, overwrite=True) as one,
        atomic_output(path, overwrite=True) as other,
    ):
        one.write(b"1" * 1000)
        other.write(b"2" * 1000)
        one.write(b"1" * 1000)
    assert path.read_bytes() == b"1" * 2000
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("before", [signal.SIG_DFL, signal.SIG_IGN], ids=["terminal", "nohup"])
def test_a_closed_terminal_ends_a_run_unless_nohup_started_it(before, monkeypatch, capsys):
    def show(options):
        signal.raise_signal(signal.SIGHUP)

    monkeypatch.setattr("cvtgs.cli.files.show_info", show)
    original = signal.signal(signal.SIGHUP, before)
    try:
        assert main(["info", "a.ply"]) == (0 if before == signal.SIG_IGN else 129)
        assert signal.getsignal(signal.SIGHUP) == before
    finally:
        signal.signal(signal.SIGHUP, original)
    assert capsys.readouterr() == ("", "")


HANGUP = """
import os, signal, sys, time
from cvtgs.processes import LocalWorkers

def stop(number, frame):
    sys.exit(129)

if __name__ == "__main__":
    signal.signal(signal.SIGHUP, stop)
    with LocalWorkers(2) as workers:
        list(workers(abs, [1, 2]))  # both have started
        os.killpg(0, signal.SIGHUP)
        time.sleep(20)
"""


@pytest.mark.long
def test_a_closed_terminal_leaves_the_end_of_workers_to_their_parent(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(HANGUP)
    done = subprocess.run(
        [sys.executable, program],
        capture_output=True, text=True, check=False, start_new_session=True, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (129, "")


def test_the_handler_of_a_program_around_python_stays(monkeypatch):
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with _hangup_ignored():
            assert signal.signal(signal.SIGHUP, signal.SIG_DFL) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_signal_does_not_interrupt_what_the_first_one_ends(monkeypatch, capsys):
    ended = []

    def run(options):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGTERM)  # here, calls wait for their threads
            ended.append(True)

    monkeypatch.setattr("cvtgs.cli.files.show_info", run)
    assert (main(["info", "a.ply"]), ended) == (130, [True])
    monkeypatch.setattr("cvtgs.cli.main.PATIENCE", 0.0)
    assert (main(["info", "a.ply"]), ended) == (143, [True])
