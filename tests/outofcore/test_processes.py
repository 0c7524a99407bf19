"""Blocks in local processes: the same bits as in one process, errors, and how they end."""

import math
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import Future
from concurrent.futures.process import _ResultItem
from functools import partial
from multiprocessing.reduction import ForkingPickler
from types import SimpleNamespace
from unittest.mock import MagicMock

import psutil
import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.devices import core_count
from cvtgs.errors import (
    DroppedDataWarning,
    InputError,
    InvalidArgumentError,
    InvalidSceneError,
    OutputError,
    RunError,
)
from cvtgs.outofcore import LocalWorkers, simplify_file
from cvtgs.outofcore.memory import ROOMY_BYTES, worker_count
from cvtgs.processes import MOST_SENT, _call
from process_cases import caution, die, fail, miss, numbered, refuse, wait

pytestmark = pytest.mark.slow  # every process loads torch


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("processes") / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("courtyard", 20_000, sh_degree=1, seed=4), path)
    return path


on_posix = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


@pytest.fixture(scope="module")
def workers():
    with LocalWorkers(2) as found:
        yield found


@pytest.mark.long
def test_workers_give_the_same_bits_and_progress_as_one_process(source, tmp_path, workers):
    events = {}
    for name, more in {"alone": {}, "together": {"workers": workers}}.items():
        seen = events[name] = []
        output = tmp_path / f"{name}.ply"
        simplify_file(source, output, 0.05, blocks=4, range_rows=6000, listener=seen.append, **more)
    assert (tmp_path / "together.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
    assert events["together"] == events["alone"]


def test_calls_are_shared_and_results_in_order(workers):
    found = list(workers(numbered, range(40)))
    assert [number for number, _, _ in found] == list(range(40))
    assert {threads for _, _, threads in found} == {max(1, core_count() // 2)}
    assert os.getpid() not in {pid for _, pid, _ in found}


def test_no_wait_for_a_result_is_longer_than_a_second(workers, monkeypatch):
    """On Windows, Ctrl-C does not end a wait."""
    waits, true = [], threading.Condition.wait

    def look(self, timeout=None):
        if threading.current_thread() is threading.main_thread():
            waits.append(timeout or math.inf)
        return true(self, timeout)

    monkeypatch.setattr(threading.Condition, "wait", look)
    assert list(workers(time.sleep, [0.2])) == [None]
    assert 0 < max(waits) <= 1


def test_errors_of_workers_reach_the_caller(workers):
    with pytest.raises(InvalidSceneError, match="0: found none"):
        list(workers(refuse, range(3)))
    with pytest.raises(RunError, match="a worker process failed: TwoWordsError: no"):
        list(workers(fail, range(3)))
    assert [number for number, _, _ in workers(numbered, [7])] == [7]


@pytest.mark.parametrize(
    ("function", "kind"), [(refuse, InvalidSceneError), (miss, InputError), (fail, RunError)]
)
def test_errors_of_workers_say_where_they_were_raised(workers, function, kind):
    with pytest.raises(kind) as caught:
        list(workers(function, range(3)))
    (note,) = caught.value.__notes__
    assert note.startswith("In a worker process:\nTraceback")
    assert f"in {function.__name__}" in note


def test_large_results_come_through_files_that_are_removed(workers, tmp_path, monkeypatch):
    assert list(workers(bytes, [10, 3_000_000])) == [bytes(10), bytes(3_000_000)]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with LocalWorkers(1) as found:
        (folder,) = tmp_path.iterdir()
        assert list(found(bytes, [3_000_000])) == [bytes(3_000_000)]
        assert list(folder.iterdir()) == []
        results = found(bytes, [3_000_000, 5_000_000])  # one of them is never taken
        next(results)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [0, MOST_SENT - 100, MOST_SENT, 10**6])
def test_a_process_never_leaves_a_part_of_a_result_in_the_pipe(size, tmp_path):
    """A pipe takes up to PIPE_BUF bytes as a whole; for the rest of more, the pool would wait."""
    found = _call(pickle.dumps((bytes, size)), str(tmp_path))
    message = ForkingPickler.dumps(_ResultItem(10**9, result=found))
    assert len(message) + 4 <= 512  # the least PIPE_BUF; the pool adds the length
    assert bool(list(tmp_path.iterdir())) == (size > MOST_SENT - 50)


def test_no_room_for_a_result_is_one_sentence(tmp_path):
    with pytest.raises(OutputError, match="must be writable and have room for results of worker"):
        _call(pickle.dumps((bytes, 10**6)), str(tmp_path / "missing"))


def test_a_worker_that_dies_is_an_error():
    with LocalWorkers(1) as found:
        for _ in range(2):  # the second call finds the process gone
            with pytest.raises(RunError, match="most likely for lack of memory"):
                list(found(die, range(2)))


@on_posix
def test_a_worker_killed_while_it_starts_is_not_a_missing_guard():
    with LocalWorkers(2) as found:
        found._processes()[0].kill()
        with pytest.raises(RunError, match="most likely for lack of memory"):
            list(found(numbered, range(2)))


STARTING = """
import sys
import time
import torch  # every worker does the same, before it can ignore Ctrl-C itself
from cvtgs.outofcore import LocalWorkers
if __name__ == "__main__":
    with LocalWorkers(2) as workers:
        print(*(process.pid for process in workers._processes()), flush=True)
        for kind in sys.stdin:
            if kind == "work\\n":
                print(list(workers(abs, [-1])), flush=True)
            else:
                workers._pool.submit(time.sleep, 600)
                break
"""


@pytest.fixture
def starting(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(STARTING, encoding="utf-8")
    (tmp_path / "temporary").mkdir()
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    with subprocess.Popen([sys.executable, script], **pipes, text=True, env=environment) as running:
        yield running
        running.kill()


@pytest.mark.long
@on_posix
def test_an_interrupt_does_not_reach_starting_workers(starting):
    for pid in starting.stdout.readline().split():
        os.kill(int(pid), signal.SIGINT)  # as a terminal does, to all of them
    assert starting.communicate("work\n", timeout=60) == ("[1]\n", "")


@on_posix
def test_the_end_does_not_wait_for_calls_whose_results_nothing_takes(starting):
    """Ctrl-C in such a wait would leave the processes: before 3.13, Python takes it for over."""
    starting.stdout.readline()
    assert starting.communicate("leave\n", timeout=60) == ("", "")
    assert starting.returncode == 0


@pytest.mark.long
@on_posix
def test_workers_of_a_killed_process_remove_its_temporary_folder(starting, tmp_path):
    starting.stdout.readline()
    starting.stdin.write("work\n")
    starting.stdin.flush()
    starting.stdout.readline()
    assert len(list((tmp_path / "temporary").iterdir())) == 1
    starting.kill()
    end = time.monotonic() + 60
    while list((tmp_path / "temporary").iterdir()):
        assert time.monotonic() < end
        time.sleep(0.05)


@on_posix
def test_an_interrupt_ends_the_workers(tmp_path):
    def interrupt() -> None:
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    def interrupted() -> None:
        with LocalWorkers(2) as found:
            threading.Thread(target=interrupt, daemon=True).start()
            list(found(partial(wait, str(tmp_path)), range(4)))

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    pids = [int(path.name) for path in tmp_path.iterdir()]
    assert len(pids) == 2
    assert not any(psutil.pid_exists(pid) for pid in pids)


CODE = """
import sys, os
from cvtgs.outofcore import LocalWorkers, simplify_file
if __name__ == "__main__":
    with LocalWorkers(2) as workers:
        simplify_file(sys.argv[1], sys.argv[2], 0.05, blocks=8, workers=workers)
"""


@pytest.mark.long
@on_posix
@pytest.mark.parametrize("sign", ["SIGKILL", "SIGINT"])  # Windows lacks one
def test_no_process_is_left_behind_and_the_run_continues(source, tmp_path, sign):
    script, output = tmp_path / "run.py", tmp_path / "out.ply"
    script.write_text(CODE, encoding="utf-8")
    running = subprocess.Popen(
        [sys.executable, str(script), str(source), str(output)], stderr=subprocess.DEVNULL
    )
    folder = tmp_path / ".out.ply.blocks"
    while not list(folder.glob("*/sites_*_00001")):
        assert running.poll() is None
        time.sleep(0.01)
    children = psutil.Process(running.pid).children(recursive=True)
    running.send_signal(signal.Signals[sign])
    running.wait()
    _, left = psutil.wait_procs(children, timeout=300)  # they may get little processor time
    assert len(children) >= 2
    assert not left
    assert not output.exists()
    simplify_file(source, output, 0.05, blocks=8)
    simplify_file(source, tmp_path / "whole.ply", 0.05, blocks=8)
    assert output.read_bytes() == (tmp_path / "whole.ply").read_bytes()


@pytest.mark.parametrize(
    ("memory", "wanted", "found"),
    [(10**9, None, 1), (10**11, 3, 3), (8 * ROOMY_BYTES, 8, 4), (2**60, None, None)],
)
def test_the_number_of_workers_follows_memory_and_cores(memory, wanted, found):
    assert worker_count(memory, wanted) == (found or core_count())


def test_windows_gets_no_more_processes_than_a_pool_has_there(monkeypatch):
    pools = []
    monkeypatch.setattr(
        "cvtgs.processes.ProcessPoolExecutor",
        lambda count, *rest, **named: pools.append(count) or MagicMock(),
    )
    monkeypatch.setattr(sys, "platform", "win32")
    with LocalWorkers(100):
        pass
    assert (worker_count(2**60, 100), pools) == (61, [61])


@pytest.mark.long
def test_workers_of_the_command_share_the_memory(source, tmp_path, monkeypatch, capsys):
    plans = []
    true = cvtgs.outofcore.simplify_file

    def noting(*words, memory, workers, **more):
        plans.append((memory, workers is not None))
        return true(*words, blocks=4, workers=workers, **more)

    monkeypatch.setattr(cvtgs.outofcore, "simplify_file", noting)
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda source, memory, merging: 4)
    outputs = [tmp_path / "two.ply", tmp_path / "one.ply"]
    for output, count in zip(outputs, ("2", "1"), strict=True):
        words = ["simplify", str(source), str(output), "--rho", "0.05", "--memory", "6GB"]
        assert main([*words, "--workers", count]) == 0
    assert plans == [(3 * 10**9, True), (6 * 10**9, False)]
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    assert "In 4 blocks." in capsys.readouterr().out


def test_zero_workers_are_refused(source, tmp_path, capsys):
    words = ["simplify", str(source), str(tmp_path / "a.ply"), "--rho", "0.1", "--workers", "0"]
    assert main(words) == 1
    assert capsys.readouterr().err == "cvtgs: error: --workers must be at least 1, found 0.\n"


@pytest.mark.parametrize("count", [0, None, "2", 1.5, True])
def test_a_wrong_number_of_processes_is_refused(count):
    with pytest.raises(InvalidArgumentError, match="number of processes must be a whole number"):
        LocalWorkers(count)


def test_processes_must_be_started():
    with pytest.raises(InvalidArgumentError, match="workers run inside `with LocalWorkers"):
        next(LocalWorkers(1)(abs, [-1]))


def test_processes_that_have_ended_take_no_more_work():
    with LocalWorkers(1) as workers:
        pass
    with pytest.raises(InvalidArgumentError, match="workers run inside `with LocalWorkers"):
        next(workers(abs, [-1]))


def test_warnings_of_workers_reach_the_caller_once(workers):
    with pytest.warns(DroppedDataWarning) as caught:
        assert list(workers(caution, range(4))) == [0, 1, 2, 3]
    assert [str(one.message) for one in caught] == ["left out one."]


def test_workers_import_nothing_from_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "selectors.py").write_text("raise ImportError('of another program')")
    with LocalWorkers(1) as found:
        assert list(found(abs, [-1])) == [1]
    assert "PYTHONSAFEPATH" not in os.environ


def test_a_process_that_may_not_start_others_says_so(monkeypatch):
    monkeypatch.setitem(vars(multiprocessing.current_process())["_config"], "daemon", True)
    with pytest.raises(RunError, match=r"multiprocessing\.Pool may not start others; use"):
        LocalWorkers(2).__enter__()


def test_a_pool_may_be_broken_before_its_starts_have_failed():
    workers, start = LocalWorkers(1), Future()
    pool = SimpleNamespace(_processes={1: MagicMock(exitcode=1)})
    vars(workers).update(_pool=pool, _starts=[start])
    threading.Timer(0.1, start.set_exception, [OSError()]).start()
    error = vars(LocalWorkers)["_run_error"](workers)
    assert str(error).startswith("no worker process could start")


@pytest.mark.long
def test_a_script_without_a_guard_is_told_why_no_process_starts(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("""
from cvtgs.outofcore import LocalWorkers
with LocalWorkers(1) as workers:
    print(list(workers(abs, [-1])))
""")
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith("cvtgs.errors.RunError: no worker process could start; a script that")
