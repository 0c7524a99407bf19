"""Compose: merged Gaussians and residuals to corrected Gaussians."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells import Partition
from cvtgs.math import parameters
from cvtgs.math.segments import segment_sum, segment_sum_of
from cvtgs.mergenet.model import Residuals
from cvtgs.scene import GaussianScene


def compose(
    scene: GaussianScene,
    merged: GaussianScene,
    part: Partition,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    residuals: Residuals,
) -> dict[str, Tensor]:
    """Correct some merged Gaussians.

    Centres move and shapes turn in the frame of each merged Gaussian; log scales and opacity
    logits are added to; colours of every SH band mix in what sets members and neighbours apart.
    Residuals of zero give the merged Gaussians bit for bit. Differentiable in the residuals.

    Args:
        scene: The Gaussians.
        merged: One Gaussian per cell, of all cells.
        part: Members of the cells to correct.
        cells: Which cells those are.
        neighbors: The nearest other cells of each of them.
        residuals: What to change of them.

    Returns:
        The standard tensors of these cells, by name.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> merged, none = scene.select(torch.tensor([0])), torch.zeros(1, 3)
        >>> residuals = Residuals(
        ...     d_means=none, d_log_scales=none + 0.5, d_rotvecs=none, d_logit_opacities=none[:, 0],
        ...     member_colors=torch.tensor([0.0, 1.0]), pair_colors=torch.zeros(1, 0),
        ... )
        >>> tensors = compose(
        ...     scene, merged, Partition.from_labels(torch.tensor([0, 0]), 1),
        ...     cells=torch.tensor([0]), neighbors=torch.zeros(1, 0, dtype=torch.int64),
        ...     residuals=residuals,
        ... )
        >>> bool((tensors["log_scales"] == merged.log_scales + 0.5).all())
        True
        >>> bool(torch.isclose(tensors["sh0"][0], scene.sh0[1], atol=1e-6).all())
        True
    """
    own = merged.select(cells)
    quats = parameters.normalize_quats(own.quats)
    moves = torch.einsum(
        "mij,mj->mi", parameters.quats_to_matrices(quats), own.scales * residuals.d_means
    )
    tensors = {
        "means": own.means + moves,
        "quats": _turned(own.quats, residuals.d_rotvecs),
        "log_scales": own.log_scales + residuals.d_log_scales,
        "logit_opacities": own.logit_opacities + residuals.d_logit_opacities,
    }
    near = torch.arange(len(cells) + 1, device=cells.device) * neighbors.shape[1]
    for name in ("sh0", "shN"):
        bands = getattr(own, name)
        if bands.shape[1]:
            mixed = _mixed(
                getattr(scene, name), bands, part.order, part.offsets, residuals.member_colors
            )
            borrowed = _mixed(
                getattr(merged, name), bands, neighbors.flatten(), near, residuals.pair_colors
            )
            bands = bands + mixed + borrowed
        tensors[name] = bands
    return tensors


def _turned(quats: Float[Tensor, "m 4"], turns: Float[Tensor, "m 3"]) -> Float[Tensor, "m 4"]:
    """Turn about the own axes: the product with ``(1, turn / 2)``, of the same length."""
    half = turns / 2
    turn = torch.cat([torch.ones_like(half[:, :1]), half], dim=1)
    length = torch.sqrt(1 + half.square().sum(dim=1, keepdim=True))
    return parameters.multiply_quats(quats, turn) / length


def _mixed(
    values: Float[Tensor, "n_all b 3"],
    own: Float[Tensor, "m b 3"],
    rows: Int[Tensor, "r"],
    offsets: Int[Tensor, "m_plus_1"],
    gates: Float[Tensor, "..."],
) -> Float[Tensor, "m b 3"]:
    """Sum what sets the members or the neighbours of cells apart from them, each by its gate."""
    shares = gates.flatten()
    return (
        segment_sum_of(values, rows, offsets, shares)
        - own * segment_sum(shares, offsets)[:, None, None]
    )
