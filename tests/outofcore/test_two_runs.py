"""Two runs with one output: the second is refused, and neither damages the output of the other."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import cvtgs
from cvtgs.errors import OutputBusyError, OutputError, RunError
from cvtgs.io.locks import lock_path, output_lock
from cvtgs.io.ply import open_rows
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.sort import sort_range

HOLD = """
import sys, time
from cvtgs.io.locks import output_lock
with output_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 3000, sh_degree=0, seed=4), path)
    return path


def test_a_lock_names_its_holder_and_leaves_no_file(tmp_path):
    path = tmp_path / "out.ply"
    with (
        output_lock(path),
        pytest.raises(OutputBusyError) as caught,
        output_lock(path),
    ):
        pass
    assert isinstance(caught.value, OutputError)
    assert f"found process {os.getpid()} on " in str(caught.value)
    assert str(path) in str(caught.value)
    with output_lock(path):  # it was released
        assert lock_path(path).exists()
    assert list(tmp_path.iterdir()) == []


def test_a_link_to_an_output_shares_its_lock(tmp_path):
    (tmp_path / "link.ply").symlink_to(tmp_path / "out.ply")
    with (
        output_lock(tmp_path / "out.ply"),
        pytest.raises(OutputBusyError),
        output_lock(tmp_path / "link.ply"),
    ):
        pass


def test_an_unreadable_lock_is_reported_as_another_process(tmp_path):
    path = tmp_path / "out.ply"
    for text in ("", "[]", "{}", json.dumps({"process": 3})):
        with output_lock(path):
            lock_path(path).write_text(text)
            with pytest.raises(OutputBusyError, match="found another process at work"):
                output_lock(path).__enter__()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
def test_the_lock_of_a_killed_process_is_free(tmp_path):
    path = tmp_path / "out.ply"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    assert process.stdout.readline() == "held\n"
    with pytest.raises(OutputBusyError, match=f"found process {process.pid} on "):
        output_lock(path).__enter__()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert lock_path(path).exists()
    with output_lock(path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_second_run_is_refused_and_changes_nothing(source, tmp_path):
    output, whole, refused = tmp_path / "out.ply", tmp_path / "whole.ply", []
    simplify_file(source, whole, 0.1, blocks=3)

    def again(event):
        with pytest.raises(OutputBusyError) as caught:
            simplify_file(source, output, 0.05, blocks=2, overwrite=True)
        refused.append(caught.value)

    simplify_file(source, output, 0.1, blocks=3, listener=again)
    assert len(refused) > 5
    assert output.read_bytes() == whole.read_bytes()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["in.ply", "out.ply", "whole.ply"]


class SortsTwice:
    """Workers that also sort each range for a worker taken for dead, once before and once after.

    The second one ends when the blocks are at work already, in the same folder.
    """

    def __init__(self) -> None:
        self.late = []

    def __call__(self, function, items):
        if function.func is sort_range:
            for item in items:
                function(item)  # its files are not adopted
            self.late = [lambda item=item: function(item) for item in items]
        elif self.late:
            for call in self.late:
                call()
            self.late = []
        return [function(item) for item in items]


@pytest.mark.slow
def test_late_results_of_a_worker_taken_for_dead_are_ignored(source, tmp_path):
    output, whole = tmp_path / "out.ply", tmp_path / "whole.ply"
    options = {"blocks": 3, "range_rows": 1000}
    simplify_file(source, whole, 0.1, **options)
    simplify_file(source, output, 0.1, workers=SortsTwice(), **options)
    assert output.read_bytes() == whole.read_bytes()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["in.ply", "out.ply", "whole.ply"]


@pytest.mark.slow
def test_a_worker_of_another_job_cannot_write(source, tmp_path):
    """Its folder is removed once another job writes the same output."""
    calls = []

    class Keeps:
        def __call__(self, function, items):
            calls.extend((function, item) for item in items)
            return [function(item) for item in items]

    simplify_file(source, tmp_path / "out.ply", 0.1, blocks=3, workers=Keeps())
    function, item = next(call for call in calls if call[0].func is sort_range)

    def write_late(event):
        with pytest.raises((OSError, cvtgs.errors.CvtgsError)):
            function(item)

    simplify_file(source, tmp_path / "out.ply", 0.2, blocks=2, overwrite=True, listener=write_late)
    assert len(cvtgs.load(tmp_path / "out.ply")) == 600


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["missing", "short"])
def test_missing_and_short_files_of_workers_are_refused(source, tmp_path, damage):
    def lossy(function, items):
        results = [function(item) for item in items]
        if function.func is sort_range:
            path = next((tmp_path / ".out.ply.blocks").glob("*/attempt_*"))
            path.unlink() if damage == "missing" else os.truncate(path, 40)
        return results

    wanted = "must see the output folder" if damage == "missing" else "bytes that were written"
    with pytest.raises(RunError, match=wanted):
        simplify_file(source, tmp_path / "out.ply", 0.1, blocks=3, workers=lossy)
    simplify_file(source, tmp_path / "out.ply", 0.1, blocks=3)
    assert len(open_rows(tmp_path / "out.ply").dtype) > 3


def test_a_folder_that_cannot_be_emptied_is_an_error(source, tmp_path):
    (tmp_path / ".out.ply.blocks").write_text("a file in its place")
    with pytest.raises(OutputError, match="must be replaceable by an empty folder"):
        simplify_file(source, tmp_path / "out.ply", 0.1, blocks=3)


@pytest.mark.skipif(sys.platform != "linux", reason="reads the maps of Linux")
def test_no_file_is_mapped_when_the_folder_is_removed(source, tmp_path, monkeypatch):
    """Windows does not remove mapped files."""
    seen, remove = [], shutil.rmtree

    def look(path, **options):
        maps = Path("/proc/self/maps").read_text(encoding="utf-8")
        seen.append([line for line in maps.splitlines() if f"{tmp_path}/.out.ply.blocks/" in line])
        remove(path, **options)

    monkeypatch.setattr(shutil, "rmtree", look)
    box = cvtgs.boxes.Box(min=(0, 0, 0), max=(9, 9, 9))
    simplify_file(source, tmp_path / "out.ply", 0.5, blocks=3, boxes=[box])
    assert seen == [[], []]  # before and after
