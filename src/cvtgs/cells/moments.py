"""Weighted moments of the members of every cell, in float64."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.activated import take
from cvtgs.math import parameters
from cvtgs.math.segments import segment_ids, segment_max, segment_sum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Members:
    """The members of some cells, those of one cell next to one another, in float64.

    Attributes:
        means: ``(n, 3)`` positions.
        quats: ``(n, 4)`` unit quaternions.
        scales: ``(n, 3)`` standard deviations.
        opacities: ``(n,)`` opacities.
        depths: ``(n,)`` optical depths ``-log(1 - a)``.
        areas: ``(n,)`` mean projected areas.
        offsets: ``(m + 1,)`` where each cell starts, and the end of the last one.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    depths: Float[Tensor, "n"]
    areas: Float[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]

    def weights(self, area_power: float) -> Float[Tensor, "n"]:
        """Return what each member weighs in the means of its cell.

        Args:
            area_power: The weight is the opacity times the area to this power: 0 as in CVT-GS,
                1 for the mass.

        Returns:
            Weights; those of one cell sum to 1.
        """
        if area_power == 0.0:
            return normalized_weights(self.opacities, self.offsets)
        ids = segment_ids(self.offsets)
        largest = segment_max(self.areas, self.offsets).index_select(0, ids)
        shares = parameters.divide(self.areas, largest) ** area_power
        return normalized_weights(self.opacities * shares, self.offsets)


def normalized_weights(
    weights: Float[Tensor, "n"], offsets: Int[Tensor, "m_plus_1"]
) -> Float[Tensor, "n"]:
    """Scale weights so that those of each cell sum to 1.

    Args:
        weights: Weights, at least 0, members of one cell next to one another.
        offsets: Where each cell starts, and the end of the last one.

    Returns:
        Weights in float64; equal ones in cells where all are 0 or denormal.

    Example:
        >>> normalized_weights(torch.tensor([1.0, 3.0]), torch.tensor([0, 2])).tolist()
        [0.25, 0.75]
    """
    weights, ids = weights.double(), segment_ids(offsets)
    totals = segment_sum(weights, offsets).index_select(0, ids)
    shares = weights / totals.clamp_min(torch.finfo(weights.dtype).tiny)
    equal = offsets.diff().double().reciprocal().index_select(0, ids)
    return torch.where(totals < torch.finfo(weights.dtype).tiny, equal, shares)


def weighted_mean(
    values: Float[Tensor, "n *k"],
    weights: Float[Tensor, "n"],
    offsets: Int[Tensor, "m_plus_1"],
) -> Float[Tensor, "m *k"]:
    """Average the rows of every cell.

    Args:
        values: One row per member.
        weights: Weights that sum to 1 in each cell.
        offsets: Where each cell starts, and the end of the last one.

    Returns:
        One row per cell, float64.

    Example:
        >>> weighted_mean(
        ...     torch.tensor([0.0, 4.0]), torch.tensor([0.25, 0.75]), torch.tensor([0, 2])
        ... ).tolist()
        [3.0]
    """
    return segment_sum(values.double(), offsets, weights.double())


def mean_and_covariance(
    members: Members, weights: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3 3"]]:
    """Match the first two moments of the mixture that each cell is.

    The covariance is the weighted mean of the members' covariances plus the weighted spread of
    their means; the spread is taken about the mean, in two passes, so that no digits are lost
    far from the origin.

    Args:
        members: Members of the cells.
        weights: Weights that sum to 1 in each cell.

    Returns:
        Means and covariances of the cells, float64.
    """
    offsets = members.offsets
    ids = segment_ids(offsets)
    first_rows = members.means.index_select(0, offsets[:-1])
    local = members.means - take(first_rows, ids)
    shift = weighted_mean(local, weights, offsets)
    local = local - take(shift, ids)
    axes = parameters.quats_to_matrices(members.quats) * members.scales[:, None, :]
    # Sums of products of columns; products of so many small matrices take ten times as long.
    matrices = local[:, :, None] * local[:, None, :]
    for axis in axes.unbind(2):
        matrices.addcmul_(axis[:, :, None], axis[:, None, :])
    return first_rows + shift, weighted_mean(matrices, weights, offsets)
