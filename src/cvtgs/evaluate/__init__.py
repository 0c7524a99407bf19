"""How good a simplified scene looks next to the full one: views, scores, pages."""

from cvtgs.evaluate.anywhere import views_from_anywhere
from cvtgs.evaluate.compare import Comparison, compare
from cvtgs.evaluate.evaluate import evaluate
from cvtgs.evaluate.exhibition import write_exhibition
from cvtgs.evaluate.lpips_distance import lpips
from cvtgs.evaluate.lpips_weights import LPIPS_VARIABLE, LpipsWeights, load_lpips
from cvtgs.evaluate.metrics import psnr, ssim
from cvtgs.evaluate.photographs import load_photographs
from cvtgs.evaluate.scores import Evaluation, SceneScores, Score
from cvtgs.evaluate.settings import EvaluationSettings
from cvtgs.evaluate.views import automatic_views

__all__ = [
    "LPIPS_VARIABLE",
    "Comparison",
    "Evaluation",
    "EvaluationSettings",
    "LpipsWeights",
    "SceneScores",
    "Score",
    "automatic_views",
    "compare",
    "evaluate",
    "load_lpips",
    "load_photographs",
    "lpips",
    "psnr",
    "ssim",
    "views_from_anywhere",
    "write_exhibition",
]
