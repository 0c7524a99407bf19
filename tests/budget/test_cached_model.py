"""The measured cost model in the cache of the user."""

import json
import os
import time
from pathlib import Path

import pytest

import cvtgs
from cvtgs.budget import CostModel, cost_model
from cvtgs.budget.calibrate import STALE_SECONDS, cache_folder, is_calibrated
from cvtgs.budget.costs import FEATURES
from cvtgs.errors import DeviceError


@pytest.fixture
def model() -> CostModel:
    return CostModel(rates={name: {names[0]: 1.0} for name, names in FEATURES.items()})


class Calibration:
    """Counts how often it is called."""

    def __init__(self, model: CostModel) -> None:
        self.model, self.calls = model, 0

    def __call__(self) -> CostModel:
        self.calls += 1
        return self.model


def test_the_cost_model_is_measured_once_and_cached(model, tmp_path):
    calibration = Calibration(model)
    folder = tmp_path / "cache"
    assert not is_calibrated("cpu", folder=folder)
    assert cost_model("cpu", calibration=calibration, folder=folder) == model
    assert is_calibrated("cpu", folder=folder)
    assert cost_model("cpu", calibration=calibration, folder=folder) == model
    assert calibration.calls == 1
    cost_model("cpu", recalibrate=True, calibration=calibration, folder=folder)
    assert calibration.calls == 2


def damaged(text: str) -> str:
    return text[: len(text) // 2]


def stale(text: str) -> str:
    return text.replace('"made"', f'"made": {time.time() - STALE_SECONDS - 1}, "was"')


def changed(key: str, value: object):
    def change(text: str) -> str:
        record = json.loads(text)
        record[key] = value
        return json.dumps(record)

    return change


@pytest.mark.parametrize(
    "change",
    [
        damaged,
        stale,
        lambda text: "",
        lambda text: "\x00\xff",
        changed("made", 1.0),
        changed("made", time.time() + 1e6),
        changed("version", 0),
        changed("key", {}),
        changed("model", {"rates": {}}),
        changed("model", {"rates": {name: {"in": -1.0} for name in FEATURES}}),
        changed("model", {"rates": {"check": {"in": 1.0}}}),
    ],
)
def test_an_unusable_cache_is_measured_again(model, tmp_path, change):
    calibration = Calibration(model)
    cost_model("cpu", calibration=calibration, folder=tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_text(change(path.read_text()))
    assert cost_model("cpu", calibration=calibration, folder=tmp_path) == model
    assert calibration.calls == 2
    assert cost_model("cpu", calibration=calibration, folder=tmp_path) == model
    assert calibration.calls == 2


def test_changed_presets_are_measured_again(model, tmp_path, monkeypatch):
    calibration = Calibration(model)
    cost_model("cpu", calibration=calibration, folder=tmp_path)
    other = {**cvtgs.PRESETS, "draft": {"cvt": {"iterations": 1}}}
    monkeypatch.setattr("cvtgs.config.simplify.PRESETS", other)
    cost_model("cpu", calibration=calibration, folder=tmp_path)
    assert calibration.calls == 2


def test_without_a_writable_cache_the_model_is_still_measured(model, tmp_path):
    """Once in a process, which says so."""
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    calibration = Calibration(model)
    with pytest.warns(UserWarning, match="the measurement of this machine is not saved, the next"):
        assert cost_model("cpu", calibration=calibration, folder=blocked / "cache") == model
    assert is_calibrated("cpu", folder=blocked / "cache")
    assert cost_model("cpu", calibration=calibration, folder=blocked / "cache") == model
    assert calibration.calls == 1
    assert blocked.read_text() == "no folder"


def test_a_measurement_that_is_saved_replaces_one_that_was_not(model, tmp_path):
    blocked = tmp_path / "cache"
    blocked.write_text("no folder")
    with pytest.warns(UserWarning, match="is not saved"):
        cost_model("cpu", calibration=lambda: model, folder=blocked)
    blocked.unlink()
    other = CostModel(rates={name: {names[0]: 2.0} for name, names in FEATURES.items()})
    cost_model("cpu", recalibrate=True, calibration=lambda: other, folder=blocked)
    assert cost_model("cpu", calibration=lambda: model, folder=blocked) == other


def test_the_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "cvtgs"
    monkeypatch.setenv("XDG_CACHE_HOME", "here")  # relative ones are invalid
    assert cache_folder() != Path("here/cvtgs")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    if os.name == "posix":
        assert cache_folder().parent.parent in (tmp_path, tmp_path / "Library")


def test_a_missing_device_is_an_error(tmp_path):
    with pytest.raises(DeviceError):
        cost_model("abacus", folder=tmp_path)
