"""Compare simplified scenes with the full one: rendered views, scores and pages."""

from cvtgs.evaluation.compare import Comparison, SceneImages, compare, evaluate
from cvtgs.evaluation.comparison_files import write_comparison
from cvtgs.evaluation.images import Photographs, fit_cameras, load_photographs
from cvtgs.evaluation.lpips import LpipsWeights, load_lpips, lpips
from cvtgs.evaluation.metrics import alpha_bias, alpha_error, psnr, ssim
from cvtgs.evaluation.scorer import Evaluation, EvaluationSettings, SceneScores, Score

__all__ = [
    "Comparison",
    "Evaluation",
    "EvaluationSettings",
    "LpipsWeights",
    "Photographs",
    "SceneImages",
    "SceneScores",
    "Score",
    "alpha_bias",
    "alpha_error",
    "compare",
    "evaluate",
    "fit_cameras",
    "load_lpips",
    "load_photographs",
    "lpips",
    "psnr",
    "ssim",
    "write_comparison",
]
