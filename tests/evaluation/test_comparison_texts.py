"""Numbers in words on sheets and pages."""

import pytest

from cvtgs.evaluation import comparison_files
from cvtgs.evaluation.comparison_files import bytes_text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (999, "999 B"),
        (99_949, "99.9 kB"),
        (99_960, "100 kB"),
        (999_499, "999 kB"),
        (999_999, "1.0 MB"),
        (250_000_000, "250 MB"),
        (5 * 10**12, "5000 GB"),
    ],
)
def test_byte_counts_as_text(count, text):
    assert bytes_text(count) == text


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
