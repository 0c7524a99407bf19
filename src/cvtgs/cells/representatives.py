"""Lone members: where one member shows more of its cell than the moments of all would."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.math import parameters
from cvtgs.math.segments import segment_argmax, segment_sum
from cvtgs.scene import GaussianScene


def keep_representatives(
    scene: GaussianScene,
    merged: GaussianScene,
    partition: Partition,
    *,
    areas: Float[Tensor, "n"],
) -> tuple[GaussianScene, Partition]:
    """Let one member stand for its cell where the members hardly touch.

    Members that lie apart (points, needles, thin haze) have moments that are far wider than all of
    them together: a faint veil, of which an image shows less than of any member. In an image, a
    Gaussian of opacity a and area A removes about ``a^2 A`` of the squared error if it is a
    member, and ``M^2 / A`` if it spreads the mass M of the cell over its area. So the member of
    largest ``a^2 A`` stays, bit for bit, where that is more. This is our own rule, not part of
    CVT-GS.

    Args:
        scene: The Gaussians.
        merged: One Gaussian per cell, as its moments give it.
        partition: Members of the cells.
        areas: Mean projected areas of all Gaussians of the scene.

    Returns:
        The scene with such members in place of their cells, and the members that each of its
        Gaussians stands for: one of those cells, all of the others.

    Example:
        >>> from cvtgs.cells.reference import merge_cells
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> points = scene.with_tensors({"log_scales": scene.log_scales - 9}, {})
        >>> cells = Partition.from_labels(torch.tensor([0, 0]), 1)
        >>> merged = merge_cells(points, cells, config=MergeConfig())
        >>> small, members = keep_representatives(points, merged, cells, areas=points.areas)
        >>> len(small), len(members.order)
        (1, 1)
    """
    order, offsets = partition.order, partition.offsets
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, order))
    opacities, own = opacities.double(), areas.index_select(0, order)
    masses = opacities * own
    best = segment_argmax(opacities * masses, offsets)
    together = segment_sum(masses, offsets)
    wide = torch.exp(parameters.log_mean_projected_area(merged.log_scales.double()))
    lone = (masses[best] ** 2 * wide > together**2 * own[best]) & (partition.counts > 1)
    if not bool(lone.any()):
        return merged, partition
    kept = order[best]
    heads, cells = scene.select(kept[lone]), lone.nonzero()[:, 0]
    tensors = _with_rows(merged.tensors(), cells, heads.tensors())
    extras = _with_rows(merged.extras, cells, heads.extras)
    shown = partition.keep_only(torch.where(lone, kept, -1))
    return merged.with_tensors(tensors, extras), shown


def _with_rows(
    columns: Mapping[str, Tensor], rows: Tensor, others: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    return {name: values.index_copy(0, rows, others[name]) for name, values in columns.items()}
