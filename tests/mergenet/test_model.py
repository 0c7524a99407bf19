"""MergeNet: against the oracle, at rest before training, and blind to order."""

import numpy as np
import pydantic
import pytest
import torch

import mergenet_oracle as oracle
from cvtgs.cells.features import CELL_FEATURES, MEMBER_FEATURES, PAIR_FEATURES
from cvtgs.mergenet import Architecture, MergeNet, Residuals
from mergenet_cases import case_of, fields_of, lively_net, some_case, some_labels
from scenes import random_scene

PER_CELL = ("d_means", "d_log_scales", "d_rotvecs", "d_logit_opacities")
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def residuals_of(**changes: torch.Tensor) -> Residuals:
    rest = {
        "d_means": torch.zeros(2, 3),
        "d_log_scales": torch.zeros(2, 3),
        "d_rotvecs": torch.zeros(2, 3),
        "d_logit_opacities": torch.zeros(2),
        "member_colors": torch.zeros(5),
        "pair_colors": torch.zeros(2, 1),
    }
    return Residuals(**(rest | changes))


def test_cost_is_the_mean_square_of_the_four_kinds_of_change():
    assert residuals_of().cost().item() == 0
    largest = residuals_of(d_log_scales=torch.full((2, 3), 0.6))
    assert largest.cost().item() == pytest.approx(1 / 4)
    some = residuals_of(
        d_logit_opacities=torch.tensor([2.0, 0.0]), d_rotvecs=torch.full((2, 3), -0.25)
    )
    assert some.cost().item() == pytest.approx((1 / 2 + 1 / 4) / 4)
    assert residuals_of(d_means=torch.full((2, 3), 9.0)).cost().item() == pytest.approx(1 / 4)
    assert residuals_of(member_colors=torch.ones(5)).cost().item() == 0


@pytest.mark.parametrize("near", [0, 1, 5, 8])
@pytest.mark.parametrize("seed", [0, 1])
def test_residuals_equal_the_oracle(seed, near):
    case, net = some_case(seed=seed, near=near), lively_net(seed=seed)
    weights = {name: values.numpy() for name, values in net.state_dict().items()}
    with torch.no_grad():
        found = fields_of(net(case.describe()))
    ends = case.part.offsets.tolist()
    for number, cell in enumerate(case.oracle_cells()):
        wanted = oracle.predict(weights, cell)
        members = slice(ends[number], ends[number + 1])
        for name, values in wanted.items():
            rows = members if name == "member_colors" else number
            np.testing.assert_allclose(found[name][rows], values, rtol=1e-8, atol=1e-8)
        assert max(np.abs(values).max() for values in wanted.values() if values.size) > 1e-3


@dtypes
def test_an_untrained_network_predicts_zeros(dtype):
    net = MergeNet(Architecture()).to(dtype)
    for values in fields_of(net(some_case(dtype=dtype).describe())).values():
        assert values.dtype == dtype
        assert not bool(values.any())


@dtypes
@pytest.mark.parametrize("near", [0, 3, 8])
def test_shapes(near, dtype):
    net = lively_net(dtype)
    found = net(some_case(60, 12, dtype=dtype, near=near).describe())
    shapes = {name: tuple(values.shape) for name, values in fields_of(found).items()}
    assert shapes == {
        "d_means": (12, 3),
        "d_log_scales": (12, 3),
        "d_rotvecs": (12, 3),
        "d_logit_opacities": (12,),
        "member_colors": (60,),
        "pair_colors": (12, near),
    }


@pytest.mark.parametrize(("seed", "growth"), [(0, 0.6), (1, 0.6), (2, 1.5)])
def test_changes_are_limited(seed, growth):
    net = lively_net(seed=seed, architecture=Architecture(largest_growth=growth))
    with torch.no_grad():
        for values in net.parameters():
            values.mul_(30)
    case = some_case()
    with torch.no_grad():
        found = net(case.describe())
    shares = case.describe().weights
    assert float(found.d_log_scales.abs().amax()) <= growth
    assert float(found.d_rotvecs.abs().amax()) <= 0.5
    assert float(found.d_logit_opacities.abs().amax()) <= 2.0
    assert bool((found.member_colors.abs() <= 2.0 * shares).all())
    assert float(found.pair_colors.abs().sum(dim=1).amax()) <= 0.5
    assert float(found.d_log_scales.abs().amax()) > 0.8 * growth


