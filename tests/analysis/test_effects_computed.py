"""Effects that a scene does not need are not computed; forcing them on changes nothing."""

import math
from importlib import import_module

import pytest
import torch

import cvtgs
from cvtgs import GaussianScene, Simplifier, SimplifyConfig, filters, pipeline
from cvtgs.analysis import analyze
from cvtgs.analysis.analyze import measure_contributions
from cvtgs.cells import features
from cvtgs.cvt import nearest_site
from cvtgs.math.frames import RobustFrame
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.mergenet import MergeNet
from cvtgs.tags import ANTIALIASED
from refine_cases import ring
from scenes import random_scene, same_bits

PRESETS = ("standard", "paper")


def run_with(scene: GaussianScene, rho: float = 0.1, **values: object) -> cvtgs.Simplified:
    config = SimplifyConfig.from_mapping(values)
    return Simplifier(config=config, device="cpu").run(scene, rho)


def refuse(*arguments: object, **options: object) -> None:
    raise AssertionError("computed though nobody called for it")


def without_far_ones(scene: GaussianScene) -> GaussianScene:
    return scene.with_tensors({"means": scene.means.clamp(-1, 1)}, {})


def with_zero_bands(scene: GaussianScene, above: int) -> GaussianScene:
    rest = scene.shN.clone()
    rest[:, REST_COUNTS[above] :] = 0.0
    return scene.with_tensors({"shN": rest}, {})


def tagged(scene: GaussianScene) -> GaussianScene:
    return GaussianScene(**scene.tensors(), comments=("made up", ANTIALIASED.text))


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("above", [0, 1, 2])
def test_empty_bands_are_neither_merged_nor_predicted(above, preset, monkeypatch):
    """The result is that of a scene without these bands, apart from zeros in the output."""
    scene = with_zero_bands(random_scene(400, degree=3), above)
    bare = scene.with_tensors({"shN": scene.shN[:, : REST_COUNTS[above]]}, {})
    seen = []
    original = pipeline.merge_and_inflate
    monkeypatch.setattr(
        pipeline,
        "merge_and_inflate",
        lambda valid, *a, **k: seen.append(valid) or original(valid, *a, **k),
    )
    small, report = run_with(scene, preset=preset)
    assert [valid.sh_degree for valid in seen] == [above]
    assert report.plan.sh.degree == above
    assert small.sh_degree == 3
    assert not small.shN[:, REST_COUNTS[above] :].any()
    trimmed = small.with_tensors({"shN": small.shN[:, : REST_COUNTS[above]]}, {})
    assert same_bits(trimmed, run_with(bare, preset=preset).scene)


@pytest.mark.parametrize("preset", PRESETS)
def test_forcing_empty_bands_on_changes_nothing(preset):
    """Without the network of ``paper`` and the colours below zero, which use all bands."""
    merge = {"network": preset != "paper"}
    scene = with_zero_bands(random_scene(400, degree=3), 1)
    planned, forced = (
        run_with(scene, preset=preset, merge=merge, effects={"sh": sh, "clamping": "off"})
        for sh in ("auto", 3)
    )
    assert (planned.report.plan.sh.degree, forced.report.plan.sh.degree) == (1, 3)
    assert same_bits(planned.scene, forced.scene)


def test_faint_bands_change_no_image():
    scene = random_scene(2000, degree=2, size=0.1)
    scene = scene.with_tensors({"shN": 1e-6 * scene.shN}, {})
    planned, forced = (run_with(scene, effects={"sh": sh}) for sh in ("auto", 2))
    assert planned.report.plan.sh.degree == 0
    assert not planned.scene.shN.any()
    cameras = cvtgs.views.automatic_views(scene, 2, width=64, height=64)
    first, second = (cvtgs.render(one.scene, cameras).rgb for one in (planned, forced))
    assert 0 < float((first - second).abs().amax()) < 1e-5


def test_a_lower_degree_than_that_of_the_scene():
    scene = random_scene(400, degree=3)
    same_cells = {"view_color": 0.0}  # else cells depend on the bands
    full, low = (
        run_with(scene, effects={"sh": sh, "clamping": "off"}, allocation=same_cells).scene
        for sh in ("auto", 1)
    )
    assert low.sh_degree == 3
    assert low.shN[:, :3].equal(full.shN[:, :3])
    assert not low.shN[:, 3:].any()
    assert full.shN[:, 3:].any()


def test_bands_that_are_off_are_not_even_checked():
    scene = random_scene(400, degree=3)
    rest = scene.shN.clone()
    rest[7, 14] = math.nan
    broken = scene.with_tensors({"shN": rest}, {})
    low = run_with(broken, effects={"sh": 1})
    assert low.report.invalid_count == 0
    assert same_bits(low.scene, run_with(scene, effects={"sh": 1}).scene)


def test_all_rows_keep_their_bands_unless_told_otherwise():
    scene = random_scene(50, degree=2)
    scene = scene.with_tensors({"shN": 1e-7 * scene.shN}, {})
    assert same_bits(run_with(scene, 1.0).scene, scene)
    assert not run_with(scene, 1.0, effects={"sh": 0}).scene.shN.any()


