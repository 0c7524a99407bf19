"""The plot of time against accuracy is written, or does without a folder or matplotlib."""

import pytest

from benchmarks import accuracy_and_time
from benchmarks.quality import Quality
from cvtgs.errors import MissingDependencyError


@pytest.fixture
def _quick(monkeypatch):
    found = {"draft": [Quality(psnr=20.0, ssim=0.5)]}
    monkeypatch.setattr(accuracy_and_time, "TABLES", {"presets": ("Presets", {"draft": {}})})
    monkeypatch.setattr(accuracy_and_time, "PRESETS", accuracy_and_time.TABLES["presets"][1])
    monkeypatch.setattr(accuracy_and_time, "warm_up", lambda: None)
    monkeypatch.setattr(accuracy_and_time, "measure", lambda *_: [{"thing": found}])
    monkeypatch.setattr(accuracy_and_time.Stopwatch, "seconds", lambda *_: 1.0)


@pytest.mark.usefixtures("_quick")
def test_the_folder_of_the_plot_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy_and_time, "chart", lambda *_: b"png")
    path = tmp_path / "new" / "plot.png"
    accuracy_and_time.main(["--rho", "0.1", "--png", str(path)])
    assert path.read_bytes() == b"png"


@pytest.mark.usefixtures("_quick")
def test_tables_are_printed_without_matplotlib(tmp_path, monkeypatch, capsys):
    def chart(*_):
        raise MissingDependencyError("install matplotlib.")

    monkeypatch.setattr(accuracy_and_time, "chart", chart)
    accuracy_and_time.main(["--rho", "0.1", "--png", str(tmp_path / "plot.png")])
    printed = capsys.readouterr()
    assert "| draft | 1.00 | 20.00 |" in printed.out
    assert printed.err == "without a plot: install matplotlib.\n"
