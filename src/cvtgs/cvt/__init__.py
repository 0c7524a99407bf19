"""Weighted centroidal Voronoi tessellation of Gaussian centres: embedding, weights, cells."""

from cvtgs.cvt.embedding import embed, gaussian_weights, tessellation_weights
from cvtgs.cvt.nearest import (
    NearestSite,
    nearest_neighbors,
    nearest_scipy,
    nearest_several,
    nearest_site,
    search_device,
    search_name,
)
from cvtgs.cvt.seeding import choose_seeds, stratified_seeds, weighted_seeds
from cvtgs.cvt.tessellate import (
    LloydResult,
    Tessellation,
    centroids,
    choose_search,
    fill_empty_cells,
    lloyd,
    sample_points,
    tessellate,
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
    "nearest_neighbors",
    "nearest_scipy",
    "nearest_several",
    "nearest_site",
    "sample_points",
    "search_device",
    "search_name",
    "stratified_seeds",
    "tessellate",
    "tessellation_weights",
    "weighted_seeds",
    "weighted_sums",
]
