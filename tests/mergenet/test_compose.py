"""Applying residuals: hand-computed, exact for residuals of zero, and only in existing bands."""

import math

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import oracles
from cvtgs import GaussianScene
from cvtgs.devices import one_thread
from cvtgs.math.parameters import normalize_quats
from cvtgs.mergenet import Architecture, MergeNet, Residuals, compose
from cvtgs.mergenet.apply import FLATNESS, compose_published, turn_limits
from cvtgs.mergenet.published import PublishedResiduals
from mergenet_cases import Case, case_of, lively_net, some_case, some_labels
from scenes import random_scene, same_bits

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
degrees = pytest.mark.parametrize("degree", [0, 1, 2, 3])


def rest(case: Case) -> dict[str, torch.Tensor]:
    """Residuals of zero, by name."""
    m, n, k = len(case.part), len(case.part.order), case.neighbors.shape[1]
    like = {"dtype": case.scene.dtype}
    return {
        "d_means": torch.zeros(m, 3, **like),
        "d_log_scales": torch.zeros(m, 3, **like),
        "d_rotvecs": torch.zeros(m, 3, **like),
        "d_logit_opacities": torch.zeros(m, **like),
        "member_colors": torch.zeros(n, **like),
        "pair_colors": torch.zeros(m, k, **like),
    }


def composed(case: Case, **changes: torch.Tensor) -> GaussianScene:
    tensors = case.compose(Residuals(**(rest(case) | changes)))
    return case.merged.with_tensors(tensors, {})


def test_shifts_are_along_own_axes_in_standard_deviations():
    case = some_case()
    shifts = torch.randn(12, 3, generator=torch.Generator().manual_seed(0)).double()
    small = composed(case, d_means=shifts)
    for row in range(12):
        axes = oracles.rotation(case.merged.quats[row].tolist())
        move = axes @ (case.merged.scales[row] * shifts[row]).numpy()
        found = small.means[row] - case.merged.means[row]
        np.testing.assert_allclose(found, move, rtol=1e-9, atol=1e-12)
    assert same_bits(small.with_tensors({"means": case.merged.means}, {}), case.merged)


def test_growths_and_logits_are_added():
    case = some_case()
    growths = torch.linspace(-0.6, 0.6, 36).double().reshape(12, 3)
    logits = torch.linspace(-2, 2, 12).double()
    small = composed(case, d_log_scales=growths, d_logit_opacities=logits)
    assert torch.equal(small.log_scales, case.merged.log_scales + growths)
    assert torch.equal(small.logit_opacities, case.merged.logit_opacities + logits)
    rested = {name: getattr(case.merged, name) for name in ("log_scales", "logit_opacities")}
    assert same_bits(small.with_tensors(rested, {}), case.merged)


def test_flat_cells_and_needles_hardly_tilt():
    """A turn about an axis tilts the others into one another, by less the more they differ."""
    logs = torch.tensor([[0.0, 0.1, -6.0], [2.0, -4.0, -4.0], [1.0, 0.0, -1.0]]).double()
    tilt = [FLATNESS * math.exp(-gap) for gap in (6.1, 6.0)]
    wanted = [[tilt[0], tilt[1], 1.0], [1.0, tilt[1], tilt[1]], [1.0, 1.0, 1.0]]
    torch.testing.assert_close(turn_limits(logs), torch.tensor(wanted).double())
    case = some_case()
    flat = case.merged.log_scales.clone()
    flat[:, 2] = flat[:, 1] - 7.0
    case = case._replace(merged=case.merged.with_tensors({"log_scales": flat}))
    turns = torch.full((12, 3), 0.4).double()
    some, less = (composed(case, d_rotvecs=turns * factor).quats for factor in (1.0, 0.5))
    own = normalize_quats(case.merged.quats)
    tilted = [1.0 - (normalize_quats(quats) * own).sum(dim=1).abs() for quats in (some, less)]
    assert bool((tilted[0] < 1.0 - math.cos(math.atan(0.21))).all())
    assert bool((tilted[0] > tilted[1]).all())


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", [-0.5, 0.01, 0.5])
def test_turns_are_about_own_axes(axis, angle):
    """The quaternion times ``(1, turn / 2)``: an angle of ``2 atan(turn / 2)``."""
    case = some_case()
    turns = torch.zeros(12, 3).double()
    turns[:, axis] = angle
    small = composed(case, d_rotvecs=turns)
    half = math.atan(angle / 2)
    turn = [math.cos(half), *(math.sin(half) if other == axis else 0.0 for other in range(3))]
    for row in range(12):
        wanted = oracles.quaternion_product(case.merged.quats[row].tolist(), turn)
        assert small.quats[row].tolist() == pytest.approx(wanted, abs=1e-12)
    assert same_bits(small.with_tensors({"quats": case.merged.quats}, {}), case.merged)


