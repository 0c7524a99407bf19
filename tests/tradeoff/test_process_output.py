"""The output of processes as Windows writes it: other line ends, another encoding."""

import sys

import pytest

from cvtgs.errors import RunError
from cvtgs.tradeoff.measure import run_process


def test_the_output_of_a_process_on_windows_is_read(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "cp1252")  # of its pipes
    code = "import sys; sys.stdout.reconfigure(newline='\\r\\n'); print('K\\xfcche')"
    assert run_process([sys.executable, "-c", code]).output == "K\xfcche\n"
    with pytest.raises(RunError, match=r"^K\xfcche is missing$"):
        run_process([sys.executable, "-c", "import sys; sys.exit('K\\xfcche is missing')"])
