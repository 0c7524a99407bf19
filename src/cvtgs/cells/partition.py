"""Partition: the members of every cell, as consecutive runs of rows, or a sample of them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor

from cvtgs.checks import check_kinds, check_range, checked
from cvtgs.counts import checked_whole
from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters
from cvtgs.math.segments import (
    gather_columns,
    running_sums,
    segment_ids,
    segment_max,
    sort_by_label,
    true_rows,
)
from cvtgs.scene import GaussianScene
from cvtgs.text import short_repr, shown

MOST_SAMPLED = 32  # largest number of described members of a cell

LEAST_RATE = 1e-9  # limit of rates: rounding may sample a member of no mass

START = 0.5 * (3.0 - math.sqrt(5.0))
"""Where sampling starts, in steps: irrational, or rounding would decide between equal masses."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Partition:
    """Members of every cell in compressed (CSR) form.

    Attributes:
        order: ``(n,)`` row numbers; those of one cell are contiguous.
        offsets: ``(m + 1,)`` start of each cell in ``order``, and the end of the last one.
        singles: Number of cells of one member if the host has it, which saves a synchronization.
    """

    order: Int[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]
    singles: int | None = None

    __repr__ = short_repr

    @classmethod
    @checked
    def from_labels(cls, labels: Integer[Tensor, "n"], count: int) -> Self:
        """Build the partition of rows by labels, 0 to ``count - 1``; members keep their order.

        Raises:
            InvalidArgumentError: Labels are no integers, one is out of range, or a cell has no
                member.

        Example:
            >>> Partition.from_labels(torch.tensor([1, 0, 1]), 2).order.tolist()
            [1, 0, 2]
        """
        count = checked_whole(count, "count")
        order, offsets = sort_by_label(labels, count)
        ends, counts = labels.aminmax() if len(labels) else (), offsets.diff()
        sums = (counts == 0).sum(), (counts == 1).sum()
        *found, missing, singles = torch.stack([*ends, *sums]).tolist()  # one transfer to the host
        if found and (found[0] < 0 or found[1] >= count):
            raise InvalidArgumentError(
                f"labels must be between 0 and {count - 1}, found {found[0]} to {found[1]}."
            )
        if missing:
            first = int((counts == 0).nonzero()[0])
            raise InvalidArgumentError(
                f"every cell needs a member; {missing} have none, the first is {first}."
            )
        return cls(order=order, offsets=offsets, singles=singles)

    def check(self, total: int) -> None:
        """Check that the cells are made of the rows of a scene, ``total`` in number.

        Raises:
            InvalidArgumentError: Types or shapes are wrong, a row is out of range, or a cell is
                empty; values on other devices than CPUs are not checked, which would wait for them.
        """
        check_kinds(
            {"order": Int[Tensor, "n"], "offsets": Int[Tensor, "m_plus_1"]},
            {"order": self.order, "offsets": self.offsets},
        )
        check_range(self.order, total - 1, "rows of the partition")
        if self.offsets.device.type == "cpu":
            ends, count = torch.cat([self.offsets[:1], self.offsets[-1:]]), len(self.order)
            if ends.tolist() != [0, count] or bool((self.counts < 1).any()):
                raise InvalidArgumentError(
                    f"offsets must increase from 0 to the {count} rows of the partition, "
                    f"found {shown(self.offsets.tolist())}."
                )

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.offsets) - 1

    @property
    def counts(self) -> Int[Tensor, "m"]:
        """The number of members of every cell."""
        return self.offsets.diff()

    def count_singles(self) -> int:
        """Return the number of cells of one member."""
        return int((self.counts == 1).sum()) if self.singles is None else self.singles

    def labels(self, count: int) -> Int[Tensor, "n"]:
        """Return the cell of ``count`` rows, the inverse of :meth:`from_labels`, in int32.

        It is -1 for rows that belong to none.

        Example:
            >>> Partition.from_labels(torch.tensor([1, 0, 1]), 2).labels(4).tolist()
            [1, 0, 1, -1]
        """
        cells = torch.arange(len(self), dtype=torch.int32, device=self.order.device)
        found = cells.new_full((count,), -1)
        found[self.order] = torch.repeat_interleave(cells, self.counts)
        return found

    def several(self) -> Int[Tensor, "k"]:
        """Return the cells of several members, ascending."""
        known = None if self.singles is None else len(self) - self.singles
        return true_rows(self.counts > 1, known)

    def select(self, cells: Int[Tensor, "k"] | Bool[Tensor, "m"], total: int | None = None) -> Self:
        """Keep some cells, ascending or by a mask; ``total`` members, if that is known."""
        counts = self.counts
        cells = cells.nonzero()[:, 0] if cells.dtype == torch.bool else cells
        is_kept = torch.zeros_like(counts, dtype=torch.bool).index_fill(0, cells, value=True)
        members = torch.repeat_interleave(is_kept, counts, output_size=len(self.order))
        offsets = torch.nn.functional.pad(counts[cells].cumsum(0), (1, 0))
        return type(self)(order=self.order[true_rows(members, total)], offsets=offsets)

    def select_several(self) -> tuple[Int[Tensor, "k"], Self]:
        """Return the cells of several members, ascending, and their partition."""
        cells = self.several()
        return cells, self.select(cells, len(self.order) - (len(self) - len(cells)))

    def keep_only(self, rows: Int[Tensor, "m"], total: int | None = None) -> Self:
        """Keep only one member of some cells: the row of each, or all members where that is -1.

        ``total`` is the number of kept members, if known.

        Example:
            >>> whole = Partition.from_labels(torch.tensor([1, 0, 1]), 2)
            >>> whole.keep_only(torch.tensor([-1, 2])).order.tolist()
            [1, 2]
        """
        counts = self.counts
        kept = torch.repeat_interleave(rows, counts, output_size=len(self.order))
        offsets = torch.nn.functional.pad(torch.where(rows < 0, counts, 1).cumsum(0), (1, 0))
        members = true_rows((kept < 0) | (kept == self.order), total)
        return type(self)(order=self.order[members], offsets=offsets)

    def cut(self, run: slice) -> Self:
        """Keep some consecutive cells, at least one; ``order`` becomes a view."""
        if run.start == 0 and run.stop >= len(self):
            return self
        ends = self.offsets[run.start : run.stop + 1]
        return type(self)(order=self.order[int(ends[0]) : int(ends[-1])], offsets=ends - ends[0])

    def to(self, device: torch.device) -> Self:
        """Return the partition on a device."""
        order, offsets = self.order.to(device), self.offsets.to(device)
        return type(self)(order=order, offsets=offsets, singles=self.singles)

    def chunks(self, max_members: int, *, cell_cost: int = 0) -> Iterator[tuple[slice, Self]]:
        """Split the partition into runs of at most ``max_members`` members, to bound memory.

        A larger cell is a run of its own; ``cell_cost`` members are added to the size of each cell.

        Yields:
            The range of cells of the run, and their partition.
        """
        count = len(self)
        if count and len(self.order) + cell_cost * count <= max_members:
            yield slice(0, count), self
            return
        costs = self.offsets.cpu() + cell_cost * torch.arange(count + 1, device="cpu")
        first = 0
        while first < count:
            fitting = torch.searchsorted(costs, costs[first] + max_members, right=True)
            last = max(first + 1, int(fitting) - 1)
            yield slice(first, last), self.cut(slice(first, last))
            first = last


