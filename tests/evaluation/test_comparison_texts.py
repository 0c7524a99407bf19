"""Numbers in words on sheets and pages."""

import pytest

from cvtgs.evaluation import comparison_files


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (1000 / 3, "333 times fewer"),
        (2.5, "2.5 times fewer"),
        (1.001, "as many"),
        (0.4, "2.5 times more"),
        (1 / 6, "6 times more"),
        (1 / 1200, "1,200 times more"),
    ],
)
def test_ratios_as_text(ratio, text):
    assert vars(comparison_files)["_ratio_text"](ratio) == text
