"""Widths of the sheets that ``cvtgs compare`` writes, for few and for many views."""

import numpy as np
import pytest

from cvtgs.evaluation import Comparison, Evaluation, SceneImages, SceneScores, Score
from cvtgs.evaluation.comparison_files import contact_sheet, error_sheet
from cvtgs.evaluation.images import ALPHA_SCALE, alpha_colors


def gray_comparison(views: int, *, width: int, height: int) -> Comparison:
    """Return a comparison of a gray scene with itself."""
    score = Score.of([0.5] * views)
    scores = SceneScores(
        name="small", count=1, psnr=score, ssim=score, alpha_error=score, alpha_bias=score
    )
    shape = (views, height, width)
    images = SceneImages(np.full((*shape, 3), 77, np.uint8), np.full(shape, 77, np.uint8))
    evaluation = Evaluation(
        reference="full",
        reference_count=10,
        views=tuple(f"view {view}" for view in range(views)),
        width=width,
        height=height,
        backend="numba",
        scenes=(scores,),
    )
    return Comparison(
        evaluation=evaluation,
        shown=tuple(range(views)),
        full=images,
        small={"small": images},
        sizes={},
    )


@pytest.mark.long
@pytest.mark.parametrize(("views", "width"), [(1, 32), (1, 640), (2, 640), (8, 640)])
def test_the_legends_of_error_maps_are_whole(views, width):
    errors = error_sheet(gray_comparison(views, width=width, height=480))
    ramp = alpha_colors(np.linspace(-ALPHA_SCALE, ALPHA_SCALE, 340)[None])
    below = errors[-84:]
    windows = np.lib.stride_tricks.sliding_window_view(below, (1, 340, 3))[:, :, 0]
    off = np.abs(windows.astype(int) - ramp).max(axis=(2, 3, 4))
    assert off.min() <= 1, "rounding"


@pytest.mark.long
@pytest.mark.parametrize("views", [40, 400])
def test_images_of_many_views_are_as_wide_as_their_columns(views):
    sheet = contact_sheet(gray_comparison(views, width=640, height=480))
    columns = (sheet == 77).all(axis=2).any(axis=0)
    assert columns.sum() == 90 * views
