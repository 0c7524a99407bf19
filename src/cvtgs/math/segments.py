"""Consecutive runs of rows (CSR segments): partitions, gathering, deterministic reductions."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.errors import InvalidArgumentError


def sort_by_label(
    labels: Int[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "n"], Int[Tensor, "m_plus_1"]]:
    """Bring rows of one label next to one another.

    Args:
        labels: Label of every row, 0 to ``count - 1``.
        count: Number of labels.

    Returns:
        Row numbers, by label and then as they were, and where each label starts.

    Example:
        >>> order, offsets = sort_by_label(torch.tensor([1, 0, 1]), 2)
        >>> order.tolist(), offsets.tolist()
        ([1, 0, 2], [0, 1, 3])
    """
    ascending, order = torch.sort(labels.to(torch.int32), stable=True)
    starts = torch.arange(count + 1, dtype=torch.int32, device=labels.device)
    return order, torch.searchsorted(ascending, starts)


def gather_columns(
    rows: Int[Tensor, "r"], *tables: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "r c"], ...]:
    """Take rows that lie all over narrow tables.

    Args:
        rows: Row numbers.
        tables: One or more tables of a few columns.

    Returns:
        The rows of every table; the values of one column are one run of memory, so that sums of
        products over columns are as fast as memory.

    Example:
        >>> gather_columns(torch.tensor([2, 0]), torch.eye(3))[0].tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """
    found = []
    for table in tables:
        found.append(table.T.gather(1, rows.expand(table.shape[1], -1)).T)
    return tuple(found)


def label_sums(
    columns: Sequence[Float[Tensor, "n"]], labels: Int[Tensor, "n"], count: int
) -> Float[Tensor, "m k"]:
    """Sum rows of one label, in the order of the rows, in float64.

    Args:
        columns: One tensor per column.
        labels: Label of every row, 0 to ``count - 1``.
        count: Number of labels, m.

    Returns:
        One row per label; a label without rows gives 0. Every device gives the same bits.

    Example:
        >>> label_sums([torch.tensor([1.0, 2.0, 4.0])], torch.tensor([1, 0, 1]), 2).tolist()
        [[2.0], [5.0]]
    """
    if labels.device.type == "cpu":  # in order; CUDA would add in any
        sums = torch.empty(count, len(columns), dtype=torch.float64)
        for number, column in enumerate(columns):
            sums[:, number] = torch.bincount(labels, column.double(), minlength=count)
        return sums
    order, offsets = sort_by_label(labels, count)
    return torch.stack([segment_sum(column.double()[order], offsets) for column in columns], dim=1)


def segment_sum(
    values: Float[Tensor, "n *k"],
    offsets: Int[Tensor, "m_plus_1"],
    weights: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "m *k"]:
    """Sum runs of rows.

    Bags of consecutive rows are up to ten times as fast as ``torch.segment_reduce`` in float32,
    and up to twenty times as slow in float64.

    Args:
        values: Rows, those of one segment next to one another.
        offsets: Where each segment starts, and the end of the last one.
        weights: Numbers to multiply rows by, of the dtype of the values; constants to autograd.

    Returns:
        One row per segment; an empty segment gives 0.

    Example:
        >>> segment_sum(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 2, 3])).tolist()
        [3.0, 3.0]
    """
    count, shape = offsets.shape[0] - 1, values.shape[1:]
    if values.numel() == 0:
        return values.new_zeros(count, *shape)
    flat = values.reshape(-1, math.prod(shape))
    if flat.requires_grad:
        sums: Tensor = _SumOfRuns.apply(flat, offsets, weights)  # type: ignore[no-untyped-call]
        return sums.reshape(count, *shape)
    if flat.dtype != torch.float64:
        sums = torch.nn.functional.embedding_bag(
            torch.arange(len(flat), device=flat.device),
            flat.contiguous(),  # columns are as slow as float64
            offsets,
            mode="sum",
            per_sample_weights=weights,
            include_last_offset=True,
        )
        return sums.reshape(count, *shape)
    flat, lengths = flat if weights is None else flat * weights[:, None], offsets.diff()
    if flat.is_contiguous():
        sums = torch.segment_reduce(flat, "sum", lengths=lengths, axis=0)
    else:  # without a copy where columns lie in runs of memory
        lengths = lengths.expand(flat.shape[1], -1).contiguous()
        sums = torch.segment_reduce(flat.T.contiguous(), "sum", lengths=lengths, axis=1).T
    return sums.reshape(count, *shape)


def segment_sum_of(
    table: Float[Tensor, "r *k"],
    rows: Int[Tensor, "n"],
    offsets: Int[Tensor, "m_plus_1"],
    weights: Float[Tensor, "n"],
) -> Float[Tensor, "m *k"]:
    """Sum weighted rows of a table, which are read from there and never copied.

    Args:
        table: The rows that there are; a constant to autograd.
        rows: Which rows to sum, those of one segment next to one another.
        offsets: Where each segment starts in ``rows``, and the end of the last one.
        weights: What each of ``rows`` counts.

    Returns:
        One row per segment; an empty segment gives 0. Differentiable in the weights.

    Example:
        >>> table, rows = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2, 2, 0])
        >>> segment_sum_of(table, rows, torch.tensor([0, 2, 3]), torch.ones(3)).tolist()
        [6.0, 1.0]
    """
    flat = table.detach().reshape(table.shape[0], math.prod(table.shape[1:]))
    sums = torch.nn.functional.embedding_bag(
        rows, flat, offsets, mode="sum", per_sample_weights=weights, include_last_offset=True
    )
    return sums.reshape(offsets.shape[0] - 1, *table.shape[1:])


def segment_max(
    values: Float[Tensor, "n *k"], offsets: Int[Tensor, "m_plus_1"]
) -> Float[Tensor, "m *k"]:
    """Take the largest row entry of each run of rows.

    Args:
        values: Rows, those of one segment next to one another.
        offsets: Where each segment starts, and the end of the last one.

    Returns:
        One row per segment; an empty segment gives minus infinity.

    Example:
        >>> segment_max(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 2, 3])).tolist()
        [2.0, 3.0]
    """
    ids = segment_ids(offsets, len(values)).reshape(-1, *[1] * (values.ndim - 1)).expand_as(values)
    lowest = values.new_full((len(offsets) - 1, *values.shape[1:]), -torch.inf)
    return lowest.scatter_reduce(0, ids, values, "amax")


def segment_ids(offsets: Int[Tensor, "m_plus_1"], total: int | None = None) -> Int[Tensor, "n"]:
    """Return the segment of every row.

    Args:
        offsets: Where each segment starts, and the end of the last one.
        total: Number of rows; None is read from the offsets, for which the host waits.

    Returns:
        Segment numbers, ascending.

    Example:
        >>> segment_ids(torch.tensor([0, 2, 3])).tolist()
        [0, 0, 1]
    """
    return torch.repeat_interleave(offsets.diff(), output_size=total)


def segment_argmax(
    values: Float[Tensor, "n"], offsets: Int[Tensor, "m_plus_1"]
) -> Int[Tensor, "m"]:
    """Find the first row with the largest value of each segment.

    Args:
        values: One number per row, none of them NaN.
        offsets: Where each segment starts, and the end of the last one; no segment is empty.

    Returns:
        Row numbers.

    Example:
        >>> segment_argmax(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 2, 3])).tolist()
        [1, 2]
    """
    ids = segment_ids(offsets, len(values))
    is_top = values == segment_max(values, offsets)[ids]
    rows = torch.arange(len(values), device=values.device)
    candidates = torch.where(is_top, rows, len(values))
    first = torch.full((len(offsets) - 1,), len(values), device=values.device)
    return first.scatter_reduce(0, ids, candidates, "amin")


class _SumOfRuns(torch.autograd.Function):
    """The sum of runs whose gradient needs no more than the offsets."""

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Partition:
    """Members of every cell in compressed (CSR) form.

    Attributes:
        order: ``(n,)`` row numbers, those of one cell next to one another.
        offsets: ``(m + 1,)`` where each cell starts in ``order``, and the end of the last one.
    """

    order: Int[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]

    @classmethod
    def from_labels(cls, labels: Int[Tensor, "n"], count: int) -> Self:
        """Build the partition of labelled rows.

        Args:
            labels: Cell of every row, 0 to ``count - 1``.
            count: Number of cells.

        Returns:
            The partition; the members of a cell keep their order.

        Raises:
            InvalidArgumentError: A label is out of range, or a cell has no member.

        Example:
            >>> Partition.from_labels(torch.tensor([1, 0, 1]), 2).order.tolist()
            [1, 0, 2]
        """
        order, offsets = sort_by_label(labels, count)
        ends, empty = labels.aminmax() if len(labels) else (), offsets.diff() == 0
        *found, missing = torch.stack([*ends, empty.sum()]).tolist()  # a device is asked only once
        if found and (found[0] < 0 or found[1] >= count):
            raise InvalidArgumentError(
                f"labels must be between 0 and {count - 1}, found {found[0]} to {found[1]}."
            )
        if missing:
            first = int(empty.nonzero()[0])
            raise InvalidArgumentError(
                f"every cell needs a member; {missing} have none, the first is {first}."
            )
        return cls(order=order, offsets=offsets)

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.offsets) - 1

    @property
    def counts(self) -> Int[Tensor, "m"]:
        """Members of every cell."""
        return self.offsets.diff()

    def labels(self, count: int) -> Int[Tensor, "n"]:
        """Return the cell of every row, the inverse of :meth:`from_labels`.

        Args:
            count: Number of rows.

        Returns:
            Cells, int32; -1 for rows that belong to none.

        Example:
            >>> Partition.from_labels(torch.tensor([1, 0, 1]), 2).labels(4).tolist()
            [1, 0, 1, -1]
        """
        cells = torch.arange(len(self), dtype=torch.int32, device=self.order.device)
        found = cells.new_full((count,), -1)
        found[self.order] = torch.repeat_interleave(cells, self.counts)
        return found

    def select(self, cells: Int[Tensor, "k"] | Bool[Tensor, "m"]) -> Self:
        """Keep some cells.

        Args:
            cells: The cells to keep, ascending, or a mask of them.

        Returns:
            Their partition, in the same order.
        """
        counts = self.counts
        if cells.dtype == torch.bool:
            cells = cells.nonzero()[:, 0]
        is_kept = torch.zeros_like(counts, dtype=torch.bool).index_fill(0, cells, value=True)
        members = torch.repeat_interleave(is_kept, counts, output_size=len(self.order))
        offsets = torch.nn.functional.pad(counts[cells].cumsum(0), (1, 0))
        return type(self)(order=self.order[members], offsets=offsets)

    def keep_only(self, rows: Int[Tensor, "m"]) -> Self:
        """Keep one member of some cells.

        Args:
            rows: The row number of the member to keep; -1 keeps all members of a cell.

        Returns:
            The partition of the same cells.

        Example:
            >>> whole = Partition.from_labels(torch.tensor([1, 0, 1]), 2)
            >>> whole.keep_only(torch.tensor([-1, 2])).order.tolist()
            [1, 2]
        """
        counts = self.counts
        kept = torch.repeat_interleave(rows, counts, output_size=len(self.order))
        offsets = torch.nn.functional.pad(torch.where(rows < 0, counts, 1).cumsum(0), (1, 0))
        return type(self)(order=self.order[(kept < 0) | (kept == self.order)], offsets=offsets)

    def cut(self, run: slice) -> Self:
        """Keep some consecutive cells.

        Args:
            run: From which cell to which, at least one.

        Returns:
            Their partition; its order is a view.
        """
        if run.start == 0 and run.stop >= len(self):
            return self
        ends = self.offsets[run.start : run.stop + 1]
        return type(self)(order=self.order[int(ends[0]) : int(ends[-1])], offsets=ends - ends[0])

    def to(self, device: torch.device) -> Self:
        """Move the partition to a device.

        Args:
            device: Where to.

        Returns:
            The partition there.
        """
        return type(self)(order=self.order.to(device), offsets=self.offsets.to(device))

    def chunks(self, max_members: int, *, cell_cost: int = 0) -> Iterator[tuple[slice, Self]]:
        """Cut the partition into runs of cells, to bound memory.

        Args:
            max_members: Members of one run at most; a larger cell is a run of its own.
            cell_cost: A cell counts as this many members more than it has.

        Yields:
            The cells of the run, and their partition.
        """
        if len(self) and len(self.order) + cell_cost * len(self) <= max_members:
            yield slice(0, len(self)), self
            return
        first, costs = 0, self.offsets.cpu()
        if cell_cost:
            costs = costs + cell_cost * torch.arange(len(costs))
        while first < len(self):
            fitting = torch.searchsorted(costs, costs[first] + max_members, right=True)
            last = max(first + 1, int(fitting) - 1)
            yield slice(first, last), self.cut(slice(first, last))
            first = last