@pytest.mark.parametrize(("width", "cell_width"), [(1, 1), (7, 5), (64, 128)])
def test_other_widths(width, cell_width):
    architecture = Architecture(width=width, cell_width=cell_width)
    found = lively_net(architecture=architecture)(some_case().describe())
    assert all(bool(values.isfinite().all()) for values in fields_of(found).values())


def test_architecture_is_that_of_the_descriptors_and_closed():
    ours = Architecture()
    features = (ours.member_features, ours.pair_features, ours.cell_features)
    assert features == (MEMBER_FEATURES, PAIR_FEATURES, CELL_FEATURES)
    for bad in ({"width": 0}, {"cell_width": 5000}, {"depth": 3}):
        with pytest.raises(pydantic.ValidationError):
            Architecture(**bad)


def test_cells_do_not_see_one_another():
    """Any subset of cells gets the same residuals."""
    case, net = some_case(), lively_net()
    whole = fields_of(net(case.describe()))
    alone = case_of(case.scene, some_labels(60, 12), visibility=case.visibility, near=8)
    mask = torch.arange(12) % 3 == 0
    part = alone.part.select(mask)
    members = torch.repeat_interleave(mask, alone.part.counts)
    seen = case.describe()
    some = type(seen)(
        members=seen.members[members],
        pairs=seen.pairs[mask],
        cells=seen.cells[mask],
        weights=seen.weights[members],
        offsets=part.offsets,
        positions=seen.positions[members],
        pair_positions=seen.pair_positions[mask],
    )
    for name, values in fields_of(net(some)).items():
        rows = members if name == "member_colors" else mask
        torch.testing.assert_close(values, whole[name][rows])


def test_order_of_members_does_not_matter():
    case, net = some_case(), lively_net()
    shuffle = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    labels = some_labels(60, 12)
    other = case_of(
        case.scene.select(shuffle), labels[shuffle], visibility=case.visibility[shuffle]
    )
    first, second = (fields_of(net(c.describe())) for c in (case, other))
    for name in (*PER_CELL, "pair_colors"):
        torch.testing.assert_close(first[name], second[name])
    rows = shuffle[other.part.order].argsort()[case.part.order]
    torch.testing.assert_close(first["member_colors"], second["member_colors"][rows])


def test_order_of_neighbours_does_not_matter():
    case, net = some_case(), lively_net()
    shuffle = torch.tensor([3, 1, 7, 0, 2, 6, 5, 4])
    first = fields_of(net(case.describe()))
    second = fields_of(net(case._replace(neighbors=case.neighbors[:, shuffle]).describe()))
    for name in (*PER_CELL, "member_colors"):
        torch.testing.assert_close(first[name], second[name])
    torch.testing.assert_close(first["pair_colors"][:, shuffle], second["pair_colors"])


def test_equal_members_are_treated_equally():
    one = random_scene(1, dtype=torch.float64)
    scene = one.select(torch.zeros(6, dtype=torch.int64))
    labels, light = torch.tensor([0, 0, 0, 0, 1, 1]), torch.full((6,), 0.7)
    found = lively_net()(case_of(scene, labels, visibility=light).describe())
    gates = found.member_colors * torch.tensor([4.0] * 4 + [2.0] * 2)
    torch.testing.assert_close(gates[:4], gates[:1].expand(4))
    torch.testing.assert_close(gates[4:], gates[4:5].expand(2))
    assert bool((found.member_colors != 0).all())


def gradients_of(net: MergeNet) -> dict[str, bool]:
    """Return which parameters get any gradient."""
    found = fields_of(net(some_case().describe()))
    sum(values.square().sum() + values.sum() for values in found.values()).backward()
    return {name: bool(values.grad.any()) for name, values in net.named_parameters()}


def test_every_parameter_is_trained():
    assert all(gradients_of(lively_net()).values())


def test_an_untrained_network_can_be_trained():
    found = gradients_of(MergeNet(Architecture()).double())
    last = {name: moves for name, moves in found.items() if "decoder" in name or ".gates." in name}
    assert len(last) == 6
    assert all(last.values())


def test_gradients():
    architecture = Architecture(width=3, cell_width=4)
    net, seen = lively_net(architecture=architecture), some_case(10, 3, near=2).describe()
    names = [name for name, _ in net.named_parameters()]

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        parameters = dict(zip(names, values, strict=True))
        return tuple(fields_of(torch.func.functional_call(net, parameters, (seen,))).values())

    assert torch.autograd.gradcheck(outputs, tuple(net.parameters()), fast_mode=True)
