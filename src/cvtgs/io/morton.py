"""The order of rows in formats that gain from neighbours being close in the file."""

import numpy as np
import torch
from jaxtyping import Float, Int

from cvtgs.math.frames import morton_order


def morton_rows(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Order Gaussians along a Morton curve; far ones do not coarsen it."""
    middle = np.median(means, axis=0)
    away = means - middle
    radius = np.quantile(np.abs(away).max(axis=1), 0.9) or 1.0
    inside = np.sign(away) * np.log1p(np.abs(away) / np.float32(radius))
    order: Int[np.ndarray, n] = morton_order(torch.from_numpy(inside)).numpy()
    return order
