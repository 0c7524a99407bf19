"""Every way of simplifying gives the results in ``digests.json``, as ``tests/digests.py`` checks.

The bits are the same if processor and libraries round like those of the table; otherwise the counts
are the same, and the sums of every tensor nearly so.
"""

import json
import os
import subprocess
import sys

import pytest
import torch

import digests

RECORDED = json.loads(digests.FILE.read_text(encoding="utf-8"))
DEAR = ("large", "matched", "high", "block")
CASES = [
    pytest.param(name, marks=[pytest.mark.slow] * any(word in name for word in DEAR))
    for name in digests.CASES
]


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def assert_nearly(found, wanted):
    """Compare roughly: if one seed differs, one cell in a hundred may differ."""
    assert found["counts"] == wanted["counts"]
    assert found["figures"] == pytest.approx(wanted["figures"], rel=0.05, abs=0.1)


@pytest.mark.parametrize("name", CASES)
def test_every_way_gives_the_recorded_result(name):
    found, wanted = digests.measure(name), RECORDED["cases"][name]
    assert_nearly(found, wanted)
    if digests.rounds_like(RECORDED):
        assert found["digest"] == wanted["digest"]


OLD_PROCESSOR = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE"}
"""Variables that make torch and MKL compute as on a processor without vector instructions."""


@pytest.mark.long
def test_another_processor_gives_nearly_the_same():
    """Generated scenes are the same up to rounding, so tests do not depend on the machine."""
    kinds = list(digests.KINDS)
    names = [f"scene {kind}" for kind in kinds] + [f"{kind} standard 0.01" for kind in kinds]
    done = subprocess.run(
        [sys.executable, digests.__file__, "--print", *names],
        env=os.environ | OLD_PROCESSOR,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    there = json.loads(done.stdout)
    for name in names:
        here = digests.measure(name)
        assert_nearly(there[name], here)
        if name.startswith("scene"):
            assert there[name]["figures"] == pytest.approx(here["figures"], rel=1e-5)


def test_the_table_holds_all_cases_and_comparisons_can_fail():
    assert set(RECORDED["cases"]) == set(digests.CASES)
    wanted = RECORDED["cases"]["room standard 0.1"]
    for other in ("room standard 0.01", "haze standard 0.1", "room paper 0.1"):
        with pytest.raises(AssertionError):
            assert_nearly(RECORDED["cases"][other], wanted)
