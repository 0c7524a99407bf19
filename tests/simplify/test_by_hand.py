"""The stages by hand, as the documentation describes them, against ``Simplifier``."""

import re
from pathlib import Path

import pytest

import cvtgs
from scenes import random_scene, same_bits

PAGE = Path(__file__).parents[2] / "docs" / "method" / "index.md"


@pytest.fixture(scope="module")
def simplify_by_hand():
    """What the page defines."""
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names["simplify_by_hand"]


@pytest.mark.parametrize("preset", ["standard", "paper"])
@pytest.mark.parametrize(
    "scene",
    [random_scene(600, degree=2), cvtgs.synthetic.scene("landscape", 1500, sh_degree=1, seed=2)],
    ids=["random", "landscape"],
)
def test_stages_by_hand_give_the_bits_of_the_simplifier(simplify_by_hand, scene, preset):
    whole = cvtgs.Simplifier(preset, device="cpu").simplify(scene, count=90)
    assert same_bits(simplify_by_hand(scene, 90, preset), whole)
    assert not same_bits(whole, cvtgs.Simplifier(preset, device="cpu").simplify(scene, count=89))
