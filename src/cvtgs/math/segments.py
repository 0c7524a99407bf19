"""Segments, which are consecutive runs of rows (CSR): gathering and deterministic reductions."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

_WEIGHTS_ONLY_FAIL = torch.torch_version.TorchVersion(torch.__version__) < "2.6"
"""Whether ``embedding_bag`` fails if weights require gradients and the table does not."""


def sort_by_label(
    labels: Int[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "n"], Int[Tensor, "m_plus_1"]]:
    """Return the rows in the order of their labels, stably, and the start of each label."""
    ascending, order = torch.sort(labels.to(torch.int32), stable=True)
    starts = torch.arange(count + 1, dtype=torch.int32, device=labels.device)
    return order, torch.searchsorted(ascending, starts)


def true_rows(mask: Bool[Tensor, "n"], count: int | None = None) -> Int[Tensor, "k"]:
    """Return the rows where a mask is true; a known count avoids a synchronization."""
    if count is None or mask.device.type == "cpu":
        return mask.nonzero()[:, 0]
    return torch.sort(~mask, stable=True).indices[:count]


def kth_smallest(values: Float[Tensor, "*r n"], count: int) -> Float[Tensor, "*r"]:
    """Return the ``count``-th smallest value along the last dimension."""
    if values.device.type == "cpu":
        return values.kthvalue(count).values
    # CUDA's kthvalue fails where a program demands deterministic algorithms of torch.
    return values.topk(count, largest=False).values[..., -1]


def smallest_rows(values: Float[Tensor, "n"], count: int) -> Int[Tensor, "k"]:
    """Return rows of the smallest values, ascending and stable; a CPU sorts only those."""
    if 2 * count >= len(values) or values.device.type != "cpu":
        return ascending_rows(values)[:count]
    most = kth_smallest(values, count)
    candidates = (~(values > most)).nonzero()[:, 0]
    return candidates[ascending_rows(values[candidates])[:count]]


def ascending_rows(values: Float[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Return the rows in stable ascending order of values, with NaN at the end."""
    if values.device.type != "cpu" or values.dtype != torch.float64:
        return torch.sort(values, stable=True).indices
    # As integers, which torch sorts four times as fast on a CPU.
    bits = torch.where(values.isnan(), torch.nan, values + 0.0).view(torch.int64)  # no -0.0
    keys = bits ^ ((bits >> 63) & torch.iinfo(torch.int64).max)  # large negative numbers first
    return torch.sort(keys, stable=True).indices


def gather_columns(
    rows: Int[Tensor, "r"], *tables: Float[Tensor, "n c"]
) -> list[Float[Tensor, "r c"]]:
    """Gather scattered rows of narrow tables; columns become contiguous, which sums faster."""
    return [take_columns(rows, table.T).T for table in tables]


def take_columns(rows: Int[Tensor, "r"], table: Shaped[Tensor, "*c n"]) -> Shaped[Tensor, "*c r"]:
    """Return entries along the last dimension, in float64 four times as fast as index_select."""
    return table.gather(-1, rows.expand(*table.shape[:-1], -1))


