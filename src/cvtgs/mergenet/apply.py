"""Apply MergeNet: correct the cells of a scene by the residuals that the network predicts."""

import math
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells import Partition
from cvtgs.cells.features import NeighborContext, describe_members, neighbor_context
from cvtgs.devices import chunk_length, in_threads
from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters
from cvtgs.math.segments import segment_sum, segment_sum_of
from cvtgs.mergenet.model import MergeNet, Residuals
from cvtgs.mergenet.published import Net, PublishedMergeNet, PublishedResiduals, describe_published
from cvtgs.scene import GaussianScene

CHUNK_MEMBERS = 1 << 15  # members and neighbours per chunk; each takes about ``2 kB``

FLATNESS = 25.0
"""Ratio of standard deviations from which on turns between two axes are reduced: the ends of a
flat cell leave its plane by many thicknesses, though its members hardly call for it."""

_LARGEST = 1e15

Corrected = tuple[Tensor, dict[str, Tensor]]  # numbers of some cells, and their corrected tensors
Corrections = Generator[Corrected, None, None]


def correct_cells(  # noqa: PLR0913 (options by name)
    net: Net,
    scene: GaussianScene,
    merged: GaussianScene,
    partition: Partition,
    *,
    neighbors: Int[Tensor, "m k"],
    visibility: Float[Tensor, "n"],
    pixel_size: float,
    sizes: Int[Tensor, "m_all"] | None = None,
    on_cells: Callable[[int], None] = lambda done: None,
) -> GaussianScene:
    """Correct every merged Gaussian of several members with a network.

    Args:
        net: The network, of the device and dtype of the scene (:meth:`CellNetwork.copy_to`).
        scene: The Gaussians, with valid rows.
        merged: One Gaussian per cell: first those of the partition, then others that serve only
            as neighbours.
        partition: Members of the cells; cells of one member stay as they are.
        neighbors: The nearest other cells of every cell of the partition.
        visibility: Ambient visibility of every Gaussian of the scene, 0 to 1.
        pixel_size: Size of a pixel in the middle of the scene, scene units.
        sizes: Number of members of every cell in ``merged``; None if all are in the partition.
        on_cells: Called with the number of finished cells.

    Returns:
        The scene with corrected Gaussians.

    Raises:
        InvalidArgumentError: The network has another dtype than the scene, or needs a visibility
            of every Gaussian.

    Example:
        >>> from cvtgs.cells import merge_cells
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.mergenet import Architecture
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 5, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 0, 0, 1, 1]), 2)
        >>> merged = merge_cells(scene, cells, config=MergeConfig())
        >>> untrained = MergeNet(Architecture())
        >>> corrected = correct_cells(
        ...     untrained, scene, merged, cells,
        ...     neighbors=torch.tensor([[1], [0]]), visibility=torch.ones(5), pixel_size=0.01,
        ... )
        >>> bool((corrected.means == merged.means).all())
        True
    """
    dtype = next(net.parameters()).dtype
    if dtype != scene.dtype:
        raise InvalidArgumentError(
            f"the network must have the dtype of the scene, {scene.dtype}, found {dtype}; "
            f"net.copy_to(scene.device, scene.dtype) returns one that has."
        )
    sizes = partition.counts if sizes is None else sizes
    cells, several = partition.select_several()
    done = len(partition) - len(cells)
    if len(cells) == 0:
        return merged
    originals = merged.tensors()
    tensors = {name: values.clone() for name, values in originals.items() if values.numel()}
    if isinstance(net, PublishedMergeNet):
        corrections = _correct_as_published(net, scene, merged, several, cells=cells)
    else:
        corrections = _correct_gated(
            net,
            scene,
            merged,
            several,
            cells=cells,
            neighbors=neighbors,
            visibility=visibility,
            sizes=sizes,
            pixel_size=pixel_size,
        )
    with torch.no_grad(), closing(corrections):  # an error in `on_cells` ends their threads
        for rows, corrected in corrections:
            # Near the limits of the dtype (a flyaway at 3e38) a correction may overflow.
            flat = [corrected[name].reshape(len(rows), -1) for name in tensors]
            finite = torch.stack([values.isfinite().all(dim=1) for values in flat]).all(dim=0)
            for name, values in tensors.items():
                is_used = finite.view(-1, *[1] * (values.dim() - 1))
                values[rows] = torch.where(is_used, corrected[name], originals[name][rows])
            done += len(rows)
            on_cells(done)
    return merged.with_tensors(tensors)


