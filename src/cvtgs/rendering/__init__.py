"""Images of scenes by the rules of 3DGS, differentiable, on every device.

``torch`` is the reference backend; ``numba`` on CPUs and ``gsplat`` on CUDA are fast ones, and are
imported only when they are chosen.
"""

from cvtgs.rendering.backends import BackendName, BlendingWeights, choose_backend
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
    "observe",
    "render",
]
