"""Numbers and names on sheets and pages, in JSON and in errors."""

import json
import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from cvtgs import Cameras, evaluate, refine
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import EvaluationSettings, compare, comparison_files
from cvtgs.evaluation.scorer import Score
from refine_cases import ring
from scenes import random_scene


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


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([20.0, 30.0], "25.00 dB"),
        ([math.inf, math.inf], "equal"),
        ([20.0, math.inf, 31.0], "25.50 dB, 1 equal"),
    ],
)
def test_a_mean_is_equal_only_if_all_views_are(values, text):
    assert vars(comparison_files)["_mean_psnr_text"](Score.of(values)) == text


def test_views_that_show_nothing_are_not_among_the_equal_ones():
    score = Score(mean=math.inf, views=(20.0, math.inf, math.inf, 12.0))
    assert vars(comparison_files)["_mean_psnr_text"](score, (1, 3)) == "20.00 dB, 1 equal"


def test_names_of_images_that_are_not_utf_8_are_escaped() -> None:
    names = ("Geb\udce4ude.png", "two\nlines.png", "Geb\xe4ude.png")
    scene, cameras = random_scene(30), replace(ring(3), names=names)
    found = evaluate(scene, {"a": scene}, cameras, settings=EvaluationSettings(lpips="off"))
    wanted = ["Geb\\udce4ude.png", "two\\nlines.png", "Geb\xe4ude.png"]
    assert json.loads(found.to_json())["views"] == wanted


@pytest.mark.parametrize(
    "use",
    [
        lambda scene, cameras: evaluate(scene, {"a": scene}, cameras),
        lambda scene, cameras: compare(scene, {"a": scene}, cameras),
        lambda scene, cameras: refine(scene, scene, cameras=cameras),
    ],
)
def test_a_wrong_camera_is_named_by_its_number(use: Callable[..., object]) -> None:
    cameras = ring(9)
    viewmats = cameras.viewmats.clone()
    viewmats[5] *= float("nan")
    wrong = Cameras(viewmats=viewmats, Ks=cameras.Ks, width=64, height=64)
    with pytest.raises(InvalidArgumentError, match=r"; 1 of 9 do not, the first is camera 5\.$"):
        use(random_scene(30), wrong)
