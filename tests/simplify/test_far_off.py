"""Scenes far from the origin, merged as at the origin, and groups far apart."""

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, Simplifier
from cvtgs.cells import Partition
from cvtgs.devices import one_thread
from cvtgs.evaluation import EvaluationSettings
from cvtgs.math.frames import robust_frame
from cvtgs.outofcore import simplify_file
from cvtgs.pipeline import moved_back
from cvtgs.views import automatic_views
from scenes import random_scene, same_bits

SHIFT = torch.tensor([2.0**17, -(2.0**16), 3.0 * 2**16])
"""Distances at which float32 positions have steps of 1/64."""


@pytest.fixture(scope="module")
def near() -> GaussianScene:
    """A scene whose positions are multiples of these steps, so that a shift rounds nothing."""
    scene = cvtgs.synthetic.scene("object", 6000, sh_degree=0, seed=1)
    return scene.with_tensors(means=(scene.means * 64).round() / 64)


@pytest.fixture(scope="module")
def far(near: GaussianScene) -> GaussianScene:
    return near.with_tensors(means=near.means + SHIFT)


def psnr(near: GaussianScene, small: GaussianScene) -> float:
    views = automatic_views(near, 4, width=200, height=150)
    settings = EvaluationSettings(lpips="off")
    return cvtgs.evaluate(near, {"small": small}, views, settings=settings).scenes[0].psnr.mean


def moved_to(small: GaussianScene, shift: torch.Tensor) -> GaussianScene:
    return small.with_tensors(means=small.means + shift)


@pytest.mark.slow
def test_a_far_scene_is_as_good_as_at_the_origin(near, far):
    """Merged positions are rounded to steps of 1/64, once; both have these positions."""
    small, report = Simplifier(device="cpu").run(far, 0.1)
    wanted = moved_to(moved_to(cvtgs.simplify(near, 0.1, device="cpu"), SHIFT), -SHIFT)
    assert psnr(near, moved_to(small, -SHIFT)) > psnr(near, wanted) - 0.1
    there = set(map(tuple, far.means.tolist()))
    kept = sum(position in there for position in map(tuple, small.means.tolist()))
    assert kept >= report.single_member_cells > 0


@pytest.mark.long
def test_blocks_of_a_far_scene(near, far, tmp_path):
    cvtgs.save(far, tmp_path / "far.ply")
    cvtgs.save(near, tmp_path / "near.ply")
    simplify_file(tmp_path / "far.ply", tmp_path / "one.ply", 0.1, blocks=1)
    with one_thread():
        whole = cvtgs.simplify(far, 0.1, device="cpu")
    assert same_bits(cvtgs.load(tmp_path / "one.ply"), whole)
    scores = {}
    for name, shift in (("near", SHIFT * 0), ("far", SHIFT)):
        simplify_file(tmp_path / f"{name}.ply", tmp_path / f"4{name}.ply", 0.1, blocks=4)
        small = moved_to(cvtgs.load(tmp_path / f"4{name}.ply"), SHIFT - shift)
        scores[name] = psnr(near, moved_to(small, -SHIFT))
    assert scores["far"] > scores["near"] - 0.1


@pytest.mark.parametrize(("distance", "dtype", "moves"), [
    (500.0, torch.float32, False), (5000.0, torch.float32, True), (5000.0, torch.float64, False),
])  # fmt: skip
def test_only_coarse_positions_are_centred(distance, dtype, moves):
    means = random_scene(100, dtype=dtype).means
    frame = robust_frame(means)
    means = means + distance * frame.radius
    frame = robust_frame(means)
    origin = frame.far_origin(means)
    assert (origin is not None) is moves
    if origin is not None:
        assert torch.equal((means - origin) + origin, means)


@pytest.mark.long
@pytest.mark.parametrize("distance", [30.0, 1e4])
def test_groups_far_apart_are_seen_from_near(near, distance):
    """With the extent of the whole as that of a view, the network lost 4 to 7 dB."""
    other = moved_to(near, torch.tensor([distance, 0.0, 0.0]))
    both = cvtgs.concatenate([near, other])
    corrected, plain = (
        Simplifier(config=name, device="cpu").simplify(both, 0.1) for name in ("standard", "fast")
    )
    alone = psnr(near, cvtgs.simplify(near, 0.1, device="cpu"))
    assert psnr(near, corrected) > psnr(near, plain) + 0.3
    assert psnr(near, corrected) > alone - 1.5


@pytest.mark.long
def test_groups_far_apart_in_blocks(near, tmp_path):
    both = cvtgs.concatenate([near, moved_to(near, torch.tensor([1e3, 0.0, 0.0]))])
    cvtgs.save(both, tmp_path / "both.ply")
    simplify_file(tmp_path / "both.ply", tmp_path / "small.ply", 0.1, blocks=2)
    whole = cvtgs.simplify(both, 0.1, device="cpu")
    assert psnr(near, cvtgs.load(tmp_path / "small.ply")) > psnr(near, whole) - 0.3


@pytest.mark.long
def test_far_landscapes_are_contracted_about_their_centre():
    near = cvtgs.synthetic.scene("landscape", 6000, sh_degree=0, seed=1)
    near = near.with_tensors(means=(near.means * 64).round() / 64)
    small, report = Simplifier(device="cpu").run(moved_to(near, SHIFT), 0.02)
    assert report.plan.unbounded.active
    wanted = moved_to(moved_to(cvtgs.simplify(near, 0.02, device="cpu"), SHIFT), -SHIFT)
    assert psnr(near, moved_to(small, -SHIFT)) > psnr(near, wanted) - 0.3


def test_single_members_keep_their_very_position():
    """Near the origin of a far scene, the difference from its centre is rounded."""
    scene = random_scene(3, degree=0)
    scene = scene.with_tensors(means=torch.tensor([[1e5, 0, 0], [0.1, 0.2, 0.3], [1e5, 1, 0]]))
    origin = torch.tensor([1e5, 0.5, 0.0])
    cells = Partition.from_labels(torch.tensor([0, 1, 0]), 2)
    small = scene.select(torch.tensor([0, 1])).with_tensors(means=scene.means[:2] - origin)
    back = moved_back(small, origin, scene, cells).means
    assert torch.equal(back[1], scene.means[1])
    assert not torch.equal((small.means + origin)[1], scene.means[1])
    assert torch.equal(back[0], (small.means + origin)[0])


def test_a_second_run_gives_the_same_bits(far):
    """It uses cached neighbours and an order of the rows, which no shift may change."""
    strays = random_scene(5, degree=0)  # so near the origin that a shift rounds them
    prepared = Simplifier(device="cpu").prepare(cvtgs.concatenate([far, strays]))
    first, second, third = (prepared.run(0.1).scene for _ in range(3))
    assert same_bits(first, second)
    assert same_bits(second, third)


def test_a_protected_region_stays_in_place(far):
    keep = torch.arange(len(far)) < 20
    small = Simplifier(device="cpu").simplify(far, 0.05, keep=keep)
    assert same_bits(small[:20], far[:20])
