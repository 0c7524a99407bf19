"""MergeNet: against the oracle, zero before training, order-invariant; its known range."""

import math
from dataclasses import replace

import numpy as np
import pydantic
import pytest
import torch

import mergenet_oracle as oracle
from cvtgs import GaussianScene
from cvtgs.cells.descriptors import (
    CELL_FEATURES,
    LEAST_PIXELS,
    MEMBER_FEATURES,
    PAIR_FEATURES,
    PIXEL_SCALE,
)
from cvtgs.mergenet import Architecture, KnownRange, MergeNet, Residuals
from cvtgs.mergenet.model import (
    MARGIN,
    MEMBERS,
    NARROWEST,
    SUMMARY_FEATURES,
    summarize,
)
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


@pytest.mark.parametrize(
    ("seed", "near"),
    [(0, 5), *(pytest.param(1, near, marks=pytest.mark.slow) for near in (0, 1, 5, 8))],
)
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


def test_the_architecture_matches_the_descriptors_and_is_validated():
    ours = Architecture()
    features = (ours.member_features, ours.pair_features, ours.cell_features)
    assert features == (MEMBER_FEATURES, PAIR_FEATURES, CELL_FEATURES)
    for bad in ({"width": 0}, {"cell_width": 5000}, {"depth": 3}):
        with pytest.raises(pydantic.ValidationError):
            Architecture(**bad)


def test_cells_do_not_affect_one_another():
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
        shares=seen.shares[members],
        rows=seen.rows[members],
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


def rows(*values: float) -> torch.Tensor:
    return torch.tensor(values)[:, None].repeat(1, SUMMARY_FEATURES)


def fitted(*cases: torch.Tensor) -> KnownRange:
    known = KnownRange()
    known.fit(cases)
    return known


def test_shares_by_hand():
    known = fitted(rows(0.0, 0.3, 0.5, 1.0))
    assert float(known.margin[0]) == pytest.approx(MARGIN)
    found = known(rows(-1.0, -0.1, -0.025, 0.0, 0.5, 1.0, 1.05, 1.1, 1e9)).tolist()
    assert found == pytest.approx([0, 0, 0.75, 1, 1, 1, 0.5, 0, 0], abs=1e-5)
    assert found[0] == found[-1] == 0.0
    assert found[3:6] == [1.0, 1.0, 1.0]


def test_the_farthest_feature_decides():
    known = fitted(rows(0.0, 1.0))
    one = rows(0.5)
    one[0, 3], one[0, 5] = 1.0 + MARGIN / 2, -MARGIN / 4
    assert known(one).tolist() == pytest.approx([0.5], abs=1e-5)


def test_a_feature_that_never_varied_has_a_margin():
    known = fitted(rows(1.5, 1.5))
    found = known(rows(1.5, 1.5 + NARROWEST / 2, 1.6)).tolist()
    assert found == pytest.approx([1.0, 0.5, 0.0], abs=1e-4)


def test_tails_of_a_case_are_ignored_but_a_small_case_is_not():
    """200 cells: two at each end are its tails. A case of one cell counts in full."""
    large = rows(*[-90.0, -80.0], *torch.linspace(0, 1, 196).tolist(), *[80.0, 90.0])
    known = fitted(large, rows(3.0))
    assert (float(known.low[0]), float(known.high[0])) == (0.0, 3.0)


def test_cells_of_thousands_of_members_are_never_known():
    """The range ends at 2000 members; corrections vanish over a tenth of its logarithm."""
    learned = rows(0.0, 0.1 * math.log(2000), 9.0)
    learned[:, :MEMBERS], learned[:, MEMBERS + 1 :] = 0.0, 0.0
    known = fitted(learned)
    seen = torch.zeros(5, SUMMARY_FEATURES)
    counts = torch.tensor([2.0, 2000.0, 2000.0**1.05, 2000.0**1.11, 1e6])
    seen[:, MEMBERS] = 0.2 * counts.log()
    assert known(seen).tolist() == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0], abs=1e-3)


def test_the_members_feature_is_the_number_of_members():
    scene = random_scene(60, degree=0, dtype=torch.float64, seed=0, size=0.4)
    seen = case_of(scene, torch.arange(60) % 2).describe()
    assert seen.cells[:, MEMBERS].tolist() == pytest.approx([0.2 * math.log(30)] * 2)