class SampledMembers(NamedTuple):
    """Some members of every cell."""

    part: Partition  # the sampled members
    counts: Int[Tensor, "m"]  # number of all members of every cell
    rates: Float[Tensor, "n"]  # expected share of members of this mass that are sampled, above 0


def sample_members(scene: GaussianScene, part: Partition) -> SampledMembers:
    """Take all members of small cells, and of large cells some in proportion to their mass.

    Sums over all members are estimated by sampled values over rates (Horvitz and Thompson 1952).
    """
    counts, offsets, total = part.counts, part.offsets, len(part.order)
    on_host = part.order.device.type == "cpu"
    if total <= MOST_SAMPLED or (on_host and int(counts.amax()) <= MOST_SAMPLED):
        return SampledMembers(part, counts, scene.logit_opacities.new_ones(total))
    ids = segment_ids(offsets, total)
    (log_scales,) = gather_columns(part.order, scene.log_scales)
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, part.order))
    areas = parameters.log_mean_projected_area(log_scales.double())
    logs = areas + parameters.positive_log(opacities.double())
    masses = torch.exp(logs - segment_max(logs, offsets).index_select(0, ids))
    # Systematic sampling (Madow 1949) where the sum of masses along a space-filling curve passes
    # equal steps, in float64, so that every dtype gives the same sample.
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
