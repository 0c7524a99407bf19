"""Small scenes whose simplification can be worked out by hand."""

import torch

from cvtgs import GaussianScene


def gaussians(means, *, opacities, scales, colors=None, dtype=torch.float64) -> GaussianScene:
    """Return axis-parallel Gaussians; colours are SH coefficients, gray if None."""
    n = len(means)
    alpha = torch.tensor(opacities, dtype=dtype)
    shades = torch.zeros(n, 3) if colors is None else torch.tensor(colors)
    return GaussianScene(
        means=torch.tensor(means, dtype=dtype),
        quats=torch.tensor([[1.0, 0, 0, 0]] * n, dtype=dtype),
        log_scales=torch.tensor(scales, dtype=dtype).log().reshape(n, -1).expand(n, 3).clone(),
        logit_opacities=torch.logit(alpha),
        sh0=shades.to(dtype)[:, None],
        shN=torch.zeros(n, 0, 3, dtype=dtype),
    )