@pytest.mark.slow
def test_refinement_leaves_empty_bands_alone():
    scene = with_zero_bands(random_scene(300, degree=2), 1)
    refine = {"steps": 3, "size": 32, "heldout": 2, "batch": 4}
    small, report = run_with(scene, refine=refine)
    assert report.refinement is not None
    assert small.sh_degree == 2
    assert not small.shN[:, 3:].any()


def test_bounded_scenes_are_not_contracted(monkeypatch):
    """Points are contracted for the Morton curve, but not for the nearest-site search."""
    scene, calls = without_far_ones(random_scene(400)), []
    original = RobustFrame.contract
    monkeypatch.setattr(RobustFrame, "contract", lambda *given: calls.append(1) or original(*given))
    planned = run_with(scene, cvt={"hidden_share": 1.0}, merge={"network": False})
    assert len(calls) == 1
    forced = run_with(
        scene, cvt={"hidden_share": 1.0}, merge={"network": False}, effects={"unbounded": "on"}
    )
    assert same_bits(planned.scene, forced.scene)
    assert forced.report.plan.unbounded.forced


@pytest.mark.parametrize("preset", PRESETS)
def test_forcing_unbounded_on_with_few_far_gaussians_changes_nothing(preset):
    scene = random_scene(400)
    means = torch.where(torch.arange(400)[:, None] < 4, 40.0, 1.0) * scene.means
    scene = scene.with_tensors({"means": means}, {})
    planned, forced = (
        run_with(scene, preset=preset, effects={"unbounded": one}) for one in ("off", "on")
    )
    assert 0 < forced.report.plan.unbounded.figure < 0.05
    assert forced.report.plan.unbounded.active
    assert same_bits(planned.scene, forced.scene)


def test_faint_gaussians_without_mass_are_not_sorted(monkeypatch):
    scene = random_scene(400)
    opacities = torch.where(torch.arange(400) < 50, 1e-4, 0.5)
    scene = scene.with_tensors({"logit_opacities": torch.logit(opacities)}, {})
    share = {"max_mass_share": 0.01}
    forced = run_with(scene, filter=share, effects={"haze": "on"})
    monkeypatch.setattr(filters, "visible_rows", refuse)
    planned = run_with(scene, filter=share)
    assert planned.report.filtered_count == 50
    assert same_bits(planned.scene, forced.scene)


def test_with_haze_off_all_faint_gaussians_are_filtered_as_in_the_paper():
    scene = random_scene(400)
    faint = {"min_opacity": 0.1}
    on, off = (
        run_with(scene, filter=faint, effects={"haze": haze}).report for haze in ("auto", "off")
    )
    assert on.plan.haze.active
    faint = int((scene.opacities < 0.1).sum())
    assert on.filtered_count < faint == off.filtered_count


def test_faint_gaussians_are_kept_if_the_target_needs_them():
    scene = random_scene(100)
    faint = scene.with_tensors({"logit_opacities": scene.logit_opacities * 0 - 4.0}, {})
    small, _ = run_with(faint, 0.5, effects={"haze": "off"})
    assert len(small) == 50


def test_duplicates_are_searched_once(monkeypatch):
    """The result is the same, also with more cells than distinct places."""
    scene = random_scene(300).select(torch.arange(300).repeat(3))
    searched = []

    def search(points, sites):
        searched.append(len(points))
        return nearest_site(points, sites)

    for home in ("nearest", "tessellate"):
        monkeypatch.setattr(import_module(f"cvtgs.cvt.{home}"), "nearest_site", search)
    settings = {
        "filter": {"min_opacity": 0.0},
        "cvt": {"iterations": 1},
        "allocation": {"oversampling": 1.0},
    }
    for rho in (0.1, 0.5):
        planned = run_with(scene, rho, **settings)
        assert planned.report.plan.duplicates.active
        assert searched == [300, 300]
        searched.clear()
        off = run_with(scene, rho, **settings, effects={"duplicates": "off"})
        assert searched == [900, 900]
        searched.clear()
        assert same_bits(planned.scene, off.scene)


def test_without_duplicates_nothing_is_compared(monkeypatch):
    scene = random_scene(400)
    scene = scene.select(torch.cat([torch.arange(400), torch.arange(2)]))  # too few to be worth it
    forced = run_with(scene, effects={"duplicates": "on"})
    assert forced.report.plan.duplicates.active
    monkeypatch.setattr("cvtgs.cvt.nearest.first_of_each", refuse)
    assert same_bits(run_with(scene).scene, forced.scene)


def test_extra_columns_are_kept_unless_the_effect_is_off():
    scene = random_scene(100).with_tensors({}, {"label": torch.arange(100)})
    small, report = run_with(scene)
    assert report.plan.extras.active
    assert list(small.extras) == ["label"]
    small, report = run_with(scene, effects={"extras": "off"})
    assert not report.plan.extras.active
    assert not small.extras


