"""How good a simplified scene looks next to the full one: views, scores, pages."""

from cvtgs.evaluate.compare import Comparison, compare
from cvtgs.evaluate.comparison_files import write_exhibition
from cvtgs.evaluate.evaluate import evaluate
from cvtgs.evaluate.lpips_distance import lpips
from cvtgs.evaluate.lpips_weights import LPIPS_VARIABLE, LpipsWeights, load_lpips
from cvtgs.evaluate.metrics import psnr, ssim
from cvtgs.evaluate.photographs import load_photographs
from cvtgs.evaluate.scores import Evaluation, SceneScores, Score
from cvtgs.evaluate.settings import EvaluationSettings

__all__ = [
    "LPIPS_VARIABLE",
    "Comparison",
    "Evaluation",
    "EvaluationSettings",
    "LpipsWeights",
    "SceneScores",
    "Score",
    "compare",
    "evaluate",
    "load_lpips",
    "load_photographs",
    "lpips",
    "psnr",
    "ssim",
    "write_exhibition",
]
