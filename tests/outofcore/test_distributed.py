"""Blocks on a cluster of processes: the same bits, also when a worker is killed."""

import os
import signal

import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import MissingDependencyError
from cvtgs.outofcore import simplify_distributed, simplify_file
from cvtgs.outofcore.distributed import connect

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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_killed_worker_changes_nothing(cluster, source, tmp_path):
    from distributed import Client  # noqa: PLC0415 (optional)

    alone, together = tmp_path / "alone.ply", tmp_path / "together.ply"
    simplify_file(source, alone, 0.05, blocks=BLOCKS, range_rows=6000)
    killed = []

    def kill_one(event):
        if event.stage == "blocks" and event.done == 2 and not killed:
            killed.append(next(iter(cluster.workers.values())).process.pid)
            os.kill(killed[0], signal.SIGKILL)

    with Client(cluster) as client:
        report = simplify_distributed(
            source, 0.05, client,
            output=together, blocks=BLOCKS, range_rows=6000, listener=kill_one,
        )  # fmt: skip
    assert killed
    assert report.output_count == 1000
    assert together.read_bytes() == alone.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alone.ply", "together.ply"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_command(cluster, source, tmp_path):
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.01", "--quiet"]
    assert main([*words, "--scheduler", cluster.scheduler_address]) == 0
    assert len(cvtgs.load(tmp_path / "out.ply")) == 200


@pytest.mark.slow
def test_without_the_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'cvtgs\[dask\]'"):
        connect("tcp://127.0.0.1:1")
