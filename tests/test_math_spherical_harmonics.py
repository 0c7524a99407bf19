"""Degrees of spherical harmonics by their number of coefficients."""

import math

import pytest

from cvtgs.errors import InvalidArgumentError
from cvtgs.math.spherical_harmonics import SH_C0, degree_of


def test_constant_band():
    assert pytest.approx(1 / (2 * math.sqrt(math.pi))) == SH_C0


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_degrees(count, degree):
    assert degree_of(count) == degree


@pytest.mark.parametrize("count", [1, 14, 24, -1])
def test_other_counts_are_errors(count):
    with pytest.raises(InvalidArgumentError) as caught:
        degree_of(count)
    assert str(caught.value) == (
        "a scene has 0, 3, 8 or 15 view-dependent SH coefficients per channel "
        f"(degree 0 to 3), found {count}."
    )