def test_no_image_is_rendered_unless_the_preset_asks(monkeypatch):
    monkeypatch.setattr("cvtgs.prepared.measure_contributions", refuse)
    scene = random_scene(100)
    run_with(scene)
    run_with(scene, visibility={"views": 4}, effects={"visibility": "off"})
    with pytest.raises(AssertionError, match="nobody called"):
        run_with(scene, visibility={"views": 4})


@pytest.mark.parametrize("choice", ["auto", "on", "off"])
@pytest.mark.parametrize("is_tagged", [True, False])
@pytest.mark.slow
def test_images_are_compensated_as_planned_and_the_tag_stays(is_tagged, choice, monkeypatch):
    scene = random_scene(100)
    scene, taken = tagged(scene) if is_tagged else scene, []
    module = import_module("cvtgs.analysis.analyze")
    original = module.contributions
    monkeypatch.setattr(
        module,
        "contributions",
        lambda scene, *a, **k: taken.append(scene.antialiased) or original(scene, *a, **k),
    )
    small, report = run_with(scene, visibility={"views": 2, "size": 32}, effects={"mip": choice})
    active = is_tagged and choice != "off"
    assert report.plan.mip.active is active
    assert set(taken) == {active}
    assert small.comments == scene.comments


@pytest.mark.slow
def test_images_decide_on_haze_by_the_mass_that_they_show():
    config = SimplifyConfig.from_mapping({"visibility": {"views": 2, "size": 32}})
    scene = random_scene(100, dtype=torch.float64)
    logits = scene.logit_opacities.index_fill(0, torch.arange(50), -5.4)
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    before = analyze(scene, config)
    found = measure_contributions(scene, before, config, cameras=ring(2))
    areas, shares = found.apparent_areas, []
    for values in (areas * found.opacities, areas):
        shares.append(float(values[:50].sum() / values.sum()))
    assert found.plan.haze.figure == pytest.approx(shares[0])
    assert found.plan.haze.figure != pytest.approx(before.plan.haze.figure, rel=1e-2)
    assert shares[1] > 2 * shares[0]


def test_without_images_the_tag_changes_opacities_unless_mip_is_off():
    scene, plain = tagged(random_scene(200)), random_scene(200)
    small = run_with(scene).scene
    assert same_bits(small, run_with(scene, effects={"mip": "on"}).scene)
    off = run_with(scene, effects={"mip": "off"}).scene
    assert off.comments == scene.comments
    assert not torch.equal(off.logit_opacities, small.logit_opacities)
    for name, values in run_with(plain).scene.tensors().items():
        assert torch.equal(off.tensors()[name], values)


def test_cells_of_one_member_are_not_shown_to_the_network(monkeypatch):
    scene = random_scene(100)
    opaque = scene.with_tensors({"logit_opacities": scene.logit_opacities * 0 + 2.0}, {})
    described, original = [], MergeNet.forward
    monkeypatch.setattr(
        MergeNet,
        "forward",
        lambda net, seen: described.append(len(seen)) or original(net, seen),
    )
    _, report = run_with(opaque, 0.9)
    assert sum(described) == 90 - report.single_member_cells < 90


def test_nothing_is_described_without_a_network(monkeypatch):
    monkeypatch.setattr(features, "describe_members", refuse)
    monkeypatch.setattr("cvtgs.mergenet.apply.describe_members", refuse)
    run_with(random_scene(100), merge={"network": False})


@pytest.mark.parametrize("preset", PRESETS)
def test_forcing_all_effects_on_changes_nothing_for_a_plain_scene(preset):
    """Without far Gaussians, haze and bands, the effects have nothing to do.

    Without the network of ``paper``, which corrects every band that it is given.
    """
    merge = {"network": preset != "paper"}
    scene = without_far_ones(with_zero_bands(random_scene(500, degree=2), 0))
    scene = scene.with_tensors({"logit_opacities": scene.logit_opacities.abs()}, {})
    everything = dict.fromkeys(("sh", "mip", "unbounded", "haze", "duplicates"), "on")
    planned, forced = (
        run_with(scene, preset=preset, merge=merge, effects=e) for e in ({}, everything)
    )
    for name, tensor in planned.scene.tensors().items():
        assert torch.allclose(tensor, forced.scene.tensors()[name], rtol=0, atol=1e-5), name
    assert all(effect.forced for name, effect in forced.report.plan if name in everything)


def test_the_report_holds_the_plan_with_its_evidence():
    report = run_with(random_scene(100), effects={"unbounded": "off"}).report
    again = cvtgs.SimplifyReport.model_validate_json(report.to_json())
    assert again.plan == report.plan
    assert report.plan.unbounded.forced
    assert len(report.plan.sh.bands) == 1
    assert report.config.effects.unbounded == "off"


def test_the_plan_of_describe_is_that_of_the_report():
    scene = random_scene(300, degree=2)
    for values in ({}, {"effects": {"sh": 1, "haze": "off"}}, {"preset": "paper"}):
        config = SimplifyConfig.from_mapping(values)
        assert cvtgs.describe(scene, config).plan == run_with(scene, **values).report.plan
