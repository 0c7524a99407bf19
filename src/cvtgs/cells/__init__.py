"""From cells to Gaussians: members, moments, axes, inflation and descriptors."""

from cvtgs.cells.allocate import merge_pairs, reassign
from cvtgs.cells.descriptors import Descriptors
from cvtgs.cells.features import describe_cells
from cvtgs.cells.inflate import align_axes, inflate_cells, side_cover
from cvtgs.cells.merge import (
    Members,
    gather_members,
    keep_representatives,
    mean_and_covariance,
    merge_cells,
    merged_depth,
    normalized_weights,
)
from cvtgs.cells.moments import Moments, gaussian_moments, group_moments, mass_unit, view_components
from cvtgs.cells.partition import Partition, SampledMembers, sample_members

__all__ = [
    "Descriptors",
    "Members",
    "Moments",
    "Partition",
    "SampledMembers",
    "align_axes",
    "describe_cells",
    "gather_members",
    "gaussian_moments",
    "group_moments",
    "inflate_cells",
    "keep_representatives",
    "mass_unit",
    "mean_and_covariance",
    "merge_cells",
    "merge_pairs",
    "merged_depth",
    "normalized_weights",
    "reassign",
    "sample_members",
    "side_cover",
    "view_components",
]
