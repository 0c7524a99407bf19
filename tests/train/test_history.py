"""History: gains, the best of them, and how they are drawn."""

import json
import math

import pytest

from cvtgs.train import History, Validation
from train_cases import needs_matplotlib

GAINS = {"room": {0.1: 1.0, 0.01: 4.0}, "tree": {0.1: -0.5, 0.01: 0.5}, "dot": {0.1: 0.0}}


def history_of(*scores: float) -> History:
    history = History()
    for number, score in enumerate(scores):
        loss = 1.0 / number if number else math.nan
        history.validations.append(
            Validation(step=10 * number, loss=loss, gains={"room": {0.1: score}})
        )
    return history


def test_the_score_is_the_mean_over_scenes_and_ratios():
    assert Validation(step=0, loss=1.0, gains=GAINS).score == pytest.approx(1.0)


def test_gains_by_ratio_the_largest_first():
    found = Validation(step=0, loss=1.0, gains=GAINS).by_ratio()
    assert list(found.items()) == [(0.1, [1.0, -0.5, 0.0]), (0.01, [4.0, 0.5])]


@pytest.mark.parametrize(
    ("scores", "best", "since"),
    [
        ([0.0], 0, 0),
        ([0.0, 1.0], 1, 0),
        ([0.0, 1.0, 0.5, 0.9], 1, 2),
        ([0.0, 1.0, 1.0], 1, 1),
        ([0.0, -1.0, -2.0, -0.5], 0, 3),
    ],
)
def test_the_best_is_the_first_of_the_largest_scores(scores, best, since):
    history = history_of(*scores)
    assert history.best() is history.validations[best]
    assert history.since_best() == since


def test_before_the_first_validation():
    assert History().best() is None
    assert History().since_best() == 0


def test_json_and_back_keeps_every_digit():
    history = history_of(0.0, 0.1 + 0.2, -1e-300)
    history.validations.append(Validation(step=30, loss=1 / 3, gains=GAINS))
    again = History.from_json(json.loads(json.dumps(history.to_json())))
    assert repr(again.validations) == repr(history.validations)
    assert again.to_json()[1:] == history.to_json()[1:]
    assert History.from_json(History().to_json()).validations == []


@pytest.mark.slow
@needs_matplotlib
@pytest.mark.parametrize("count", [1, 2, 5])
def test_curves_are_a_image(count):
    history = history_of(*range(count))
    assert history.curves()[:8] == b"\x89PNG\r\n\x1a\n"
    assert history.curves() == history.curves()
