"""Correcting all cells of a scene: equivariant, and without effect on single members."""

import json
import math

import pytest
import torch

import regenerate_golden as golden
from cvtgs import GaussianScene
from cvtgs.cells import Partition
from cvtgs.errors import InvalidArgumentError
from cvtgs.mergenet import correct_cells
from mergenet_cases import Case, case_of, lively_net, some_case, some_labels
from scenes import assert_same_gaussians, moved, random_scene, same_bits

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
HALF = math.sqrt(0.5)


def biggest_change(first: GaussianScene, second: GaussianScene) -> float:
    pairs = ((values, second.tensors()[name]) for name, values in first.tensors().items())
    return max(float((a - b).abs().amax()) for a, b in pairs if a.numel())


def assert_close(first: GaussianScene, second: GaussianScene, tolerance: float) -> None:
    for name, values in first.tensors().items():
        other = second.tensors()[name].to(values.dtype)
        torch.testing.assert_close(values, other, rtol=tolerance, atol=tolerance, msg=name)


MOTIONS = {
    "turned": {"quat": (0.9, 0.1, -0.3, 0.2)},
    "a quarter turn": {"quat": (HALF, 0.0, 0.0, HALF)},
    "shifted": {"shift": (3.0, -50.0, 100.0)},
    "in millimetres": {"scale": 1e3},
    "all of it": {"quat": (0.1, 0.7, 0.2, -0.6), "shift": (1.0, 2.0, 3.0), "scale": 1e-3},
}


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_the_correction_moves_with_the_scene(motion, degree):
    case, net = some_case(200, 30, degree=degree), lively_net()
    there = case_of(moved(case.scene, **motion), some_labels(200, 30))
    there = there._replace(pixel_size=case.pixel_size * motion.get("scale", 1.0))
    assert_same_gaussians(there.correct(net), moved(case.correct(net), **motion), tolerance=1e-6)
    assert biggest_change(case.correct(net), case.merged) > 0.1


def test_an_offset_of_all_colours_is_kept():
    case, net = some_case(degree=2), lively_net()
    offset = torch.tensor([5.0, -1.0, 0.3]).double()
    scene = case.scene.with_tensors({"sh0": case.scene.sh0 + offset}, {})
    there = case_of(scene, some_labels(60, 12)).correct(net)
    here = case.correct(net)
    assert_close(there.with_tensors({"sh0": there.sh0 - offset}, {}), here, 1e-9)


def test_order_of_members_does_not_matter():
    case, net = some_case(200, 30), lively_net()
    shuffle = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    labels = some_labels(200, 30)
    there = case_of(
        case.scene.select(shuffle), labels[shuffle], visibility=case.visibility[shuffle]
    )
    assert_close(there.correct(net), case.correct(net), 1e-9)


@pytest.mark.parametrize("limit", [1, 10, 100, 1000])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.slow
def test_chunks_do_not_change_the_result(monkeypatch, dtype, tolerance, limit):
    """Up to rounding: the order of sums in matrix products may depend on the number of rows."""
    case, net = some_case(300, 60, degree=2, dtype=dtype), lively_net(dtype)
    whole = case.correct(net)
    monkeypatch.setitem(correct_cells.__globals__, "CHUNK_MEMBERS", limit)
    assert_close(case.correct(net), whole, tolerance)


@dtypes
def test_results_are_deterministic(dtype):
    case, net = some_case(300, 60, dtype=dtype), lively_net(dtype)
    assert same_bits(case.correct(net), case.correct(net))


@dtypes
def test_cells_of_one_are_kept_bit_for_bit(dtype):
    """Whatever they hold: infinite logits, quaternions of any length."""
    scene = random_scene(60, degree=2, dtype=dtype, size=0.4)
    quats, logits = scene.quats.clone(), scene.logit_opacities.clone()
    quats[:4] *= torch.tensor([[1e-20], [-7.0], [1e20], [1.0]], dtype=dtype)
    logits[:4] = torch.tensor([math.inf, -math.inf, 700.0, -700.0])
    scene = scene.with_tensors({"quats": quats, "logit_opacities": logits}, {})
    labels = torch.cat([torch.arange(10), 10 + torch.arange(50) % 7])
    case = case_of(scene, labels)
    small = case.correct(lively_net(dtype))
    singles = torch.arange(10)
    assert same_bits(small.select(singles), scene.select(singles))
    others = torch.arange(10, 17)
    assert biggest_change(small.select(others), case.merged.select(others)) > 0.1


def test_a_scene_of_cells_of_one_is_unchanged():
    scene, told = random_scene(5), []
    case = case_of(scene, torch.arange(5))
    net = lively_net(torch.float32)
    small = correct_cells(
        net,
        *case[:3],
        neighbors=case.neighbors,
        visibility=case.visibility,
        pixel_size=case.pixel_size,
        on_cells=told.append,
    )
    assert same_bits(small, scene)
    assert told == []


def test_progress_counts_the_finished_cells(monkeypatch):
    monkeypatch.setitem(correct_cells.__globals__, "CHUNK_MEMBERS", 4)
    scene, told = random_scene(10), []
    case = case_of(scene, torch.tensor([0, 0, 1, 2, 2, 2, 3, 3, 4, 0]), near=0)
    net = lively_net(torch.float32)
    correct_cells(
        net,
        *case[:3],
        neighbors=case.neighbors,
        visibility=case.visibility,
        pixel_size=case.pixel_size,
        on_cells=told.append,
    )
    assert told == [3, 4, 5]