@degrees
def test_colours_of_members_and_neighbours_are_mixed_in(degree):
    case = some_case(degree=degree)
    g = torch.Generator().manual_seed(0)
    of_members = torch.randn(60, generator=g, dtype=torch.float64)
    of_pairs = torch.randn(12, 8, generator=g, dtype=torch.float64)
    small = composed(case, member_colors=of_members, pair_colors=of_pairs)
    starts, order = case.part.offsets.tolist(), case.part.order.tolist()
    for cell in range(12):
        own = case.merged.sh[cell].numpy()
        wanted = own.copy()
        for place in range(starts[cell], starts[cell + 1]):
            wanted += of_members[place].item() * (case.scene.sh[order[place]].numpy() - own)
        for gate, other in zip(of_pairs[cell], case.neighbors[cell].tolist(), strict=True):
            wanted += gate.item() * (case.merged.sh[other].numpy() - own)
        np.testing.assert_allclose(small.sh[cell], wanted, rtol=1e-9, atol=1e-9)
    rested = {"sh0": case.merged.sh0, "shN": case.merged.shN}
    assert same_bits(small.with_tensors(rested, {}), case.merged)


def test_a_gate_of_one_takes_the_colour_of_a_neighbour():
    case = some_case(near=1)
    small = composed(case, pair_colors=torch.ones(12, 1).double())
    torch.testing.assert_close(small.sh, case.merged.sh[case.neighbors[:, 0]])


@dtypes
@degrees
@pytest.mark.parametrize("near", [0, 8])
def test_residuals_of_zero_change_no_bit(near, degree, dtype):
    case = some_case(degree=degree, dtype=dtype, near=near)
    assert same_bits(composed(case), case.merged)


@dtypes
@degrees
def test_an_untrained_network_returns_the_reference_bit_for_bit(degree, dtype):
    net = MergeNet(Architecture()).to(dtype)
    case = some_case(degree=degree, dtype=dtype)
    assert same_bits(case.correct(net), case.merged)


@dtypes
@pytest.mark.parametrize("seed", range(4))
def test_an_untrained_network_keeps_signed_zeros_bit_for_bit(seed, dtype):
    """Frames along the axes of the scene, grey colours and sizes of 1 are full of zeros."""
    scene = random_scene(120, degree=1, dtype=dtype, seed=seed)
    g = torch.Generator().manual_seed(seed)

    def whole(*shape: int) -> torch.Tensor:
        return torch.randint(-1, 2, shape, generator=g).to(dtype) * -1.0

    quats = torch.zeros(120, 4, dtype=dtype)
    quats[torch.arange(120), torch.randint(0, 4, (120,), generator=g)] = -1.0
    tensors = {
        "means": whole(120, 3),
        "quats": quats,
        "log_scales": whole(120, 3),
        "logit_opacities": whole(120),
        "sh0": whole(120, 1, 3),
        "shN": whole(120, 3, 3),
    }
    case = case_of(scene.with_tensors(tensors, {}), some_labels(120, 50, seed=seed))
    net = MergeNet(Architecture()).to(dtype)
    assert same_bits(case.correct(net), case.merged)


