"""Scores reach every report, page and table."""

from pathlib import Path

import pytest

import cvtgs
from cvtgs.evaluation import SceneScores
from cvtgs.evaluation.scorer import ImageScores, scene_scores
from cvtgs.levels import LevelEntry
from cvtgs.report import Tried
from cvtgs.tradeoff import TradeoffResult

SCORES = SceneScores.model_fields.keys() - {"name", "count"}
SOURCE = Path(cvtgs.__file__).parent


def test_every_metric_is_averaged_under_its_own_name():
    rows = [ImageScores(*(10.0 * view + n for n in range(len(SCORES)))) for view in (0, 1)]
    means = scene_scores("a", 5, rows).means()
    assert [means[name] for name in ImageScores._fields] == [5.0 + n for n in range(len(SCORES))]


@pytest.mark.parametrize(
    ("record", "others"), [(LevelEntry, set()), (TradeoffResult, set()), (Tried, {"lpips"})]
)
def test_every_score_is_in_all_reports(record, others):
    missing = SCORES - others - record.model_fields.keys()
    assert not missing, f"add these scores to {record.__name__}, and to tests/evaluation"


@pytest.mark.parametrize(
    "file",
    [
        "cli/evaluate.py",
        "evaluation/comparison_files.py",
        "evaluation/page_parts/page.js",
        "tradeoff/files.py",
    ],
)
def test_every_score_is_shown(file):
    text = (SOURCE / file).read_text(encoding="utf-8")
    missing = [name for name in SCORES if f".{name}" not in text and f'"{name}"' not in text]
    assert not missing, f"show these scores in {file}"
