"""Images of scenes by the rules of 3DGS, differentiable, on every device.

``torch`` is the reference backend; ``numba`` on CPUs and ``gsplat`` on CUDA are fast ones, and are
imported only when they are chosen.
"""

from cvtgs.rendering.backends import BackendName, choose_backend
from cvtgs.rendering.render import Rendering, contributions, render

__all__ = ["BackendName", "Rendering", "choose_backend", "contributions", "render"]
