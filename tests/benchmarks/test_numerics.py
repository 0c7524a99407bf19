"""The table of numerical errors: its figures on scenes where they are known."""

import pytest
import torch

from benchmarks import numerics
from hard_cases import CASES

pytestmark = pytest.mark.slow

MARKS = "<!-- tables: python -m benchmarks.numerics -->", "<!-- end of tables -->"


@pytest.mark.slow
def test_errors_are_those_of_float32():
    found = numerics.figures(CASES["ball"], 200)
    assert 1 < found.condition < 1e4
    assert 0 < found.residual < 1e-13
    for value in (found.means, found.matrices, found.opacities, found.colors):
        assert 1e-9 < value < 1e-5
    assert found.images < 1e-4


def test_coarse_coordinates_show():
    near, far = (numerics.figures(CASES[name], 200).means for name in ("ball", "two_clusters"))
    assert far > 1000 * near


@pytest.mark.parametrize("name", ["nan_means", "one", "coincident", "tiny_world"])
def test_hard_cases_give_numbers(name):
    assert all(torch.isfinite(torch.tensor(numerics.figures(CASES[name], 60))))


def test_the_tables_of_a_page_are_renewed(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n")
    words = ["numerics", "--case", "ball", "three", "--count", "60", "--timed", "0"]
    monkeypatch.setattr("sys.argv", [*words, "-o", str(page)])
    numerics.main()
    text = page.read_text()
    assert text.startswith(f"before\n{MARKS[0]}\n\n| case | condition |")
    assert text.endswith(f"{MARKS[1]}\nafter\n")
    assert ("old" in text, text.count("| ball |"), text.count("| three |")) == (False, 1, 1)
    monkeypatch.setattr("sys.argv", words)
    numerics.main()
    assert "| three |" in capsys.readouterr().out


def test_times_are_told_beside_those_of_the_easy_scene():
    text = numerics.time_table({"coincident": CASES["coincident"]}, 300)
    assert "| case | standard | / ball | paper | / ball |" in text
    assert text.splitlines()[-1].startswith("| coincident |")