def running_sums(values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return the cumulative sums of values; every run on a device gives the same bits."""
    if values.device.type == "cpu":
        return values.cumsum(0)
    step = 1  # CUDA's own sums add in any order; these are of Hillis and Steele (1986)
    while step < len(values):
        values = torch.cat([values[:step], values[step:] + values[:-step]])
        step *= 2
    return values


def label_sums(
    columns: Sequence[Float[Tensor, "n"]] | Float[Tensor, "k n"],
    labels: Int[Tensor, "n"],
    count: int,
    weights: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "k m"]:
    """Sum the rows of each label in their order, in float64: the same bits on every device."""
    on_host = labels.device.type == "cpu"  # adds in order; CUDA would add in any order
    order, offsets = (labels, labels) if on_host else sort_by_label(labels, count)
    buffer = None if weights is None else torch.empty_like(weights)  # new memory is slow to write
    sums = []
    for column in columns:
        values = column.double() if weights is None else torch.mul(weights, column, out=buffer)
        if on_host:
            sums.append(values.new_zeros(count).scatter_add_(0, labels, values))
        else:
            sums.append(segment_sum(values[order], offsets))
    return torch.stack(sums)


def label_argmin(
    values: Float[Tensor, "n"], labels: Int[Tensor, "n"], count: int
) -> Int[Tensor, "m"]:
    """Find the first row with the smallest value of each label; n for a label without rows."""
    labels = labels.long()  # torch 2.4 scatters by no others
    least = values.new_full((count,), torch.inf).scatter_reduce(0, labels, values, "amin")
    rows = torch.arange(len(labels), device=labels.device)
    rows = torch.where(values == least.index_select(0, labels), rows, len(labels))
    none = torch.full((count,), len(labels), device=labels.device)
    return none.scatter_reduce(0, labels, rows, "amin")


def segment_sum(
    values: Float[Tensor, "n *k"],
    offsets: Int[Tensor, "m_plus_1"],
    weights: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "m *k"]:
    """Sum the rows of each segment; an empty one gives 0. Weights are constants to autograd."""
    count, shape = offsets.shape[0] - 1, values.shape[1:]
    if values.numel() == 0:
        return values.new_zeros(count, *shape)
    flat = values.reshape(-1, math.prod(shape))
    if flat.requires_grad:
        sums: Tensor = _SumOfRuns.apply(flat, offsets, weights)  # type: ignore[no-untyped-call]
        return sums.reshape(count, *shape)
    if flat.dtype != torch.float64:  # up to ten times as fast as the below, unlike in float64
        rows = torch.arange(len(flat), device=flat.device)
        return segment_sum_of(values.contiguous(), rows, offsets, weights)  # columns would be slow
    flat, lengths = flat if weights is None else flat * weights[:, None], offsets.diff()
    if flat.is_contiguous():
        sums = torch.segment_reduce(flat, "sum", lengths=lengths, axis=0)
    else:  # no copy if columns are contiguous
        lengths = lengths.expand(flat.shape[1], -1).contiguous()
        sums = torch.segment_reduce(flat.T.contiguous(), "sum", lengths=lengths, axis=1).T
    return sums.reshape(count, *shape)


def segment_sum_of(
    table: Float[Tensor, "r *k"],
    rows: Int[Tensor, "n"],
    offsets: Int[Tensor, "m_plus_1"],
    weights: Float[Tensor, "n"] | None,
) -> Float[Tensor, "m *k"]:
    """Sum weighted rows of a table for each segment, without copying them or a gradient of them."""
    flat = table.detach().reshape(table.shape[0], math.prod(table.shape[1:]))
    if _WEIGHTS_ONLY_FAIL and weights is not None and weights.requires_grad:
        flat.requires_grad_()
    sums = torch.nn.functional.embedding_bag(
        rows, flat, offsets, mode="sum", per_sample_weights=weights, include_last_offset=True
    )
    return sums.reshape(offsets.shape[0] - 1, *table.shape[1:])


def segment_max(
    values: Float[Tensor, "n *k"], offsets: Int[Tensor, "m_plus_1"]
) -> Float[Tensor, "m *k"]:
    """Return the elementwise maximum of the rows of each segment; minus infinity without rows."""
    ids = segment_ids(offsets, len(values)).reshape(-1, *[1] * (values.ndim - 1)).expand_as(values)
    lowest = values.new_full((len(offsets) - 1, *values.shape[1:]), -torch.inf)
    return lowest.scatter_reduce(0, ids, values, "amax")


def segment_ids(offsets: Int[Tensor, "m_plus_1"], total: int | None = None) -> Int[Tensor, "n"]:
    """Return the segment of every row; without ``total``, the number of rows, the device waits."""
    return torch.repeat_interleave(offsets.diff(), output_size=total)


def segment_argmax(
    values: Float[Tensor, "n"], offsets: Int[Tensor, "m_plus_1"]
) -> Int[Tensor, "m"]:
    """Find the first row with the largest value of each segment, none of them empty."""
    return label_argmin(-values, segment_ids(offsets, len(values)), len(offsets) - 1)


class _SumOfRuns(torch.autograd.Function):
    """The sum of segments; its gradient needs only offsets and weights."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, offsets: Tensor, weights: Tensor | None) -> Tensor:
        ctx.save_for_backward(offsets, weights)
        ctx.total = len(values)
        return segment_sum(values.detach(), offsets, weights)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        offsets, weights = ctx.saved_tensors
        spread = grad.index_select(0, segment_ids(offsets, ctx.total))
        return spread if weights is None else spread * weights[:, None], None, None
