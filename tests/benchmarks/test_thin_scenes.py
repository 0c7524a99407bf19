"""Cells with and without representatives on points and needles."""

import sys

import pytest

from benchmarks import thin_scenes


@pytest.mark.slow
def test_methods_keep_the_number_that_cvtgs_keeps(monkeypatch, capsys):
    counts = []
    monkeypatch.setattr(thin_scenes, "simplified", lambda _, count, how: counts.append(count))
    monkeypatch.setattr(thin_scenes, "keep_most_mass", lambda _, count: counts.append(count))
    monkeypatch.setattr(thin_scenes, "score_views", lambda *_: {})
    monkeypatch.setattr(
        sys, "argv", ["thin_scenes", "--case", "points", "--count", "101", "--rho", "0.07"]
    )
    thin_scenes.main()
    assert counts == [8] * 5  # 7.07 of 101
