"""Loading torch: settings of idle threads and garbage collection."""

import gc
import json
import os
import subprocess
import sys
from importlib import import_module

import pytest

from cvtgs.startup import load_torch

NAMES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
LOAD = f"""
import gc, json, os, sys
from cvtgs.startup import load_torch
assert "torch" not in sys.modules
load_torch()
found = [os.environ.get(name) for name in {NAMES}]
print(json.dumps([found, "torch" in sys.modules, gc.isenabled(), gc.get_freeze_count()]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({}, ["PASSIVE", "1000"]),
        ({"GOMP_SPINCOUNT": "7"}, ["PASSIVE", "7"]),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, ["ACTIVE", None]),
    ],
)
def test_threads_spin_for_a_moment_and_collections_skip_loaded_modules(given, wanted):
    environment = {name: value for name, value in os.environ.items() if name not in NAMES}
    done = subprocess.run(
        [sys.executable, "-c", LOAD],
        env=environment | given,
        capture_output=True,
        check=True,
        text=True,
    )
    found, is_loaded, collects, frozen = json.loads(done.stdout)
    assert found == wanted
    assert is_loaded
    assert collects
    assert frozen > 100_000


def test_a_process_that_has_loaded_torch_keeps_its_settings(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    import_module("torch")
    before = gc.get_freeze_count()
    load_torch()
    assert gc.get_freeze_count() == before
    assert not any(name in os.environ for name in NAMES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["doctor"], "asked before\n"),
        (["simplify", "in.ply", "out.ply", "--rho", "0.1"], "asked before\n"),
        (["simplify", "in.ply", "out.ply", "--count", "50k"], "asked before\n"),
        (["completion", "bash"], ""),
    ],
)
def test_every_command_but_completion_loads_torch_this_way(words, wanted):
    code = (
        "import sys; from cvtgs.cli import main\n"
        "def asked(): sys.exit('asked ' + ('after' if 'torch' in sys.modules else 'before'))\n"
        "main.load_torch = asked; main.main(sys.argv[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, check=False, text=True
    )
    assert done.stderr == wanted


@pytest.mark.slow
def test_a_program_that_disabled_collections_stays_without_them():
    code = "import gc; gc.disable(); from cvtgs.startup import load_torch; load_torch()"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; print(gc.isenabled())"],
        capture_output=True,
        check=True,
        text=True,
    )
    assert done.stdout == "False\n"


@pytest.mark.slow
def test_simplifying_loads_no_package_that_it_does_not_need() -> None:
    """Some parts of torch, such as its device meta, load sympy: 0.3 s and 45 MB."""
    code = (
        "import sys\n"
        "import cvtgs\n"
        "scene = cvtgs.synthetic.scene('object', 500)\n"
        "assert len(cvtgs.Simplifier(device='cpu').simplify(scene, 0.1)) == 50\n"
        "heavy = {'sympy', 'mpmath', 'torch._dynamo', 'kornia', 'numba', 'PIL', 'matplotlib'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert found == "[]\n"
