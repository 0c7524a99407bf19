"""The filter in blocks leaves out the Gaussians that it leaves out in one piece."""

from types import SimpleNamespace

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, Simplifier
from cvtgs.analysis import perspective_falloff
from cvtgs.analysis.analyze import HALF_GRID
from cvtgs.boxes import Box, inside
from cvtgs.config import TessellationConfig
from cvtgs.math.frames import RobustFrame
from cvtgs.outofcore import run, simplify_file, sort
from scenes import random_scene

COUNT, OPAQUE = 3000, 300


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    """Most Gaussians are faint, some are never drawn, and masses and opacities differ."""
    scene = random_scene(COUNT, degree=0, seed=3)
    logits = torch.where(torch.arange(COUNT) % 10 == 0, 2.0, scene.logit_opacities.abs() - 7.0)
    return scene.with_tensors(logit_opacities=logits)


@pytest.mark.slow
@pytest.mark.parametrize("target", [OPAQUE, OPAQUE + 1, OPAQUE + 200, 1500, COUNT - 1])
@pytest.mark.parametrize("preset", ["paper", "standard"])
def test_blocks_leave_out_the_same_gaussians(scene, tmp_path, preset, target) -> None:
    cvtgs.save(scene, tmp_path / "in.ply")
    simplifier = Simplifier(preset=preset, device="cpu")
    whole = simplifier.run(scene, count=target).report
    report = simplify_file(
        tmp_path / "in.ply", tmp_path / "out.ply", count=target, blocks=4, simplifier=simplifier
    )
    assert report.output_count == target
    if target == COUNT - 1:  # if one stays that is never drawn, all do
        assert (report.filtered_count, whole.filtered_count) == (0, 1)
        return
    assert report.filtered_count == whole.filtered_count > 0
    assert report.filtered_mass_share == pytest.approx(whole.filtered_mass_share)


def test_the_faintest_of_a_haze_are_left_out_up_to_its_share(scene, tmp_path) -> None:
    """Nearly all lie below the threshold of opacity, and hold much of the mass."""
    ranks = torch.arange(COUNT)
    faint = 0.0041 + 0.0008 * ranks / COUNT
    opacities = torch.where(ranks % 10 == 0, 0.9, faint)
    sizes = torch.where(ranks % 10 == 0, -5.0, -2.0)[:, None].expand(COUNT, 3)
    hazy = scene.with_tensors(logit_opacities=torch.logit(opacities), log_scales=sizes.contiguous())
    cvtgs.save(hazy, tmp_path / "in.ply")
    simplifier = Simplifier(preset="fast", device="cpu")
    whole = simplifier.run(hazy, 0.02).report
    report = simplify_file(
        tmp_path / "in.ply", tmp_path / "out.ply", 0.02, blocks=4, simplifier=simplifier
    )
    assert whole.plan.haze.active
    assert report.filtered_count == whole.filtered_count
    assert 10 < whole.filtered_count < 100


@pytest.mark.parametrize(("heaviest", "stays"), [(1, [0]), (2, [0, 1]), (None, [0, 1, 2])])
def test_flyaways_up_to_the_largest_mass_to_leave_out_are_left_out(heaviest, stays) -> None:
    """They have the same mass at 200 and 300 radii, but that at 200 shows more."""
    frame = RobustFrame(center=torch.zeros(3).double(), radius=1.0)
    three = random_scene(1, degree=0).select(torch.zeros(3, dtype=torch.int64))
    three = three.with_tensors(means=torch.diag(torch.tensor([1.0, 200.0, 300.0])))
    seen = three.areas * three.opacities * perspective_falloff(frame.distances(three.means))
    scan = SimpleNamespace(
        visibility=torch.ones((2 * HALF_GRID) ** 3 + 1),
        frame=frame,
        min_opacity=0.0,
        min_faint_mass=0.0,
        max_flyaway_mass=-1.0 if heaviest is None else float(seen[heaviest]),
    )
    left, *_ = vars(sort)["_filtered"](scan, TessellationConfig(), three, torch.arange(3))
    assert left.tolist() == stays


@pytest.mark.slow
@pytest.mark.parametrize("rows", [400, 1000])
def test_a_sample_leaves_few_more_than_wanted(scene, tmp_path, rows, monkeypatch) -> None:
    """With as many as the sample predicts, half of all runs would have too few, and no filter."""
    monkeypatch.setattr(run, "sample_rows", lambda memory, source: rows)
    cvtgs.save(scene, tmp_path / "in.ply")
    for target in (600, 1000):
        report = simplify_file(
            tmp_path / "in.ply",
            tmp_path / "out.ply",
            count=target,
            blocks=2,
            simplifier=Simplifier(preset="paper", device="cpu"),
            overwrite=True,
        )
        kept = COUNT - report.filtered_count
        assert target <= kept <= target * (1 + 8 * (rows * target / COUNT) ** -0.5)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "standard"])
def test_shares_of_mass_are_those_of_the_whole_scene(scene, tmp_path, preset) -> None:
    cvtgs.save(scene, tmp_path / "in.ply")
    box = Box(min=(-9.0, -9.0, 0.2), max=(9.0, 9.0, 9.0))
    protected = inside([box], scene.means)
    target = int(protected.sum()) + 150
    simplifier = Simplifier(preset=preset, device="cpu")
    report = simplify_file(
        tmp_path / "in.ply",
        tmp_path / "out.ply",
        count=target,
        blocks=3,
        boxes=[box],
        simplifier=simplifier,
    )
    whole = simplifier.run(scene, count=target, keep=protected).report
    assert report.filtered_count == whole.filtered_count > 100
    assert report.filtered_mass_share == pytest.approx(whole.filtered_mass_share)
    if preset == "paper":
        left_out = (scene.opacities < 0.1) & ~protected
        share = float(scene.masses[left_out].sum() / scene.masses.sum())
        assert report.filtered_mass_share == pytest.approx(share)


def test_all_kept_gaussians_are_cells_of_one(scene, tmp_path) -> None:
    cvtgs.save(scene, tmp_path / "in.ply")
    simplifier = Simplifier(preset="draft", device="cpu")
    report = simplify_file(
        tmp_path / "in.ply", tmp_path / "out.ply", 1.0, blocks=2, simplifier=simplifier
    )
    whole = simplifier.run(scene, 1.0).report
    for one in (report, whole):
        assert (one.single_member_cells, one.largest_cell, one.filtered_count) == (COUNT, 1, 0)
