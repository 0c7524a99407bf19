"""The shipped checkpoints do what they did when the golden table was written."""

import json

import pytest

import regenerate_golden as golden

RENEW = "run `python tests/regenerate_golden.py`, look at the difference and commit it"


@pytest.fixture(scope="module")
def table() -> dict:
    return json.loads(golden.TABLE.read_text(encoding="utf-8"))


def test_the_table_is_of_the_shipped_checkpoints(table):
    assert table["digests"] == golden.digests(), f"a shipped checkpoint has changed: {RENEW}"
    assert list(table["figures"]) == golden.CASES, f"the cases have changed: {RENEW}"


@pytest.mark.parametrize("case", golden.CASES)
def test_golden_output(table, case):
    found, wanted = golden.figures(case), table["figures"][case]
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=1e-3, abs=1e-6), f"{name}: {RENEW}"
