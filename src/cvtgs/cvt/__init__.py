"""Weighted centroidal Voronoi tessellation of points; knows nothing of Gaussians beyond weights."""

from cvtgs.cvt.density import falloff, tessellation_weights
from cvtgs.cvt.embedding import embed
from cvtgs.cvt.lloyd import LloydResult, centroids, lloyd, weighted_centroids, weighted_sums
from cvtgs.cvt.nearest import NearestSite, nearest_backend
from cvtgs.cvt.nearest_scipy import nearest_scipy
from cvtgs.cvt.nearest_torch import nearest_torch
from cvtgs.cvt.neighbors import nearest_neighbors, nearest_several
from cvtgs.cvt.openness import add_depths, depth_sums, light_at, light_of, openness
from cvtgs.cvt.seeding import stratified_seeds, weighted_seeds
from cvtgs.cvt.tessellate import (
    Tessellation,
    fill_empty_cells,
    first_seeds,
    sampled,
    search_of,
    tessellate,
)

__all__ = [
    "LloydResult",
    "NearestSite",
    "Tessellation",
    "add_depths",
    "centroids",
    "depth_sums",
    "embed",
    "falloff",
    "fill_empty_cells",
    "first_seeds",
    "light_at",
    "light_of",
    "lloyd",
    "nearest_backend",
    "nearest_neighbors",
    "nearest_scipy",
    "nearest_several",
    "nearest_torch",
    "openness",
    "sampled",
    "search_of",
    "stratified_seeds",
    "tessellate",
    "tessellation_weights",
    "weighted_centroids",
    "weighted_seeds",
    "weighted_sums",
]
