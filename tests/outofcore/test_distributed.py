"""Blocks on a cluster of processes: the same bits, even if a worker is killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any, cast

import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import InvalidSceneError, MissingDependencyError, RunError
from cvtgs.outofcore import ClusterWorkers, connect, distributed, simplify_file

BLOCKS = 10


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("cluster") / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 20_000, sh_degree=1, seed=4), path)
    return path


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed", reason="needs the extra cvtgs[dask]")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as found:
        yield found


def test_a_scheduler_that_has_just_ended_is_not_asked_for_workers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its client knows of none, and does not even say so."""
    monkeypatch.setattr(distributed, "ANSWER_SECONDS", 0.1)
    client = SimpleNamespace(
        scheduler=None, status="connecting", scheduler_info=lambda n_workers: {"type": "Scheduler"}
    )
    job = SimpleNamespace(path=lambda name: tmp_path / name)
    with pytest.raises(RunError, match="the scheduler or all of its workers are gone"):
        ClusterWorkers(cast("Any", client)).check(cast("Any", job))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_killed_worker_does_not_change_the_output(cluster, source, tmp_path):
    from distributed import Client  # noqa: PLC0415 (optional)

    alone, together = tmp_path / "alone.ply", tmp_path / "together.ply"
    simplify_file(source, alone, 0.05, blocks=BLOCKS, range_rows=6000)
    killed = []

    def kill_one(event):
        if event.stage == "blocks" and event.done == 2 and not killed:
            killed.append(next(iter(cluster.workers.values())).process.pid)
            os.kill(killed[0], signal.SIGKILL)

    with Client(cluster) as client:
        report = simplify_file(
            source, together, 0.05,
            workers=ClusterWorkers(client), blocks=BLOCKS, range_rows=6000, listener=kill_one,
        )  # fmt: skip
    assert killed
    assert report.output_count == 1000
    assert together.read_bytes() == alone.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alone.ply", "together.ply"]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_the_command_simplifies_on_a_cluster(cluster, source, tmp_path):
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.01", "--quiet"]
    assert main([*words, "--scheduler", cluster.scheduler_address]) == 0
    assert len(cvtgs.load(tmp_path / "out.ply")) == 200


@pytest.mark.slow
def test_without_the_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "cvtgs\[dask\]"'):
        connect("tcp://127.0.0.1:1")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_relative_path_starts_at_the_folder_of_the_caller(cluster, source, tmp_path, monkeypatch):
    monkeypatch.chdir(source.parent)
    with connect(cluster.scheduler_address) as client:
        report = simplify_file(
            source.name, tmp_path / "out.ply", 0.01, workers=ClusterWorkers(client), blocks=3
        )
    assert report.output_count == 200
    assert report.stages[0].stage == "workers"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_without_workers_is_an_error(source, tmp_path, monkeypatch):
    package = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "ANSWER_SECONDS", 1.0)
    with (
        package.LocalCluster(n_workers=0, dashboard_address=None) as empty,
        connect(empty.scheduler_address) as client,
        pytest.raises(RunError, match="must have workers, found none within 1 s; start some with"),
    ):
        simplify_file(source, tmp_path / "out.ply", 0.01, workers=ClusterWorkers(client))


class Answers:
    """A client whose only worker gives a fixed answer or error."""

    def __init__(self, answer, error=None):
        self.answer, self.error, self.status = answer, error, "running"
        self.scheduler = None

    def scheduler_info(self, n_workers):
        return {"workers": {"tcp://10.0.0.2:1": {}}}

    def submit(self, function, *arguments, **options):
        if function is resolve_name:
            return self.Future("finished", None, cvtgs.__version__)
        return self.Future("error" if self.error else "finished", self.error, self.answer)

    def cancel(self, futures):
        pass

    class Future:
        def __init__(self, status, error, answer):
            self.status, self.error, self.answer = status, error, answer

        def exception(self):
            return self.error

        def result(self):
            return self.answer


