"""Reductions over consecutive runs of rows."""

import pytest
import torch

from cvtgs.math import segments

OFFSETS = torch.tensor([0, 2, 2, 5, 5])


def test_sum_and_max_of_known_rows():
    values = torch.tensor([1.0, 2.0, -3.0, 4.0, 5.0])
    assert segments.segment_sum(values, OFFSETS).tolist() == [3.0, 0.0, 6.0, 0.0]
    infinity = float("inf")
    assert segments.segment_max(values, OFFSETS).tolist() == [2.0, -infinity, 5.0, -infinity]


def test_argmax_names_the_first_of_equals():
    values = torch.tensor([1.0, 3.0, 3.0, -float("inf"), -float("inf")])
    assert segments.segment_argmax(values, torch.tensor([0, 3, 5])).tolist() == [1, 3]


def test_sort_by_label_is_stable_and_knows_empty_labels():
    order, offsets = segments.sort_by_label(torch.tensor([2, 0, 2, 0, 2]), 4)
    assert order.tolist() == [1, 3, 0, 2, 4]
    assert offsets.tolist() == [0, 2, 2, 5, 5]


def test_ids_skip_empty_segments():
    assert segments.segment_ids(OFFSETS).tolist() == [0, 0, 2, 2, 2]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("inner", [(), (3,), (3, 3), (0, 3)])
def test_shapes(dtype, inner):
    values = torch.ones(5, *inner, dtype=dtype)
    for reduce in (segments.segment_sum, segments.segment_max):
        result = reduce(values, OFFSETS)
        assert result.shape == (4, *inner)
        assert result.dtype == dtype


def test_nothing_at_all():
    order, offsets = segments.sort_by_label(torch.zeros(0, dtype=torch.int64), 2)
    assert order.tolist() == []
    assert offsets.tolist() == [0, 0, 0]
    assert segments.segment_sum(torch.zeros(0), offsets).tolist() == [0.0, 0.0]


def test_random_segments_equal_a_loop():
    g = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 40, (500,), generator=g)
    values = torch.randn(500, 2, generator=g, dtype=torch.float64)
    order, offsets = segments.sort_by_label(labels, 40)
    sums = segments.segment_sum(values[order], offsets)
    tops = segments.segment_argmax(values[order, 0], offsets)
    for label in range(40):
        rows = (labels == label).nonzero()[:, 0]
        torch.testing.assert_close(sums[label], values[rows].sum(dim=0))
        assert order[tops[label]] == rows[values[rows, 0].argmax()]


def test_a_segment_of_a_million_keeps_its_digits():
    values = torch.full((10**6,), 0.1, dtype=torch.float64)
    total = segments.segment_sum(values, torch.tensor([0, 10**6])).item()
    assert total == pytest.approx(1e5, rel=1e-10)


def test_gradients():
    values = torch.tensor(
        [[1.0, 5.0], [2.0, 1.0], [0.5, 0.1], [4.0, 2.0], [3.0, 9.0]],
        dtype=torch.float64,
        requires_grad=True,
    )
    assert torch.autograd.gradcheck(lambda v: segments.segment_sum(v, OFFSETS), (values,))
    filled = torch.tensor([0, 2, 5])
    assert torch.autograd.gradcheck(lambda v: segments.segment_max(v, filled), (values,))
