"""Differentiable rendering of scenes by the rules of 3DGS, on every device.

``torch`` is the reference backend; ``numba`` (CPU) and ``gsplat`` (CUDA) are the fast backends and
are imported only when chosen.
"""

from cvtgs.rendering.backends import BackendName, BlendingWeights, choose_backend
from cvtgs.rendering.image_errors import error_shares
from cvtgs.rendering.render import (
    ObservedViews,
    Rendering,
    blending_weights,
    contributions,
    observe,
    render,
)

__all__ = [
    "BackendName",
    "BlendingWeights",
    "ObservedViews",
    "Rendering",
    "blending_weights",
    "choose_backend",
    "contributions",
    "error_shares",
    "observe",
    "render",
]
