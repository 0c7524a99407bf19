"""Processes of a tradeoff: their start, and their output as Windows writes it."""

import sys

import pytest

from cvtgs.errors import RunError
from cvtgs.tradeoff.process_cost import START, run_process


def test_the_output_of_a_process_on_windows_is_read(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "cp1252")  # of its pipes
    code = "import sys; sys.stdout.reconfigure(newline='\\r\\n'); print('K\\xfcche')"
    assert run_process([sys.executable, "-c", code]).output == "K\xfcche\n"
    with pytest.raises(RunError, match=r"^K\xfcche is missing$"):
        run_process([sys.executable, "-c", "import sys; sys.exit('K\\xfcche is missing')"])


@pytest.mark.long
def test_the_start_of_a_run_is_measured_as_the_command_line_starts(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    shown = "import os; print(os.environ.get('OMP_WAIT_POLICY'), gc.get_freeze_count() > 0)"
    assert run_process([sys.executable, "-c", START + shown]).output == "PASSIVE True\n"


@pytest.mark.parametrize("name", ["selectors", "statistics"])
def test_processes_import_nothing_from_the_current_folder(tmp_path, monkeypatch, name):
    """The launcher imports the one, cvtgs the other."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"{name}.py").write_text("raise ImportError('of another program')")
    code = "import selectors, statistics; print('both')"
    assert run_process([sys.executable, "-c", code]).output == "both\n"
