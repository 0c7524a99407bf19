"""Predicted and measured seconds."""

import pytest

from benchmarks import cost_model


def test_a_size_below_all_scenes_is_refused_before_anything_is_measured(monkeypatch, capsys):
    monkeypatch.setattr(cost_model, "cost_model", None)
    with pytest.raises(SystemExit):
        cost_model.main(["--most", "10"])
    assert "--most must be at least 50,000; found 10." in capsys.readouterr().err
