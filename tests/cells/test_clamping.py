"""Colours below zero, which images show as zero: merged cells are as bright as their members."""

import pytest
import torch

from cvtgs import GaussianScene, Simplifier, SimplifyConfig, load, save, synthetic
from cvtgs.cells import Partition, merge_cells
from cvtgs.config import MergeConfig
from cvtgs.math.spherical_harmonics import SH_C0, clamped_parts, evaluate
from cvtgs.outofcore import simplify_file
from scenes import random_scene, same_bits

PAIR = Partition.from_labels(torch.tensor([0, 0]), 1)


def merged(scene: GaussianScene, cells: Partition, *, clamping: bool) -> GaussianScene:
    return merge_cells(scene, cells, config=MergeConfig(), clamping=clamping)


def pair(first: float, second: float) -> GaussianScene:
    """Two Gaussians that differ only in their colour, a gray."""
    one = random_scene(1, degree=0, dtype=torch.float64).select(torch.tensor([0, 0]))
    gray = (torch.tensor([first, second], dtype=torch.float64) - 0.5) / SH_C0
    return one.with_tensors(sh0=gray[:, None, None].expand(2, 1, 3).clone())


@pytest.mark.parametrize(
    ("colors", "plain", "raised"),
    [
        ((-0.5, 0.7), 0.1, 0.35),  # images show 0 and 0.7
        ((-0.5, 0.1), -0.2, -0.15),  # half a part of 0.5 below zero, less 0.2
        ((-0.5, -0.1), -0.3, -0.3),
        ((0.2, 0.6), 0.4, 0.4),
    ],
)
def test_the_merged_colour_is_raised_by_what_images_do_not_show(colors, plain, raised):
    for clamping, wanted in ((False, plain), (True, raised)):
        color = 0.5 + SH_C0 * merged(pair(*colors), PAIR, clamping=clamping).sh0
        assert color.flatten().tolist() == pytest.approx([wanted] * 3)


@pytest.mark.parametrize("degree", range(4))
def test_members_that_are_alike_or_bright_keep_their_mean(degree):
    scene = random_scene(1, degree=degree, dtype=torch.float64).select(torch.tensor([0, 0]))
    dark = scene.with_tensors(sh0=scene.sh0 - 2.0)
    raised = merged(dark, PAIR, clamping=True)
    torch.testing.assert_close(raised.sh0, dark.sh0[:1])
    torch.testing.assert_close(raised.shN, dark.shN[:1])
    cells = Partition.from_labels(torch.arange(50) // 10, 5)
    bright = random_scene(50, degree=degree)
    bright = bright.with_tensors(sh0=bright.sh0 + 20.0)
    plain, raised = (merged(bright, cells, clamping=clamping) for clamping in (False, True))
    assert same_bits(plain, raised)


@pytest.mark.slow
@pytest.mark.parametrize("degree", range(4))
def test_cells_show_the_colours_of_their_members(degree):
    """The error of the mean of what images show, in all directions, at least halves."""
    count = 64
    scene = random_scene(count, degree=degree, dtype=torch.float64)
    scene = scene.with_tensors(
        sh0=scene.sh0 - 0.3 / SH_C0, logit_opacities=scene.logit_opacities * 0
    )
    scene = scene.with_tensors(log_scales=scene.log_scales * 0 - 2.0)
    cells = Partition.from_labels(torch.zeros(count, dtype=torch.long), 1)
    directions = torch.nn.functional.normalize(random_scene(500, dtype=torch.float64).means, dim=1)

    def shown(found: GaussianScene) -> torch.Tensor:
        rows = [evaluate(found.sh0, found.shN, d.expand(len(found), 3)) for d in directions]
        return torch.stack([colors.mean(dim=0) for colors in rows])

    wanted = shown(scene)
    plain, raised = (
        (shown(merged(scene, cells, clamping=clamping)) - wanted).square().mean().sqrt()
        for clamping in (False, True)
    )
    assert raised < 0.5 * plain


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [1, 4])
def test_blocks_are_as_bright(tmp_path, blocks):
    scene = synthetic.scene("object", 4000, sh_degree=1, seed=0)
    save(scene.with_tensors(sh0=scene.sh0 - 0.35 / SH_C0), tmp_path / "in.ply")
    found = {}
    for clamping in ("auto", "off"):
        config = SimplifyConfig(preset="fast", effects={"clamping": clamping})
        one = Simplifier(config=config, device="cpu")
        simplify_file(
            tmp_path / "in.ply", tmp_path / "out.ply", 0.05, simplifier=one, blocks=blocks
        )
        found[clamping] = load(tmp_path / "out.ply").sh0.mean()
        (tmp_path / "out.ply").unlink()
    assert found["auto"] > found["off"] + 0.02


def test_the_plan_decides_for_all_runs():
    """Dark scenes become brighter; the plan of ``paper`` stays that of the publication."""
    scene = synthetic.scene("object", 3000, sh_degree=1, seed=0)
    scene = scene.with_tensors(sh0=scene.sh0 + 0.5 / SH_C0)
    dark = scene.with_tensors(sh0=scene.sh0 - 0.85 / SH_C0)
    plans = {}
    for preset in ("standard", "paper"):
        runs = [Simplifier(config=preset, device="cpu").run(s, 0.02) for s in (scene, dark)]
        plans[preset] = [run.report.plan.clamping for run in runs]
    assert [effect.active for effect in plans["standard"]] == [False, True]
    assert [effect.active for effect in plans["paper"]] == [False, False]
    assert plans["paper"][1].figure == plans["standard"][1].figure > 0.01
    off = SimplifyConfig(preset="fast", effects={"clamping": "off"})
    plain, raised = (Simplifier(config=one, device="cpu") for one in (off, "fast"))
    assert same_bits(plain.simplify(scene, 0.02), raised.simplify(scene, 0.02))
    before, after = (each.simplify(dark, 0.02).sh0 for each in (plain, raised))
    assert (after >= before - 1e-6).all()
    assert after.mean() > before.mean() + 0.05


@pytest.mark.parametrize("degree", [1, 3])
def test_bands_are_raised_by_the_mean_of_what_is_below_zero_less_that_of_the_mean(degree):
    scene = random_scene(40, degree=degree, dtype=torch.float64)
    scene = scene.with_tensors(  # all weigh the same
        sh0=scene.sh0 - 0.3 / SH_C0,
        log_scales=torch.zeros_like(scene.log_scales),
        logit_opacities=torch.zeros_like(scene.logit_opacities),
    )
    cells = Partition.from_labels(torch.zeros(40, dtype=torch.int64), 1)
    plain, raised = (merged(scene, cells, clamping=clamping) for clamping in (False, True))
    wanted = clamped_parts(scene.sh0, scene.shN).mean(dim=0)
    wanted = wanted - clamped_parts(plain.sh0, plain.shN)[0]
    torch.testing.assert_close((raised.sh - plain.sh)[0], wanted)
    assert bool((wanted.abs().amax(dim=1) > 1e-3).all())
