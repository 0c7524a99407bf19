"""Match opacities, then colours, to images of the full scene, without gradient descent."""

from cvtgs.matching.colors import fit_colors
from cvtgs.matching.match import (
    Matched,
    cell_contributions,
    match_opacities,
    match_views,
)

__all__ = [
    "Matched",
    "cell_contributions",
    "fit_colors",
    "match_opacities",
    "match_views",
]
