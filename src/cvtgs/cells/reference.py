"""The reference: each cell as one Gaussian by its moments, without a network."""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cells.activated import gather
from cvtgs.cells.moments import Members, mean_and_covariance, weighted_mean
from cvtgs.cells.partition import Partition
from cvtgs.config import MergeConfig
from cvtgs.math import parameters
from cvtgs.math.segments import segment_argmax, segment_sum
from cvtgs.scene import GaussianScene

CHUNK_MEMBERS = 1 << 15
"""Members gathered at one time; a chunk takes about ``(60 + 6 k) * 8`` bytes for each."""


def merge_cells(
    scene: GaussianScene,
    partition: Partition,
    *,
    config: MergeConfig,
    on_cells: Callable[[int], None] = lambda done: None,
) -> GaussianScene:
    """Turn every cell into one Gaussian.

    A cell of one member returns that member bit for bit. Other cells get the weighted mean and
    covariance of their members (both terms: spread of the means and mean of the covariances),
    the weighted mean of their SH coefficients, and an opacity. Extra columns of floats are
    averaged by weight, of integers taken from the heaviest member.

    Args:
        scene: The Gaussians, with valid rows.
        partition: Row numbers of every cell.
        config: Weights and opacity rule.
        on_cells: Told how many cells are done.

    Returns:
        A scene with one Gaussian per cell, in the order of the cells.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 4, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 0, 1, 1]), 2)
        >>> len(merge_cells(scene, cells, config=MergeConfig()))
        2
    """
    heads = partition.order[partition.offsets[:-1]]
    merged = scene.select(heads)
    several = partition.counts > 1
    cells = several.nonzero()[:, 0]
    done = len(partition) - len(cells)
    tensors, extras = merged.tensors(), dict(merged.extras)
    for run, part in partition.select(several).chunks(CHUNK_MEMBERS):
        new_tensors, new_extras = _merge_chunk(scene, part, config)
        for name, values in new_tensors.items():
            tensors[name][cells[run]] = values.to(scene.dtype)
        for name, values in new_extras.items():
            extras[name][cells[run]] = values
        done += len(part)
        on_cells(done)
    return merged.with_tensors(tensors, extras)


def _merge_chunk(
    scene: GaussianScene, part: Partition, config: MergeConfig
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    rows, offsets = part.order, part.offsets
    members = gather_members(scene, part)
    weights = members.weights(config.area_power)
    means, matrices = mean_and_covariance(members, weights)
    scales, quats = parameters.decompose_covariances(matrices)
    depths = merged_depth(members, parameters.mean_projected_area(scales), rule=config.opacity)
    tensors = {
        "means": means,
        "quats": quats,
        "log_scales": parameters.positive_log(scales),
        "logit_opacities": parameters.logit_from_optical_depth(depths),
        "sh0": weighted_mean(scene.sh0.index_select(0, rows), weights, offsets),
        "shN": weighted_mean(scene.shN.index_select(0, rows), weights, offsets),
    }
    if not scene.extras:
        return tensors, {}
    heaviest = rows[segment_argmax(members.opacities * members.areas, offsets)]
    extras = {
        name: weighted_mean(column[rows], weights, offsets).to(column.dtype)
        if column.is_floating_point()
        else column[heaviest]
        for name, column in scene.extras.items()
    }
    return tensors, extras


def gather_members(scene: GaussianScene, part: Partition) -> Members:
    """Collect what the moments of some cells need.

    Args:
        scene: The Gaussians.
        part: Row numbers of the cells.

    Returns:
        The members in float64.
    """
    rows = part.order
    log_scales = gather(scene.log_scales, rows).double()
    logits = scene.logit_opacities.index_select(0, rows).double()
    return Members(
        means=gather(scene.means, rows).double(),
        quats=parameters.normalize_quats(gather(scene.quats, rows).double()),
        scales=torch.exp(log_scales),
        opacities=parameters.opacity_from_logit(logits),
        depths=parameters.optical_depth_from_logit(logits),
        areas=torch.exp(parameters.log_mean_projected_area(log_scales)),
        offsets=part.offsets,
    )


def merged_depth(
    members: Members,
    areas: Float[Tensor, "m"],
    *,
    rule: Literal["saturating", "union"],
) -> Float[Tensor, "m"]:
    """Return the optical depth of the Gaussian that stands for a cell.

    Args:
        members: Members of the cells.
        areas: Mean projected areas of the merged Gaussians.
        rule: ``union``: all members lie behind one another, depths add up (CVT-GS:
            ``1 - prod(1 - a)``). ``saturating``: depth times area adds up, so that mass is
            conserved as long as the cell is not opaque.

    Returns:
        Optical depths; the opacity is ``1 - exp(-depth)``.
    """
    if rule == "union":
        return segment_sum(members.depths, members.offsets)
    return parameters.divide(segment_sum(members.depths * members.areas, members.offsets), areas)
