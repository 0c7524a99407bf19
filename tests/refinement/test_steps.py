"""A step of a refinement is finite, however large or small its gradients are."""

import pytest
import torch

from cvtgs.config import Rates
from cvtgs.refinement.optimize import SceneOptimizer
from refine_cases import as_dtype
from scenes import random_scene


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-44, 1e-30, 1e25, 3e38, 1e300])
def test_gradients_of_any_size_give_finite_steps(dtype, size):
    scene = as_dtype(random_scene(2, degree=0), dtype)
    scale = torch.ones(2, dtype=dtype)
    optimizer = SceneOptimizer(scene, Rates(sh0=0.25), learning_rate_scale=scale)
    size = min(size, torch.finfo(dtype).max)
    for sign in (1, -1, 1, 1):
        optimizer.step(sign * size * optimizer.scene().sh0[0, 0, 0], factor=1.0)
    moved = (optimizer.scene().sh0 - scene.sh0).detach()
    assert bool(moved.isfinite().all())
    assert float(moved.abs().amax()) <= 4 * 0.25
    assert not moved[1].any()
