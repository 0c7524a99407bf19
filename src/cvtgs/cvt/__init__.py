"""Weighted centroidal Voronoi tessellation of Gaussians as points: embedding, weights, cells."""

from cvtgs.cvt.embedding import embed, gaussian_weights, tessellation_weights
from cvtgs.cvt.nearest import (
    NearestSite,
    nearest_backend,
    nearest_neighbors,
    nearest_scipy,
    nearest_several,
    nearest_torch,
)
from cvtgs.cvt.tessellate import (
    LloydResult,
    Tessellation,
    centroids,
    choose_search,
    choose_seeds,
    fill_empty_cells,
    lloyd,
    sample_points,
    stratified_seeds,
    tessellate,
    weighted_centroids,
    weighted_seeds,
    weighted_sums,
)

__all__ = [
    "LloydResult",
    "NearestSite",
    "Tessellation",
    "centroids",
    "choose_search",
    "choose_seeds",
    "embed",
    "fill_empty_cells",
    "gaussian_weights",
    "lloyd",
    "nearest_backend",
    "nearest_neighbors",
    "nearest_scipy",
    "nearest_several",
    "nearest_torch",
    "sample_points",
    "stratified_seeds",
    "tessellate",
    "tessellation_weights",
    "weighted_centroids",
    "weighted_seeds",
    "weighted_sums",
]