class Watch(TorchDispatchMode):
    """Collect the operations on tensors of a certain shape."""

    def __init__(self, tail: tuple[int, ...]) -> None:
        super().__init__()
        self.tail, self.seen = tail, set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        tensors = (value for value in (*args, result) if isinstance(value, torch.Tensor))
        if any(tuple(value.shape[1:]) == self.tail for value in tensors):
            self.seen.add(function.overloadpacket.__name__)
        return result


class Whole(TorchDispatchMode):
    """Collect the operations that make new tensors of a shape, which are no views."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape, self.made = shape, list[str]()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result, name = function(*args, **(kwargs or {})), function.overloadpacket.__name__
        if isinstance(result, torch.Tensor) and tuple(result.shape) == self.shape:
            shared = [value.data_ptr() for value in args if isinstance(value, torch.Tensor)]
            self.made += [name] * (result.data_ptr() not in shared)
        return result


def test_only_one_copy_of_all_cells_is_made(monkeypatch):
    """With most Gaussians kept, a copy of the merged ones takes much of the memory of a run."""
    monkeypatch.setattr("cvtgs.mergenet.apply.CHUNK_MEMBERS", 64)
    case, net = some_case(300, 120, degree=3), lively_net()
    with one_thread(), Whole((120, 15, 3)) as watch:
        case.correct(net)
    assert watch.made == ["clone"]


@pytest.mark.parametrize(("degree", "bands"), [(0, 0), (1, 3), (3, 15)])
def test_bands_of_zero_width_are_only_copied(degree, bands):
    case, net = some_case(degree=degree), lively_net()
    with one_thread(), Watch((bands, 3)) as watch:  # it sees only operations of this thread
        case.correct(net)
    copying = {"index_select"}
    assert copying <= watch.seen
    assert (watch.seen == copying) == (degree == 0)


def test_gradients_with_respect_to_residuals():
    case = some_case(10, 4, near=2)
    names = list(rest(case))
    g = torch.Generator().manual_seed(0)
    draws = [0.1 * torch.randn(v.shape, generator=g).double() for v in rest(case).values()]

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        tensors = case.compose(Residuals(**dict(zip(names, values, strict=True))))
        return tuple(tensors.values())

    assert torch.autograd.gradcheck(outputs, [values.requires_grad_() for values in draws])


def test_a_subset_of_cells_gets_the_same_results():
    case = some_case()
    net = lively_net()
    with torch.no_grad():
        residuals = net(case.describe())
    whole = case.compose(residuals)
    keep = torch.tensor([2, 3, 9])
    mask = torch.zeros(12, dtype=torch.bool)
    mask[keep] = True
    members = torch.repeat_interleave(mask, case.part.counts)
    some = compose(
        case.scene,
        case.merged,
        case.part.select(mask),
        cells=keep,
        neighbors=case.neighbors[keep],
        residuals=Residuals(
            **{
                name: getattr(residuals, name)[members if name == "member_colors" else keep]
                for name in rest(case)
            }
        ),
    )
    for name, values in some.items():
        torch.testing.assert_close(values, whole[name][keep])


def test_huge_rotations_keep_the_length_of_quaternions() -> None:
    merged, none = random_scene(1), torch.zeros(1, 3)
    residuals = PublishedResiduals(
        d_means=none,
        d_log_scales=none,
        d_rotvecs=torch.tensor([[1e20, -3e38, 0.0]]),
        d_logit_opacities=none[:, 0],
        d_sh=torch.zeros(1, 16, 3),
    )
    quats = compose_published(merged, cells=torch.tensor([0]), residuals=residuals)["quats"]
    torch.testing.assert_close(quats.norm(dim=1), merged.quats.norm(dim=1))
