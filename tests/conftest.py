"""Fixtures that several folders share, and one thread per process where tests run in parallel."""

import os
import signal

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported
    os.environ["OMP_NUM_THREADS"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in what a shell runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

from importlib import import_module

import pytest


@pytest.fixture
def coarse_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look through a grid of 16 voxels a side, not 128, which takes most of the time there."""
    monkeypatch.setattr(import_module("cvtgs.analysis.visibility"), "HALF_GRID", 8)
