"""Partition: members of every cell as runs of row numbers."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from cvtgs.cells import Partition
from cvtgs.errors import InvalidArgumentError
from pretended_device import pretended_cuda


def lists_of(partition: Partition) -> list[list[int]]:
    ends = partition.offsets.tolist()
    rows = partition.order.tolist()
    return [rows[first:last] for first, last in pairwise(ends)]


def partition_of(counts: list[int]) -> Partition:
    labels = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    shuffle = torch.randperm(len(labels), generator=torch.Generator().manual_seed(0))
    return Partition.from_labels(labels[shuffle], len(counts))


def test_known_labels():
    partition = Partition.from_labels(torch.tensor([2, 0, 2, 1, 0]), 3)
    assert lists_of(partition) == [[1, 4], [3], [0, 2]]
    assert partition.counts.tolist() == [2, 1, 2]
    assert len(partition) == 3


def test_select_keeps_order():
    partition = Partition.from_labels(torch.tensor([2, 0, 2, 1, 0]), 3)
    for total in (None, 4):
        for cells in (torch.tensor([0, 2]), torch.tensor([True, False, True])):
            assert lists_of(partition.select(cells, total)) == [[1, 4], [0, 2]]
    none = partition.select(torch.tensor([False, False, False]))
    assert len(none) == 0
    assert lists_of(none) == []
    assert list(none.chunks(5)) == []


def test_cells_of_several_members():
    partition = partition_of([2, 1, 3, 1])
    for known in (partition, replace(partition, singles=None)):
        assert known.count_singles() == 2
        assert known.several().tolist() == [0, 2]
        cells, several = known.select_several()
        assert cells.tolist() == [0, 2]
        assert lists_of(several) == lists_of(partition)[::2]


@pytest.mark.slow
def test_no_device_synchronization_where_sizes_are_known():
    partition = partition_of([2, 1, 3, 1])
    first = partition.order[partition.offsets[2]]
    rows = torch.tensor([-1, -1, int(first), -1])
    wanted = lists_of(partition)
    with pretended_cuda() as traffic:
        there = partition.to(torch.device("cuda"))
        (_, several), shown = there.select_several(), there.keep_only(rows.to("cuda"), total=5)
        assert not traffic.waits
        assert lists_of(several) == wanted[::2]
        assert lists_of(shown) == [*wanted[:2], wanted[2][:1], wanted[3]]


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_labels_of_every_integer_dtype(dtype):
    assert lists_of(Partition.from_labels(torch.tensor([1, 0], dtype=dtype), 2)) == [[1], [0]]


@pytest.mark.parametrize("limit", [1, 2, 3, 7, 1000])
def test_chunks_hold_every_cell_once_and_whole(limit):
    partition = partition_of([1, 2, 3, 1, 1, 9, 1, 2])
    wanted, found, next_cell = lists_of(partition), [], 0
    for run, part in partition.chunks(limit):
        assert run.start == next_cell
        assert run.stop - run.start == len(part)
        assert int(part.offsets[0]) == 0
        assert len(part.order) <= limit or len(part) == 1
        found += lists_of(part)
        next_cell = run.stop
    assert found == wanted


def test_chunks_are_as_large_as_the_limit_allows():
    runs = [part.counts.tolist() for _, part in partition_of([2, 2, 1, 5, 1, 1]).chunks(5)]
    assert runs == [[2, 2, 1], [5], [1, 1]]


def test_a_cell_larger_than_a_chunk_gets_a_chunk_of_its_own():
    runs = [part.counts.tolist() for _, part in partition_of([1, 50, 1, 1]).chunks(10)]
    assert runs == [[1], [50], [1, 1]]


def test_each_cell_adds_a_cost_to_that_of_its_members():
    """Each cell costs as much as 3 more members: 5, 5, 4, 8, 4, 4 in chunks of 10."""
    partition = partition_of([2, 2, 1, 5, 1, 1])
    runs = [part.counts.tolist() for _, part in partition.chunks(10, cell_cost=3)]
    assert runs == [[2, 2], [1], [5], [1, 1]]
    runs = [part.counts.tolist() for _, part in partition.chunks(12, cell_cost=3)]
    assert runs == [[2, 2], [1, 5], [1, 1]]


def test_a_cell_that_costs_more_than_a_chunk_gets_a_chunk_of_its_own():
    runs = [part.counts.tolist() for _, part in partition_of([1, 2, 1]).chunks(3, cell_cost=100)]
    assert runs == [[1], [2], [1]]


@pytest.mark.parametrize("cost", [0, 1, 8])
@pytest.mark.parametrize("limit", [1, 7, 20])
def test_chunks_by_cost_hold_every_cell_once_and_whole(limit, cost):
    partition = partition_of([1, 2, 3, 1, 1, 9, 1, 2])
    found: list[list[int]] = []
    for run, part in partition.chunks(limit, cell_cost=cost):
        assert run.stop - run.start == len(part)
        assert len(part.order) + cost * len(part) <= limit or len(part) == 1
        found += lists_of(part)
    assert found == lists_of(partition)


def test_a_slice_of_cells_is_cut_out():
    partition = partition_of([2, 1, 3, 1])
    assert lists_of(partition.cut(slice(1, 3))) == lists_of(partition)[1:3]
    assert lists_of(partition.cut(slice(2, 99))) == lists_of(partition)[2:]


def test_moving_to_a_device():
    """``meta`` stands for another device: it has shapes and no values."""
    moved = partition_of([2, 1]).to(torch.device("meta"))
    assert isinstance(moved, Partition)
    assert {moved.order.device.type, moved.offsets.device.type} == {"meta"}
    assert (moved.order.shape, moved.offsets.shape) == ((3,), (3,))


def test_a_label_out_of_range_is_an_error():
    for labels, found in (([0, 3], "0 to 3"), ([-1, 2], "-1 to 2")):
        with pytest.raises(InvalidArgumentError) as caught:
            Partition.from_labels(torch.tensor(labels), 3)
        assert str(caught.value) == f"labels must be between 0 and 2, found {found}."


def test_an_empty_cell_is_an_error():
    with pytest.raises(InvalidArgumentError) as caught:
        Partition.from_labels(torch.tensor([0, 3, 0]), 5)
    assert str(caught.value) == "every cell needs a member; 3 have none, the first is 1."


LABELS = torch.tensor([0, 1, 1])


@pytest.mark.parametrize(
    ("labels", "count", "text"),
    [
        (LABELS.numpy(), 2, "labels must be a tensor of integers of shape (n,), found ndarray."),
        (LABELS.double(), 2, "found torch.float64 of shape (3,)."),
        (LABELS[None], 2, "found torch.int64 of shape (1, 3)."),
        (LABELS, None, "count must be a whole number above 0, found None."),
        (LABELS, 1.5, "count must be a whole number above 0, found 1.5."),
        (LABELS, 0, "count must be a whole number above 0, found 0."),
    ],
)
def test_wrong_labels_and_counts_are_errors(labels, count, text):
    with pytest.raises(InvalidArgumentError) as caught:
        Partition.from_labels(labels, count)
    assert str(caught.value).endswith(text)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"order": LABELS.numpy()}, "order must be a tensor of signed integers of shape (n,), "
         "found ndarray."),
        ({"order": LABELS + 1}, "rows of the partition must be between 0 and 1, found 1 to 2."),
        ({"offsets": torch.tensor([0, 2])}, "offsets must increase from 0 to the 3 rows of the "
         "partition, found [0, 2]."),
        ({"offsets": torch.tensor([0, 2, 1, 3])}, "found [0, 2, 1, 3]."),
        ({"offsets": LABELS[:0]}, "found []."),
    ],
)  # fmt: skip
def test_a_check_finds_what_does_not_fit_a_scene(changes, text):
    whole = Partition(order=LABELS, offsets=torch.tensor([0, 1, 3]))
    whole.check(2)
    with pytest.raises(InvalidArgumentError) as caught:
        replace(whole, **changes).check(2)
    assert str(caught.value).endswith(text)
