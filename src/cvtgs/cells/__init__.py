"""From cells to Gaussians: members, moments, axes, inflation and descriptors."""

from cvtgs.cells.allocate import merge_pairs, reassign
from cvtgs.cells.descriptors import Descriptors
from cvtgs.cells.features import describe_cells
from cvtgs.cells.inflate import align_axes, inflate_cells
from cvtgs.cells.merge import keep_representatives, merge_cells
from cvtgs.cells.moments import Moments, gaussian_moments, group_moments, view_components
from cvtgs.cells.partition import Partition

__all__ = [
    "Descriptors",
    "Moments",
    "Partition",
    "align_axes",
    "describe_cells",
    "gaussian_moments",
    "group_moments",
    "inflate_cells",
    "keep_representatives",
    "merge_cells",
    "merge_pairs",
    "reassign",
    "view_components",
]