def _correct_gated(  # noqa: PLR0913 (options by name)
    net: MergeNet,
    scene: GaussianScene,
    merged: GaussianScene,
    several: Partition,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m_all k"],
    visibility: Float[Tensor, "n"],
    sizes: Int[Tensor, "m_all"],
    pixel_size: float,
) -> Corrections:
    """Yield runs of cells and their corrected tensors."""
    if len(visibility) != len(scene):
        raise InvalidArgumentError(
            f"visibility must be a number for each of {len(scene):,} Gaussians, found "
            f"{len(visibility):,}; analyze(..., with_visibility=True) computes it."
        )
    chunk, near = chunk_length(CHUNK_MEMBERS, scene.device), neighbors.shape[1]
    step = max(1, chunk // max(1, near))

    def chunks() -> Iterator[tuple[Tensor, NeighborContext, Partition]]:
        for start in range(0, len(cells), step):
            block = slice(start, start + step)
            own = cells[block]
            context = neighbor_context(merged, cells=own, neighbors=neighbors[own], sizes=sizes)
            for run, part in several.cut(block).chunks(chunk, cell_cost=near):
                yield own[run], context.cut(run), part

    def correct(item: tuple[Tensor, NeighborContext, Partition]) -> Corrected:
        rows, context, part = item
        descriptors = describe_members(
            scene, part, context=context, visibility=visibility, pixel_size=pixel_size
        )
        residuals, own, members = net(descriptors), neighbors[rows], descriptors.part
        return rows, compose(scene, merged, members, cells=rows, neighbors=own, residuals=residuals)

    return in_threads(correct, chunks(), scene.device)


def _correct_as_published(
    net: PublishedMergeNet,
    scene: GaussianScene,
    merged: GaussianScene,
    several: Partition,
    *,
    cells: Int[Tensor, "m"],
) -> Corrections:
    """Yield runs of cells and their corrected tensors."""

    def correct(item: tuple[slice, Partition]) -> Corrected:
        run, part = item
        rows = cells[run]
        descriptors = describe_published(scene, merged, part, cells=rows)
        return rows, compose_published(merged, cells=rows, residuals=net(descriptors))

    chunks = several.chunks(chunk_length(CHUNK_MEMBERS, scene.device))
    return in_threads(correct, chunks, scene.device)


def compose(
    scene: GaussianScene,
    merged: GaussianScene,
    part: Partition,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    residuals: Residuals,
) -> dict[str, Tensor]:
    """Correct some merged Gaussians; return their standard tensors by name.

    Centres move and shapes turn in the frame of each merged Gaussian; residuals are added to log
    scales and opacity logits; every SH band gets shares of the differences of members and
    neighbours. Zero residuals return the merged Gaussians bit for bit. Differentiable in the
    residuals. ``cells`` are the rows in ``merged`` of the cells to correct, ``part`` their members,
    and ``neighbors`` their nearest other cells.

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
    turns = residuals.d_rotvecs * turn_limits(merged.log_scales.index_select(0, cells))
    tensors = _reshape(merged, cells, replace(residuals, d_rotvecs=turns))
    ends = torch.arange(len(cells) + 1, device=cells.device) * neighbors.shape[1]
    others, pair_shares = neighbors.flatten(), residuals.pair_colors.flatten()
    member_totals = segment_sum(residuals.member_colors, part.offsets)[:, None, None]
    pair_totals = segment_sum(pair_shares, ends)[:, None, None]
    for name in ("sh0", "shN"):
        table = getattr(merged, name)
        bands = table.index_select(0, cells)
        if bands.shape[1]:
            # Differences of members and neighbours from the cell, each times its share.
            mixed = segment_sum_of(
                getattr(scene, name), part.order, part.offsets, residuals.member_colors
            )
            borrowed = segment_sum_of(table, others, ends, pair_shares)
            bands = bands + (mixed - bands * member_totals) + (borrowed - bands * pair_totals)
        tensors[name] = bands
    return tensors


def turn_limits(log_scales: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """Return factors of rotations about each axis, which turn the other two into one another."""
    x, y, z = log_scales.unbind(1)
    ratios = torch.stack([y - z, x - z, x - y], dim=1).abs()
    return (math.log(FLATNESS) - ratios).clamp(max=0.0).exp()


def compose_published(
    merged: GaussianScene, *, cells: Int[Tensor, "m"], residuals: PublishedResiduals
) -> dict[str, Tensor]:
    """Correct some merged Gaussians like :func:`compose`, by unlimited residuals, also of SH."""
    rest = merged.shN.shape[1]
    bands = {
        "sh0": merged.sh0.index_select(0, cells) + residuals.d_sh[:, :1],
        "shN": merged.shN.index_select(0, cells) + residuals.d_sh[:, 1 : 1 + rest],
    }
    return _reshape(merged, cells, residuals) | bands


def _reshape(
    merged: GaussianScene, cells: Int[Tensor, "m"], residuals: Residuals | PublishedResiduals
) -> dict[str, Tensor]:
    """Return all but the colours of corrected cells."""
    quats = merged.quats.index_select(0, cells)
    log_scales = merged.log_scales.index_select(0, cells)
    logits = merged.logit_opacities.index_select(0, cells)
    axes = parameters.rotation_matrices(quats)
    moves = torch.einsum("mij,mj->mi", axes, torch.exp(log_scales) * residuals.d_means)
    # A rotation v about the local axes multiplies by (1, v / 2) and keeps the length.
    half = (residuals.d_rotvecs / 2).clamp(-_LARGEST, _LARGEST)  # squares must not overflow
    turns = torch.cat([torch.ones_like(half[:, :1]), half], dim=1)
    lengths = torch.sqrt(1 + half.square().sum(dim=1, keepdim=True))
    return {
        "means": merged.means.index_select(0, cells) + moves,
        "quats": parameters.multiply_quats(quats, turns) / lengths,
        "log_scales": log_scales + residuals.d_log_scales,
        "logit_opacities": logits + residuals.d_logit_opacities,
    }