@dtypes
@pytest.mark.parametrize("cells", [1, 2, 5, 9])
def test_few_cells_have_few_neighbours(cells, dtype):
    case = some_case(40, cells, dtype=dtype)
    assert case.neighbors.shape == (cells, min(8, cells - 1))
    small = case.correct(lively_net(dtype))
    assert biggest_change(small, case.merged) > 1e-2
    assert all(bool(values.isfinite().all()) for values in small.tensors().values())


@dtypes
@pytest.mark.parametrize("copies", [2, 3, 100])
def test_identical_members_keep_colour_and_place_when_alone(copies, dtype):
    """Nothing distinguishes the members, so only size and opacity may change."""
    one = random_scene(1, degree=2, dtype=dtype)
    scene = one.select(torch.zeros(copies, dtype=torch.int64))
    case = case_of(scene, torch.zeros(copies, dtype=torch.int64))
    small = case.correct(lively_net(dtype))
    torch.testing.assert_close(small.means, one.means)
    torch.testing.assert_close(small.sh, one.sh, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(small.quats, case.merged.quats)
    assert not torch.allclose(small.log_scales, case.merged.log_scales)


def double_of(case: Case) -> Case:
    """The same case in float64, merged Gaussians included."""

    def doubled(scene: GaussianScene) -> GaussianScene:
        return scene.with_tensors({k: v.double() for k, v in scene.tensors().items()}, {})

    return case._replace(scene=doubled(case.scene), merged=doubled(case.merged))


def test_cells_of_two_and_of_a_hundred_thousand():
    """Sums of many float32 numbers stay precise: within 1e-5 of float64."""
    scene = random_scene(100_020, degree=0)
    labels = torch.cat([torch.zeros(100_000, dtype=torch.int64), 1 + torch.arange(20) // 2])
    case = case_of(scene, labels)
    small = case.correct(lively_net(torch.float32))
    assert_close(small, double_of(case).correct(lively_net()), 1e-5)
    growth = (small.log_scales - case.merged.log_scales).abs()
    assert float(growth.amax()) <= 0.6 + 1e-5
    assert bool((growth.amax(dim=1) > 1e-3).all())


@pytest.mark.parametrize("seed", range(3))
def test_float32_agrees_with_float64(seed):
    """Within 5e-6 of the extent of the scene, and of colours, logs and logits of order 1."""
    case = some_case(2000, 300, degree=2, dtype=torch.float32, seed=seed)
    single = case.correct(lively_net(torch.float32, seed=seed))
    double = double_of(case).correct(lively_net(seed=seed))
    assert single.dtype == torch.float32
    assert_close(single, double, 5e-6)


def test_a_network_of_another_dtype_is_refused():
    case, net = double_of(some_case()), lively_net(torch.float32)
    with pytest.raises(InvalidArgumentError) as caught:
        case.correct(net)
    assert str(caught.value) == (
        "the network must have the dtype of the scene, torch.float64, found torch.float32; "
        "net.copy_to(scene.device, scene.dtype) returns one that has."
    )
    case.correct(net.copy_to(torch.device("cpu"), torch.float64))


def test_ambient_visibility_is_needed_for_every_gaussian():
    case = some_case()
    with pytest.raises(InvalidArgumentError, match=r"visibility must be a number for each of"):
        case._replace(visibility=case.visibility[:0]).correct(lively_net())


def test_input_is_not_changed():
    case = some_case(degree=1)
    scene, merged = (s.select(torch.arange(len(s))) for s in (case.scene, case.merged))
    case.correct(lively_net())
    assert same_bits(case.scene, scene)
    assert same_bits(case.merged, merged)


def test_extras_comments_and_layout_are_those_of_the_merged_scene():
    case = some_case()
    merged = GaussianScene(
        **case.merged.tensors(),
        extras={"label": torch.arange(12)},
        comments=("SplatRenderMode: mip",),
        layout=(("x", "float"),),
    )
    small = case._replace(merged=merged).correct(lively_net())
    assert small.extras["label"].tolist() == list(range(12))
    assert (small.comments, small.layout) == (merged.comments, merged.layout)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-9)])
def test_cuda_gives_the_same_gaussians(dtype, tolerance):
    case = some_case(3000, 400, degree=3, dtype=dtype)
    there = Case(
        case.scene.to("cuda"),
        case.merged.to("cuda"),
        Partition(order=case.part.order.cuda(), offsets=case.part.offsets.cuda()),
        case.neighbors.cuda(),
        case.visibility.cuda(),
        case.pixel_size,
    )
    first, second = (there.correct(lively_net(dtype).cuda()) for _ in "ab")
    assert first.device.type == "cuda"
    assert same_bits(first.to("cpu"), second.to("cpu"))
    assert_close(first.to("cpu"), case.correct(lively_net(dtype)), tolerance)


RENEW = "run `python tests/regenerate_golden.py`, look at the difference and commit it"


@pytest.fixture(scope="module")
def table() -> dict:
    return json.loads(golden.TABLE.read_text(encoding="utf-8"))


def test_the_golden_table_matches_the_shipped_checkpoints(table):
    assert table["digests"] == golden.digests(), f"a shipped checkpoint has changed: {RENEW}"
    assert list(table["figures"]) == golden.CASES, f"the cases have changed: {RENEW}"


@pytest.mark.parametrize("case", golden.CASES)
@pytest.mark.slow
def test_golden_output(table, case):
    found, wanted = golden.figures(case), table["figures"][case]
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=1e-3, abs=1e-6), f"{name}: {RENEW}"