@pytest.mark.parametrize(
    ("found", "error", "text"),
    [
        (
            "must see the input in.ply, found none",
            None,
            ": this worker must see the input in.ply, ",
        ),
        (None, ModuleNotFoundError("No module named 'cvtgs'"), "must have cvtgs .*No module named"),
    ],
)
def test_the_error_names_a_worker_that_cannot_do_the_job(tmp_path, monkeypatch, found, error, text):
    package = pytest.importorskip("distributed")
    monkeypatch.setattr(package, "wait", lambda futures, timeout: None)
    source = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=1), source)
    with pytest.raises(RunError, match=text) as caught:
        simplify_file(
            source, tmp_path / "out.ply", 0.1, blocks=2,
            workers=ClusterWorkers(Answers(found, error)),
        )  # fmt: skip
    assert "10.0.0.2" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_worker_says_what_it_lacks(tmp_path):
    folder = tmp_path / ".out.ply.blocks" / "key"
    folder.mkdir(parents=True)
    (tmp_path / "in.ply").write_bytes(b"12345")
    (folder / "probe").write_text("token")
    versions, source = distributed._versions(), str(tmp_path / "in.ply")
    problem, probe = distributed._problem, str(folder / "probe")
    assert problem(versions, source, 5, probe, "token") == ""
    others = problem({**versions, "cvtgs": "0.0.1"}, source, 5, probe, "token")
    assert f"found cvtgs {cvtgs.__version__} instead of 0.0.1; install" in others
    assert problem(versions, "no.ply", 5, probe, "token") == (
        "must see the input no.ply of 5 bytes under the same path, found none"
    )
    assert problem(versions, source, 7, probe, "token").endswith(", found 5 bytes")
    for place, wanted in ((probe, tmp_path), ("/nowhere/at/all/probe", "/nowhere")):
        text = problem(versions, source, 5, place, "another")
        assert text == (
            "must be able to read and write the output folder under the same path, found no access "
            f"to {wanted}"
        )


def test_a_worker_that_joins_later_with_another_version_is_refused():
    assert distributed._call(abs, distributed._versions(), -3) == 3
    wanted = "a worker must have the same package versions as its caller, found cvtgs .* instead"
    with pytest.raises(RunError, match=wanted):
        distributed._call(abs, {"cvtgs": "0.0.1"}, -3)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_errors_of_workers_are_reported_in_one_sentence(cluster, source):
    from distributed import Client  # noqa: PLC0415 (optional)

    def fails(kind, text, item):
        raise kind(text)

    with Client(cluster) as client:
        workers = ClusterWorkers(client)
        for kind, text, wanted in (
            (FileNotFoundError, "/data/x", "a worker failed: FileNotFoundError: /data/x; all"),
            (ValueError, "", "a worker failed: ValueError; all workers need"),
        ):
            with pytest.raises(RunError) as caught:
                list(workers(lambda item, k=kind, t=text: fails(k, t, item), [1]))
            assert str(caught.value).startswith(wanted)
            assert str(caught.value).endswith("run the same command again to continue.")
        with pytest.raises(InvalidSceneError, match="ours"):
            list(workers(lambda item: fails(InvalidSceneError, "ours", item), [1]))


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
@pytest.mark.parametrize("fault", ["no scheduler", "no cvtgs", "another cvtgs"])
def test_the_command_reports_cluster_failures_in_one_sentence(source, tmp_path, fault):
    """With a real scheduler that is killed, or a real worker without this version of cvtgs."""
    address, other = tmp_path / "scheduler.json", tmp_path / "other"
    other.mkdir()
    (other / "cvtgs.py").write_text(
        "__version__ = '0.0.1'\n" if fault == "another cvtgs" else "raise ImportError('no cvtgs')\n"
    )
    bare = {**os.environ, "PYTHONPATH": str(other)}
    whole = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    options = ["--scheduler-file", str(address), "--no-dashboard"]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, *more],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=env, cwd=tmp_path,
        )
        for kind, more, env in (
            ("scheduler", ["--port", "0"], whole),
            ("worker", ["--nthreads", "1", "--no-nanny"], whole if fault[:4] == "no s" else bare),
        )
    ]  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while not address.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        command = [sys.executable, "-m", "cvtgs", "simplify", str(source), str(tmp_path / "o.ply")]
        command += ["--rho", "0.05", "--scheduler", scheduler_address(address)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=whole) as run:
            if fault == "no scheduler":
                while not list(tmp_path.glob(".o.ply.blocks/*/*")) and run.poll() is None:
                    time.sleep(0.01)
                started[0].kill()
            _, errors = run.communicate(timeout=200)
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert "Traceback" not in errors
    assert run.returncode == 1
    assert errors.startswith("cvtgs: error: ")
    assert errors.count("\n") == 1
    wanted = {
        "no scheduler": "run the same command again to continue.",
        "no cvtgs": f"must have cvtgs {cvtgs.__version__}, found ImportError: no cvtgs; install",
        "another cvtgs": f"must have cvtgs {cvtgs.__version__}, found 0.0.1; install it",
    }
    assert wanted[fault] in errors


def scheduler_address(path: Path) -> str:
    return json.loads(path.read_text())["address"]
