"""Numerically hard cells: results and gradients stay finite."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene, Simplifier
from mergenet_cases import Case, are_corrected, case_of, features_of, fields_of, lively_net
from scenes import random_scene, under_sky

COUNT = 48
INF = math.inf
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def every(step: int, value: float, other: float) -> Tensor:
    return torch.where(torch.arange(COUNT) % step == 0, value, other)


def sized(log_scale: float) -> Callable[[GaussianScene], dict[str, Tensor]]:
    return lambda scene: {"log_scales": scene.log_scales * 0 + log_scale}


def shaped(*log_scales: float) -> Callable[[GaussianScene], dict[str, Tensor]]:
    return lambda scene: {"log_scales": torch.tensor([log_scales] * COUNT)}


def flown(far: float) -> Callable[[GaussianScene], dict[str, Tensor]]:
    return lambda scene: {"means": scene.means + every(5, far, 0.0)[:, None]}


HARD = {
    "needles": shaped(0.0, -14.0, -14.0),
    "pancakes": shaped(0.0, 0.0, -20.0),
    "of size e^-40": sized(-40.0),
    "of size e^20": sized(20.0),
    "tiny beside huge": lambda scene: {"log_scales": every(3, -40.0, 20.0)[:, None].expand(-1, 3)},
    "all in one place": lambda scene: {"means": scene.means * 0 + 3.0},
    "points in one place": lambda scene: {
        "means": scene.means * 0 + 3.0, "log_scales": scene.log_scales * 0 - 40.0
    },
    "nothing in one place": lambda scene: {
        "means": scene.means * 0 + 3.0, "log_scales": scene.log_scales * 0 - 400.0
    },
    "identical": lambda scene: {
        name: values[:1].expand_as(values) for name, values in scene.tensors().items()
    },
    "opaque": lambda scene: {"logit_opacities": every(1, INF, INF)},
    "transparent": lambda scene: {"logit_opacities": every(1, -INF, -INF)},
    "opaque and transparent": lambda scene: {"logit_opacities": every(2, INF, -INF)},
    "a million away": flown(1e6),
    "1e30 away": flown(1e30),
    "colours of 1e4": lambda scene: {"sh0": 1e4 * scene.sh0, "shN": 1e4 * scene.shN},
    "one colour of 1e4": lambda scene: {"sh0": scene.sh0 * every(7, 1e4, 1.0)[:, None, None]},
    "a flash that weighs nothing": lambda scene: {
        "sh0": scene.sh0 * every(7, 1e4, 1.0)[:, None, None],
        "log_scales": every(7, -40.0, 0.0)[:, None].expand(-1, 3),
        "logit_opacities": every(7, -INF, 3.0),
    },
}  # fmt: skip
each_hard = pytest.mark.parametrize("change", HARD.values(), ids=HARD)


def hard_case(change: Callable[[GaussianScene], dict[str, Tensor]], dtype: torch.dtype) -> Case:
    scene = random_scene(COUNT, degree=3, dtype=dtype)
    changes = {name: values.to(dtype) for name, values in change(scene).items()}
    labels = torch.cat([torch.zeros(6), 1 + torch.arange(COUNT - 6) // 2]).long()
    labels[-2:] += torch.tensor([1, 2])  # the last two members are alone
    labels = torch.unique(labels, return_inverse=True)[1]
    return case_of(scene.with_tensors(changes, {}), labels)


def assert_finite(tensors: dict[str, Tensor]) -> None:
    for name, values in tensors.items():
        assert bool(values.isfinite().all()), name


@dtypes
@each_hard
def test_descriptors_are_finite_and_of_bounded_size(change, dtype):
    seen = hard_case(change, dtype).describe()
    assert_finite(features_of(seen) | {"positions": seen.positions, "pairs": seen.pair_positions})
    for values in (seen.cells, seen.pairs, seen.positions, seen.pair_positions):
        assert float(values.abs().amax()) <= 50
    assert bool((seen.weights >= 0).all())


@pytest.mark.slow
@dtypes
@each_hard
def test_corrected_gaussians_are_finite(change, dtype):
    case = hard_case(change, dtype)
    small = case.correct(lively_net(dtype))
    several = case.part.counts > 1
    assert_finite({name: values[several] for name, values in small.tensors().items()})
    norms = torch.linalg.vector_norm(small.quats[several].double(), dim=1)
    assert float((norms - 1).abs().amax()) < 1e-5


@pytest.mark.slow
@dtypes
@each_hard
def test_gradients_of_all_parameters_are_finite(change, dtype):
    case, net = hard_case(change, dtype), lively_net(dtype)
    residuals = net(case.describe())
    terms = [*fields_of(residuals).values(), *case.compose(residuals).values()]
    size = sum(values.nan_to_num(posinf=0, neginf=0).mean() for values in terms)
    (size + residuals.cost()).backward()
    found = {name: values.grad for name, values in net.named_parameters()}
    assert_finite(found)
    assert any(bool(values.any()) for values in found.values()) == bool(are_corrected(case).any())


@dtypes
@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_a_network_with_huge_weights_gives_finite_gaussians(factor, dtype):
    """Weights are finite, but arbitrarily large."""
    net = lively_net(dtype)
    with torch.no_grad():
        for values in net.parameters():
            values.mul_(factor)
    case = hard_case(lambda scene: {}, dtype)
    assert_finite(case.correct(net).tensors())


@pytest.mark.slow
@dtypes
@pytest.mark.parametrize("log_scale", [-800.0, -400.0, -40.0, 88.0])
@pytest.mark.parametrize("beside", [0.0, 1.0, 1e30])
def test_extreme_neighbours_of_one_member(beside, log_scale, dtype):
    """A cell of one is not corrected, but is a neighbour: a point in the middle, or a whole sky."""
    scene = random_scene(5, dtype=dtype)
    means, log_scales = scene.means.clone(), scene.log_scales.clone()
    means[:4] = torch.tensor([1.0, 0, 0]) * torch.tensor([[-1.0], [1.0], [-2.0], [2.0]])
    logits = torch.full((5,), 3.0, dtype=dtype)
    means[4], log_scales[:] = beside * torch.tensor([0.0, 0, 1]), 0.0
    log_scales[4] = log_scale
    tensors = {"means": means, "log_scales": log_scales, "logit_opacities": logits}
    case = case_of(scene.with_tensors(tensors, {}), torch.tensor([0, 0, 1, 1, 2]))
    assert_finite(features_of(case.describe()))
    assert_finite(case.correct(lively_net(dtype)).tensors())


@pytest.mark.parametrize("far", [3e38, -3e38])
def test_cells_that_overflow_keep_the_reference(far):
    case = hard_case(flown(far), torch.float32)
    assert_finite(case.merged.tensors())
    assert_finite(features_of(case.describe()))
    small = case.correct(lively_net(torch.float32))
    assert_finite(small.tensors())
    assert not torch.equal(small.log_scales, case.merged.log_scales)


def test_a_sky_of_few_gaussians_keeps_its_colour():
    """The nearest other cells of its cells are small ones of the object in front of it."""
    blue = torch.tensor([-0.5, 0.4, 1.4])
    scene = under_sky(200, distance=240.0, color=blue)
    small = Simplifier(device="cpu").simplify(scene, 0.01)
    is_far = small.means.norm(dim=1) > 80.0
    assert 5 < int(is_far.sum()) < 150
    assert float((small.sh0[is_far, 0] - blue).abs().amax()) < 0.01
