"""A few faults of every kind; ``nox -s faults`` does hundreds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks and limits as Linux does")
def test_every_fault_leaves_whole_files_or_none():
    """By another process: forks of one that runs tests would inherit its threads."""
    words = ["--kills", "6", "--pairs", "2", "--limits", "1", "--count", "2000"]
    words += ["--commands", "plain", "blocks", "convert", "--seed", "7"]
    path = os.pathsep.join([str(HERE), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, str(HERE / "faults.py"), *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert sum(int(part.split()[0]) for part in done.stdout.split(", ")) == 6 + 2 + 2
