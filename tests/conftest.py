"""Fixtures that several folders share, and one thread per process where tests run in parallel."""

import os
import signal
import sys
from collections.abc import Iterator

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported
    os.environ["OMP_NUM_THREADS"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in background jobs of a shell
    signal.signal(signal.SIGINT, signal.default_int_handler)

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from viewer_pages import Pictured, Served, pictured_scene

SLOW_EXAMPLES = {"cvtgs.tradeoff.measure.measure_tradeoff", "cvtgs.train.loop.train"}
"""Examples of docstrings that take more than a second."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the slow examples, which cannot carry a marker themselves."""
    for item in items:
        if item.name in SLOW_EXAMPLES:
            item.add_marker("slow")


@pytest.fixture
def coarse_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute visibility on a grid of 16 voxels a side; 128 would take most of the test time."""
    monkeypatch.setattr(import_module("cvtgs.analysis.analyze"), "HALF_GRID", 8)


@pytest.fixture
def without_viser(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a stand-in in the place of viser and its server, which need not be installed."""
    monkeypatch.setitem(sys.modules, "viser", import_module("viser_stand_in"))
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", SimpleNamespace(serve=None))


@pytest.fixture(scope="session")
def pictured() -> Pictured:
    return pictured_scene()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    server = Served(tmp_path)
    yield server
    server.close()


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let torch and chunks use two threads, on any machine."""
    monkeypatch.setattr("cvtgs.devices.thread_count", lambda: 2)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)
