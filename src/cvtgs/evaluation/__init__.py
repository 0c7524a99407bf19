"""How good a simplified scene looks next to the full one: views, scores, pages."""

from cvtgs.evaluation.compare import Comparison, compare
from cvtgs.evaluation.comparison_files import write_exhibition
from cvtgs.evaluation.evaluate import evaluate
from cvtgs.evaluation.lpips_distance import lpips
from cvtgs.evaluation.lpips_weights import LPIPS_VARIABLE, LpipsWeights, load_lpips
from cvtgs.evaluation.metrics import psnr, ssim
from cvtgs.evaluation.photographs import load_photographs
from cvtgs.evaluation.scores import Evaluation, SceneScores, Score
from cvtgs.evaluation.settings import EvaluationSettings

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
