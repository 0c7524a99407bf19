"""Gains by height of the view, from end to end on a tiny scene."""

import sys

import pytest

import cvtgs
from benchmarks import heights

pytestmark = pytest.mark.slow


def test_every_variant_is_compared_with_standard_at_every_height(tmp_path, monkeypatch, capsys):
    file = tmp_path / "thing.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0), file)
    given = [str(file), "--rho", "0.1", "--views", "2", "--size", "24", "standard"]
    given.append("standard merge.inflation=2")
    monkeypatch.setattr(sys, "argv", ["heights", *given])
    heights.main()
    head, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in capsys.readouterr().out.splitlines()
    ]
    assert len(head) == 3 + len(heights.HEIGHTS)
    assert [row[:2] for row in rows] == [["thing", name] for name in ("standard", *given[-2:])]
    assert all(5 < float(value) < 60 for value in rows[0][2:])
    assert {float(value) for value in rows[1][2:]} == {0.0}
    assert any(float(value) != 0.0 for value in rows[2][2:])
