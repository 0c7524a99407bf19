"""Weighted centroidal Voronoi tessellation of Gaussian centres: embedding, weights, cells."""

from cvtgs.cvt.embedding import embed, gaussian_weights, tessellation_weights
from cvtgs.cvt.nearest import NearestSite, nearest_neighbors, nearest_scipy, nearest_site
from cvtgs.cvt.tessellate import (
    LloydResult,
    Tessellation,
    choose_seeds,
    fill_empty_cells,
    lloyd,
    stratified_seeds,
    tessellate,
    weighted_seeds,
)

__all__ = [
    "LloydResult",
    "NearestSite",
    "Tessellation",
    "choose_seeds",
    "embed",
    "fill_empty_cells",
    "gaussian_weights",
    "lloyd",
    "nearest_neighbors",
    "nearest_scipy",
    "nearest_site",
    "stratified_seeds",
    "tessellate",
    "tessellation_weights",
    "weighted_seeds",
]
