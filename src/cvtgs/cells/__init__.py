"""From cells to Gaussians: members, moments and the reference; blind to how cells were made."""

from cvtgs.cells.descriptors import Descriptors, describe_cells
from cvtgs.cells.frames import settle_frames
from cvtgs.cells.lone import keep_lone_members
from cvtgs.cells.moments import Members, mean_and_covariance, normalized_weights, weighted_mean
from cvtgs.cells.partition import Partition
from cvtgs.cells.reference import gather_members, merge_cells, merged_depth
from cvtgs.cells.widening import side_cover, widen_cells

__all__ = [
    "Descriptors",
    "Members",
    "Partition",
    "describe_cells",
    "gather_members",
    "keep_lone_members",
    "mean_and_covariance",
    "merge_cells",
    "merged_depth",
    "normalized_weights",
    "settle_frames",
    "side_cover",
    "weighted_mean",
    "widen_cells",
]
