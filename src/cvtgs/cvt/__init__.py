"""Weighted centroidal Voronoi tessellation: weights, embedding, seeds, Lloyd, search."""

from cvtgs.cvt.density import falloff, tessellation_weights
from cvtgs.cvt.embedding import embed
from cvtgs.cvt.lloyd import LloydResult, lloyd, weighted_centroids
from cvtgs.cvt.nearest import nearest_backend
from cvtgs.cvt.nearest_scipy import nearest_scipy
from cvtgs.cvt.nearest_torch import nearest_torch
from cvtgs.cvt.neighbors import nearest_neighbors
from cvtgs.cvt.openness import add_depths, ambient_visibility, depth_sums, light_at, light_of
from cvtgs.cvt.seeding import stratified_seeds, weighted_seeds
from cvtgs.cvt.tessellate import Tessellation, fill_empty_cells, tessellate

__all__ = [
    "LloydResult",
    "Tessellation",
    "add_depths",
    "ambient_visibility",
    "depth_sums",
    "embed",
    "falloff",
    "fill_empty_cells",
    "light_at",
    "light_of",
    "lloyd",
    "nearest_backend",
    "nearest_neighbors",
    "nearest_scipy",
    "nearest_torch",
    "stratified_seeds",
    "tessellate",
    "tessellation_weights",
    "weighted_centroids",
    "weighted_seeds",
]
