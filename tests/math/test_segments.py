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


def test_argmin_of_labels_names_the_first_of_equals():
    values, labels = torch.tensor([3.0, 1.0, 5.0, 1.0]), torch.tensor([0, 2, 2, 2])
    assert segments.label_argmin(values, labels, 4).tolist() == [0, 4, 1, 4]


def test_smallest_rows_end_with_nan_if_there_are_too_few_numbers() -> None:
    values = torch.tensor([float("nan")] * 4 + [2.0, 1.0] + [float("nan")] * 4)
    assert segments.smallest_rows(values, 4).tolist() == [5, 4, 0, 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ascending_rows_equal_a_stable_sort(dtype):
    inf, nan = float("inf"), float("nan")
    values = torch.tensor([0.5, -0.0, inf, 0.0, -2.0, nan, -inf, 0.5, -1.0, -nan], dtype=dtype)
    assert segments.ascending_rows(values).tolist() == [6, 4, 8, 1, 3, 0, 7, 2, 5, 9]
    zeros = torch.tensor([0.0, -0.0, 0.0], dtype=dtype)
    assert segments.ascending_rows(zeros).tolist() == [0, 1, 2]
    many = torch.randint(-50, 50, (5000,), generator=torch.Generator().manual_seed(0)).to(dtype)
    wanted = sorted(range(5000), key=lambda row: float(many[row]))
    assert segments.ascending_rows(many / 7).tolist() == wanted
    assert segments.ascending_rows(many[:0]).tolist() == []


def test_float64_is_sorted_by_its_bits(monkeypatch):
    """Torch sorts whole numbers four times as fast."""
    sort, sorted_dtypes = torch.sort, []
    monkeypatch.setattr(torch, "sort", lambda x, **_: sorted_dtypes.append(x.dtype) or sort(x, **_))
    segments.ascending_rows(torch.tensor([2.0, 1.0], dtype=torch.float64))
    assert sorted_dtypes == [torch.int64]


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


def test_empty_input():
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


def test_sums_do_not_depend_on_other_segments():
    """A cell gives the same bits alone and among others."""
    g = torch.Generator().manual_seed(1)
    values = torch.randn(4000, 5, generator=g)
    ends = torch.randint(0, 4000, (300,), generator=g).sort().values
    offsets = torch.cat([torch.tensor([0]), ends, torch.tensor([4000])])
    sums = segments.segment_sum(values, offsets)
    for segment in range(0, 301, 7):
        rows = values[offsets[segment] : offsets[segment + 1]]
        alone = segments.segment_sum(rows, torch.tensor([0, len(rows)]))
        assert torch.equal(alone[0], sums[segment])


def test_columns_are_independent():
    """Infinity and NaN stay in their column and segment."""
    values = torch.ones(5, 3)
    values[1, 0], values[3, 2] = torch.inf, torch.nan
    sums = segments.segment_sum(values, OFFSETS)
    wanted = torch.ones(4, 3, dtype=torch.bool)
    wanted[0, 0] = wanted[2, 2] = False
    assert torch.equal(sums.isfinite(), wanted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weighted_rows(dtype):
    """By weights in place, and from a table: 2 * [1, 2] - [3, 4], nothing, and 0.5 * [1, 2]."""
    table = torch.tensor([[3.0, 4.0], [1.0, 2.0]], dtype=dtype)
    rows, offsets = torch.tensor([1, 0, 1]), torch.tensor([0, 2, 2, 3])
    weights = torch.tensor([2.0, -1.0, 0.5], dtype=dtype)
    wanted = torch.tensor([[-1.0, 0.0], [0.0, 0.0], [0.5, 1.0]], dtype=dtype)
    assert torch.equal(segments.segment_sum_of(table, rows, offsets, weights), wanted)
    assert torch.equal(segments.segment_sum(table[rows], offsets, weights), wanted)
    assert segments.segment_sum(table[rows, 0], offsets, weights).tolist() == [-1.0, 0.0, 0.5]


def test_a_table_without_used_rows():
    nothing = torch.zeros(0, dtype=torch.int64)
    offsets = torch.zeros(3, dtype=torch.int64)
    sums = segments.segment_sum_of(torch.ones(4, 2, 3), nothing, offsets, torch.zeros(0))
    assert torch.equal(sums, torch.zeros(2, 2, 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_memory_layout_does_not_matter(dtype):
    values = torch.randn(5, 3, generator=torch.Generator().manual_seed(3), dtype=dtype)
    by_column = values.T.contiguous().T
    wanted = segments.segment_sum(values, OFFSETS)
    assert torch.equal(segments.segment_sum(by_column, OFFSETS), wanted)


def smooth_rows(*shape: int) -> torch.Tensor:
    """Numbers of which no two are near each other, so that a maximum stays where it is."""
    count = torch.Size(shape).numel()
    order = torch.randperm(count, generator=torch.Generator().manual_seed(2))
    return (order.double() / count).reshape(shape).requires_grad_()


@pytest.mark.parametrize("inner", [(), (1,), (3,), (2, 3)], ids=str)
@pytest.mark.parametrize("offsets", [[0, 2, 2, 5, 5], [0, 0, 5], [0, 1, 2, 3, 4, 5], [0, 5]])
def test_gradients_equal_finite_differences(inner, offsets):
    values, ends = smooth_rows(5, *inner), torch.tensor(offsets)
    assert torch.autograd.gradcheck(lambda rows: segments.segment_sum(rows, ends), (values,))

    def finite_max(rows: torch.Tensor) -> torch.Tensor:
        return segments.segment_max(rows, ends)[ends.diff() > 0]

    assert torch.autograd.gradcheck(finite_max, (values,))
    weights = torch.tensor([0.5, -1.0, 2.0, 0.0, 3.0]).double()
    weighted = segments.segment_sum(values, ends, weights)
    (found,) = torch.autograd.grad(weighted.sum(), values)
    assert torch.equal(found, weights_like(values, weights))


def weights_like(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    return weights.reshape(-1, *[1] * (values.ndim - 1)).expand_as(values)


@pytest.mark.parametrize("inner", [(3,), (2, 3)], ids=str)
def test_gradients_of_weights_of_a_table_equal_finite_differences(inner):
    table, rows = smooth_rows(4, *inner), torch.tensor([3, 0, 0, 2, 1])
    weights = smooth_rows(5)
    assert torch.autograd.gradcheck(
        lambda shares: segments.segment_sum_of(table, rows, OFFSETS, shares), (weights,)
    )
    assert not segments.segment_sum_of(table, rows, OFFSETS, weights.detach()).requires_grad


def test_gradients_of_known_rows():
    """A sum hands its gradient to every row, a maximum to the largest, equals share it."""
    values = torch.tensor([1.0, 2.0, 5.0, 3.0, 5.0], requires_grad=True)
    weights = torch.tensor([10.0, 0.0, 20.0, 0.0])
    (segments.segment_sum(values, OFFSETS) * weights).sum().backward()
    assert values.grad.tolist() == [10.0, 10.0, 20.0, 20.0, 20.0]
    values.grad = None
    ends = torch.tensor([0, 2, 5])
    (segments.segment_max(values, ends) * torch.tensor([10.0, 20.0])).sum().backward()
    assert values.grad.tolist() == [0.0, 10.0, 10.0, 0.0, 10.0]


def test_sums_and_rows_of_scattered_columns():
    columns, labels = [torch.tensor([1.0, 2.0, 4.0]), torch.ones(3)], torch.tensor([1, 0, 1])
    weights = torch.tensor([1.0, 2.0, 3.0]).double()
    found = segments.label_sums(iter(columns), labels, 3, weights)
    assert found.tolist() == [[4.0, 13.0, 0.0], [2.0, 4.0, 0.0]]
    (rows,) = segments.gather_columns(torch.tensor([2, 0]), torch.eye(3))
    assert rows.tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
