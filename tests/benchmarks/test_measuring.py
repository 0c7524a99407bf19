"""Costs of processes."""

import os

import pytest

from benchmarks.measuring import run_python


@pytest.mark.parametrize("path", [None, "other"])
def test_processes_can_import_benchmarks_from_any_folder(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    if path is not None:
        monkeypatch.setenv("PYTHONPATH", path)
    found = run_python("-c", "from importlib.util import find_spec; print(find_spec('benchmarks'))")
    assert "ModuleSpec" in found.output
    assert os.environ.get("PYTHONPATH") == path
