"""Sample the members of large cells, so that a network takes no longer for larger ones."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.math import parameters
from cvtgs.math.segments import gather_columns, running_sums, segment_ids, segment_max, true_rows
from cvtgs.scene import GaussianScene

MOST_SAMPLED = 32
"""Largest number of described members of a cell."""

LEAST_RATE = 1e-9
"""Limit of rates, so that weights stay finite where rounding samples a member of no mass."""

START = 0.5 * (3.0 - math.sqrt(5.0))
"""Where sampling starts, in steps. It is irrational, so that rounding never decides between
members of equal mass."""


class SampledMembers(NamedTuple):
    """Some members of every cell.

    Attributes:
        part: The sampled members.
        counts: ``(m,)`` number of all members of every cell.
        rates: ``(n,)`` expected share of members of this mass that are sampled, above 0 to 1.
    """

    part: Partition
    counts: Int[Tensor, "m"]
    rates: Float[Tensor, "n"]


def sample_members(scene: GaussianScene, part: Partition) -> SampledMembers:
    """Take all members of small cells, and of large cells some in proportion to their mass.

    Systematic sampling (Madow 1949): members are taken where the running sum of masses passes
    equal steps. Members are in the order of a space-filling curve, so that the sample spreads over
    the cell. A sum over all members is estimated by sampled values divided by their rates (Horvitz
    and Thompson 1952). Masses are in float64, so that every dtype gives the same sample.

    Args:
        scene: The Gaussians.
        part: Members of the cells, at least one of each.

    Returns:
        The sampled members, in the same order; at most ``MOST_SAMPLED`` of every cell.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 1000, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0] * 990 + [1] * 10), 2)
        >>> sampled = sample_members(scene, cells)
        >>> sampled.part.counts.tolist(), sampled.counts.tolist()
        ([32, 10], [990, 10])
    """
    counts, offsets, total = part.counts, part.offsets, len(part.order)
    on_host = part.order.device.type == "cpu"
    if total <= MOST_SAMPLED or (on_host and int(counts.amax()) <= MOST_SAMPLED):
        return SampledMembers(part, counts, scene.logit_opacities.new_ones(total))
    ids = segment_ids(offsets, total)
    masses = _relative_masses(scene, part, ids)
    sums = torch.nn.functional.pad(running_sums(masses), (1, 0))
    starts, ends = (sums.index_select(0, rows) for rows in (offsets[:-1], offsets[1:]))
    table = torch.stack([starts, MOST_SAMPLED / (ends - starts), counts.double()])
    starts, steps, sizes = table.index_select(1, ids)
    passed = torch.floor((sums[1:] - starts) * steps + START)
    before = torch.nn.functional.pad(passed[:-1], (1, 0)).index_fill(0, offsets[:-1], 0.0)
    is_small = sizes <= MOST_SAMPLED
    is_taken = is_small | (passed > before)
    taken = true_rows(is_taken)
    rates = torch.where(is_small, 1.0, masses * steps).index_select(0, taken)
    places = torch.nn.functional.pad(is_taken.cumsum(0), (1, 0))
    sampled = Partition(
        order=part.order.index_select(0, taken), offsets=places.index_select(0, offsets)
    )
    return SampledMembers(sampled, counts, rates.clamp(LEAST_RATE, 1.0).to(scene.dtype))


def _relative_masses(
    scene: GaussianScene, part: Partition, ids: Int[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Return the mass of every member, relative to the largest of its cell."""
    (log_scales,) = gather_columns(part.order, scene.log_scales)
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, part.order))
    areas = parameters.log_mean_projected_area(log_scales.double())
    logs = areas + parameters.positive_log(opacities.double())
    return torch.exp(logs - segment_max(logs, part.offsets).index_select(0, ids))
