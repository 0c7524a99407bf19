"""From labels to Gaussians: partition, moments, representatives, inflation, descriptors."""

from cvtgs.cells.axes import align_axes
from cvtgs.cells.descriptors import Descriptors, describe_cells
from cvtgs.cells.inflation import inflate_cells, side_cover
from cvtgs.cells.moments import Members, mean_and_covariance, normalized_weights, weighted_mean
from cvtgs.cells.partition import Partition
from cvtgs.cells.reference import gather_members, merge_cells, merged_depth
from cvtgs.cells.representatives import keep_representatives

__all__ = [
    "Descriptors",
    "Members",
    "Partition",
    "align_axes",
    "describe_cells",
    "gather_members",
    "inflate_cells",
    "keep_representatives",
    "mean_and_covariance",
    "merge_cells",
    "merged_depth",
    "normalized_weights",
    "side_cover",
    "weighted_mean",
]