def test_everything_is_known_before_training():
    assert KnownRange()(rows(-1e9, 0.0, 1e9)).tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("near", [0, 8])
def test_summaries_are_weighted_means_and_features_of_cells_but_sizes_in_pixels(near):
    seen = some_case(near=near).describe()
    found = summarize(seen)
    assert found.shape == (len(seen), SUMMARY_FEATURES)
    start, end = seen.offsets[3:5].tolist()
    members = (seen.members[start:end] * seen.weights[start:end, None]).sum(dim=0)
    others = seen.pairs[3].mean(dim=0) if near else torch.zeros(seen.pairs.shape[2])
    wanted = torch.cat([seen.cells[3, :-1], members, others])
    torch.testing.assert_close(found[3], wanted, atol=1e-12, rtol=1e-12)


def yard(huge: bool) -> GaussianScene:
    """Small Gaussians; with ``huge``, the first is a faint one of a far sky."""
    scene = random_scene(60, degree=1, dtype=torch.float64, seed=0, size=0.4)
    if not huge:
        return scene
    means, logs, logits = (
        values.clone() for values in (scene.means, scene.log_scales, scene.logit_opacities)
    )
    means[0] = torch.tensor([300.0, -200.0, 100.0])
    logs[0], logits[0] = 5.0, -4.0
    return replace(scene, means=means, log_scales=logs, logit_opacities=logits)


def test_no_residual_for_a_cell_with_a_huge_far_faint_member():
    labels, net = some_labels(60, 12), lively_net()
    usual, odd = (case_of(yard(huge), labels, near=0) for huge in (False, True))
    before = fields_of(net(odd.describe()))
    net.known.fit([summarize(usual.describe())])
    cell = int(labels[0])
    after = fields_of(net(odd.describe()))
    members = slice(*odd.part.offsets[cell : cell + 2].tolist())
    for name, values in after.items():
        if values.numel():
            own = members if name == "member_colors" else cell
            assert not bool(values[own].any())
            assert bool(before[name][own].any())
    corrected = odd.correct(net)
    for name, values in odd.merged.tensors().items():
        assert torch.equal(getattr(corrected, name)[cell], values[cell])
    others = torch.arange(12) != cell
    assert not torch.equal(corrected.means[others], odd.merged.means[others])


def test_cells_that_are_far_too_small_for_images_stay_unchanged():
    """Their residuals fade out over a factor of e in size."""
    descriptors, net = some_case().describe(), lively_net()
    found = []
    for size in (0.0, -0.5, -0.9, -1.0, -9.0):
        cells = descriptors.cells.clone()
        cells[:, -1] = PIXEL_SCALE * (LEAST_PIXELS + size)
        with torch.no_grad():
            residuals = net(replace(descriptors, cells=cells))
        found.append(float(sum(values.abs().sum() for values in fields_of(residuals).values())))
    whole, half, tenth, *none = found
    assert 0.4 < half / whole < 0.6
    assert 0.05 < tenth / whole < 0.15
    assert none == [0.0, 0.0]


def test_training_cells_keep_their_residuals():
    case, net = some_case(), lively_net()
    before = fields_of(net(case.describe()))
    net.known.fit([summarize(case.describe())])
    after = fields_of(net(case.describe()))
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_neighbours_turn_a_cell_by_twice_their_mean_pull():
    seen = some_case(60, 12).describe()
    net = MergeNet(Architecture()).double()
    with torch.no_grad():
        net.pair_gates.gates.bias[2:] = 1.0
        found = net(seen).d_rotvecs
    x, y, z = (seen.pair_positions / (1 + seen.pair_positions.abs())).unbind(2)
    mean = torch.stack([y * z, x * z, x * y], dim=2).mean(dim=1)
    torch.testing.assert_close(found, 0.5 * torch.tanh(2 * 0.5 * math.tanh(1.0) * mean))


def test_a_copy_of_another_precision_leaves_the_network_as_it_is():
    net = lively_net(torch.float32)
    before = {name: values.clone() for name, values in net.state_dict().items()}
    copied = net.copy_to(torch.device("cpu"), torch.float64)
    assert {values.dtype for values in copied.state_dict().values()} == {torch.float64}
    for name, values in net.state_dict().items():
        assert values.dtype == torch.float32
        assert torch.equal(values, before[name])
