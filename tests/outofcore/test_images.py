"""Blocks are matched and refined while the others are rendered but fixed: no seams, same bits."""

import os
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.boxes import Box
from cvtgs.clock import StageCost
from cvtgs.edit import Motion, move
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import EvaluationSettings
from cvtgs.outofcore import LocalWorkers, images as module, simplify_file
from cvtgs.outofcore.memory import IMAGE_BYTES, LEAST_BYTES
from cvtgs.report import MatchReport, RefineReport
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from cvtgs.views import automatic_views, mixed_views

COUNT, LARGER_COUNT = 200, 800
SEEDS = range(4, 12)
MATCHED = {
    "preset": "matched",
    "visibility": {"views": 12, "size": 64, "stride": 1},
    "match": {"color_iterations": 6},
    "refine": {"steps": 0},
}
REFINED = {
    "preset": "high",
    "visibility": {"size": 48},
    "refine": {"steps": 12, "size": 48, "images": 12, "heldout": 2, "check_every": 6},
}


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", 4000, sh_degree=1, seed=4)


@pytest.fixture(scope="module")
def source(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("improve") / "in.ply"
    cvtgs.save(scene, path)
    return path


def simplifier_of(settings):
    return Simplifier(config=SimplifyConfig.from_mapping(settings), device="cpu")


def in_blocks(source, output, settings, *, count=COUNT, blocks=3, **options):
    simplifier = simplifier_of(settings)
    return simplify_file(
        source, output, count=count, blocks=blocks, simplifier=simplifier, **options
    )


@pytest.mark.slow
def test_a_scene_too_small_for_the_near_plane_is_warned_about_once(scene, tmp_path):
    cvtgs.save(move(scene, Motion(scale=3e-3)), tmp_path / "in.ply")
    settings = MATCHED | {"visibility": {"views": 4, "size": 32}}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        in_blocks(tmp_path / "in.ply", tmp_path / "out.ply", settings)
    texts = [str(one.message) for one in caught]
    assert sum("of the Gaussians before their cameras" in text for text in texts) == 1


@pytest.mark.long
def test_nobody_is_asked_for_better_cameras_than_generated_ones(scene, tmp_path):
    """They are far away from Gaussians that all have one position."""
    point = scene.with_tensors({"means": torch.full_like(scene.means, 3.0)})[:800]
    cvtgs.save(point, tmp_path / "in.ply")
    settings = REFINED | {"refine": REFINED["refine"] | {"steps": 2, "images": 4}}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        in_blocks(tmp_path / "in.ply", tmp_path / "out.ply", settings, count=80, blocks=2)
    assert not [str(one.message) for one in caught if "cameras" in str(one.message)]


def psnr_of(scene, small):
    cameras = automatic_views(scene, 4, width=96, height=72)
    settings = EvaluationSettings(lpips="off")
    return [
        one.psnr.mean for one in cvtgs.evaluate(scene, small, cameras, settings=settings).scenes
    ]


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """Mean PSNR of eight scenes in one piece and in blocks, with and without matching.

    Views are chosen like those of blocks, also blurred ones. The loss of a single scene from blocks
    has a standard deviation of 0.4 dB.
    """
    found = {name: {"one": 0.0, "blocks": 0.0} for name in ("standard", "matched")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cvtgs.views.mixed.TRIED", 1)
        for seed in SEEDS:
            scene = cvtgs.synthetic.scene("object", 4000, sh_degree=1, seed=seed)
            folder = tmp_path_factory.mktemp("scores")
            cvtgs.save(scene, folder / "in.ply")
            for name, settings in {"standard": {}, "matched": MATCHED}.items():
                report = in_blocks(
                    folder / "in.ply", folder / f"{name}.ply", settings, count=LARGER_COUNT
                )
                small = {
                    "one": simplifier_of(settings).simplify(scene, count=LARGER_COUNT),
                    "blocks": cvtgs.load(folder / f"{name}.ply"),
                }
                assert len(small["blocks"]) == LARGER_COUNT == report.output_count
                for way, value in zip(small, psnr_of(scene, small), strict=True):
                    found[name][way] += value / len(SEEDS)
            assert report.matching.views == 3 * 12
            assert report.matching.psnr_after > report.matching.psnr_before
    return found


@pytest.mark.long
def test_matching_in_blocks_improves_psnr(scores):
    assert scores["matched"]["blocks"] > scores["standard"]["blocks"] + 0.1


@pytest.mark.long
def test_matching_adds_little_to_the_loss_from_blocks(scores):
    losses = {name: found["one"] - found["blocks"] for name, found in scores.items()}
    assert losses["matched"] < losses["standard"] + 0.3


@pytest.mark.long
@pytest.mark.parametrize("settings", [MATCHED, REFINED])
def test_the_order_of_blocks_does_not_matter(source, tmp_path, settings):
    def backwards(function, items):
        results = {item: function(item) for item in reversed(items)}
        return [results[item] for item in items]

    in_blocks(source, tmp_path / "a.ply", settings, blocks=2)
    in_blocks(source, tmp_path / "b.ply", settings, blocks=2, workers=backwards)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_what_is_near_a_block_reaches_half_of_its_diagonal_beyond_it():
    """The box is 3 x 4 x 0, so its diagonal is 5."""
    own = torch.tensor([[0.0, 0, 0], [3, 4, 0], [1, 1, 0]])
    places = [[-2.4, 0, 0], [5.4, 6.4, 2.4], [1, 1, 0], [-2.6, 0, 0], [1, 6.6, 0], [1, 1, -2.6]]
    near = vars(module)["_near"](torch.tensor(places), own)
    assert near.tolist() == [True, True, True, False, False, False]


@pytest.mark.long
@pytest.mark.parametrize("settings", [MATCHED, REFINED])
def test_blocks_use_the_views_of_one_piece_if_they_are_fine_enough(
    source, scene, tmp_path, monkeypatch, settings
):
    """Otherwise those of each block: of 400 x 400 pixels with more than 80,000 Gaussians."""
    config = SimplifyConfig.from_mapping(settings)
    size, most = config.visibility.size, config.visibility.size**2 // 2
    assert [module.has_fine_views(config, count) for count in (most, most + 1)] == [True, False]
    looks, real = [], module.observe
    monkeypatch.setattr(module, "observe", lambda s, views: looks.append(views) or real(s, views))
    in_blocks(source, tmp_path / "fine.ply", settings, blocks=2)
    wanted = mixed_views(scene, config.visibility.views, size=size, seed=config.seed)
    assert all(torch.equal(views.viewmats, wanted.viewmats) for views in looks)
    monkeypatch.setattr(module, "PIXELS_EACH", 1e9)
    in_blocks(source, tmp_path / "coarse.ply", settings, blocks=2)
    assert len(looks) == 4
    assert not any(torch.equal(views.viewmats, wanted.viewmats) for views in looks[2:])


@pytest.mark.parametrize(
    ("settings", "views"),
    [
        ({}, 8),  # all 480 images are among those of the matching: only held-out ones are asked for
        ({"refine": {"steps_per_image": 10}}, 56),
        ({"refine": {"size": 200}}, 136),  # other images than those of the matching
        ({"refine": {"size": 200, "steps": 3}}, 20),
    ],
)
def test_only_views_that_a_refinement_uses_are_searched(settings, views):
    config = SimplifyConfig.model_validate({"preset": "high", **settings})
    assert module.later_views(config) == views


def test_reports_of_matched_blocks_are_joined():
    shared = {"backend": "numba"}
    one = MatchReport(
        views=3, heldout=3, opacities_kept=True, psnr_before=20.0, psnr_after=23.0, **shared
    )
    two = MatchReport(
        views=9, heldout=1, opacities_kept=False, psnr_before=24.0, psnr_after=30.0, **shared
    )
    wanted = MatchReport(
        views=12, heldout=4, opacities_kept=False, psnr_before=22.0, psnr_after=26.5, **shared
    )
    assert module.join_matchings([one, two]) == wanted


def refine_report(stopped: str, **changes: Any) -> RefineReport:
    cost = StageCost(stage="refine", seconds=2.0, cpu_seconds=5.0, peak_memory_bytes=7)
    values: dict[str, Any] = {
        "steps": 3,
        "images": 4,
        "heldout": 2,
        "psnr_before": 20.0,
        "psnr_after": 21.0,
    }
    values |= {"gain": 1.0, "changed_count": 9, "backend": "numba", "device": "cpu", "cost": cost}
    return RefineReport(stopped=stopped, **(values | changes))


@pytest.mark.parametrize(("other", "stopped"), [("patience", "patience"), ("time", "steps")])
def test_reports_of_refined_blocks_are_joined(other: str, stopped: str) -> None:
    more = {"psnr_after": 23.0, "gain": 3.0, "changed_count": 0, "heldout": 1}
    joined = module.join_refinements([refine_report("patience"), refine_report(other, **more)])
    sums = {"steps": 6, "images": 8, "heldout": 3, "changed_count": 9}
    wanted = refine_report(stopped, psnr_after=22.0, gain=2.0, **sums)
    cost = wanted.cost.model_copy(update={"seconds": 4.0, "cpu_seconds": 10.0})
    assert joined == wanted.model_copy(update={"cost": cost})


def test_images_raise_the_least_memory(source, tmp_path):
    least = LEAST_BYTES + IMAGE_BYTES
    text = rf"memory must be at least {least / 1e6:g} MB: .* images of the scene 400 MB, .*; found "
    with pytest.raises(InvalidArgumentError, match=rf"{text}{least - 1:,} bytes\."):
        in_blocks(source, tmp_path / "no.ply", MATCHED, blocks=None, memory=least - 1)


@pytest.mark.long
def test_a_tag_that_is_switched_off_does_not_change_views(scene, tmp_path, monkeypatch):
    cvtgs.save(replace(scene, comments=(ANTIALIASED.text,)), tmp_path / "in.ply")
    looks, real = [], module.observe
    monkeypatch.setattr(module, "observe", lambda s, views: looks.append(views) or real(s, views))
    settings = MATCHED | {"effects": {"mip": "off"}}
    in_blocks(tmp_path / "in.ply", tmp_path / "out.ply", settings, blocks=2)
    wanted = mixed_views(scene, 12, size=64, seed=0)
    assert all(torch.equal(views.viewmats, wanted.viewmats) for views in looks)


@pytest.mark.long
@pytest.mark.parametrize("boxes", [(), (Box(min=(-99, -99, 0.4), max=(99, 99, 99)),)])
def test_blocks_of_flat_gaussians_that_become_thick_are_matched(scene, tmp_path, boxes):
    """Their simplified Gaussians have three scales, the full ones two."""
    flat = replace(scene, comments=(TWO_SCALES.text,))
    cvtgs.save(flat, tmp_path / "in.ply")
    small = tmp_path / "out.ply"
    settings = MATCHED | {"effects": {"flat": "off"}}
    in_blocks(tmp_path / "in.ply", small, settings, count=LARGER_COUNT, blocks=2, boxes=boxes)
    assert len(cvtgs.load(small)) == LARGER_COUNT
    assert not cvtgs.load(small).has_two_scales


@pytest.mark.long
def test_two_workers_give_the_same_bits(source, tmp_path):
    in_blocks(source, tmp_path / "a.ply", REFINED, blocks=3)
    with LocalWorkers(2) as workers:
        in_blocks(source, tmp_path / "b.ply", REFINED, blocks=3, workers=workers)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.long
def test_refinement_in_blocks_gains_and_keeps_protected_gaussians(scene, source, tmp_path):
    lowest = float(scene.means[:, 2].kthvalue(len(scene) - 40).values)
    box = Box(min=(-99, -99, lowest), max=(99, 99, 99))
    kept = scene.select(cvtgs.boxes.inside([box], scene.means))
    assert len(kept) > 40
    report = in_blocks(source, tmp_path / "out.ply", REFINED, boxes=[box])
    small = cvtgs.load(tmp_path / "out.ply")
    assert (len(small), report.refinement.steps) == (COUNT, 3 * 12)
    assert report.refinement.psnr_after > report.refinement.psnr_before
    first = small.select(torch.arange(len(kept)))
    assert all(torch.equal(a, kept.tensors()[name]) for name, a in first.tensors().items())


@pytest.mark.long
@pytest.mark.parametrize("kind", ["small", "improved", "targets"])
def test_reports_are_whole_after_damage_to_files_of_finished_blocks(source, tmp_path, kind):
    def stop(event):
        if event.stage == "assemble":
            raise KeyboardInterrupt

    output, whole = tmp_path / "out.ply", tmp_path / "whole.ply"
    wanted = in_blocks(source, whole, MATCHED)
    with pytest.raises(KeyboardInterrupt):
        in_blocks(source, output, MATCHED, listener=stop)
    path = max(tmp_path.glob(f".out.ply.blocks/*/{kind}[._]*"), key=lambda path: path.suffix)
    os.truncate(path, path.stat().st_size - 5)
    found = in_blocks(source, output, MATCHED)
    assert output.read_bytes() == whole.read_bytes()
    assert (found.matching, found.mass_out) == (wanted.matching, wanted.mass_out)
