"""Whole simplifications of hard scenes: count, report, warnings, stability, and no giant blobs.

Invariances that cannot hold to 1e-4 (docs/numerics.md says more):

- The Morton curve, the median and the ambient visibility depend on the axes, so a turn gives other
  seeds and cells of equal quality: energies are compared here, given cells in test_merge.py.
- In ``isotropic_cells``, points are midway between two sites, so rounding decides which cell they
  join: images are compared.
- If a few Gaussians hold nearly all the distance (``LUCK``), one seed more or less among them
  decides the energy.
- Denormal coordinates lose their digits in another unit.
"""

import math
import warnings

import pytest
import torch

import cvtgs
from cvtgs import Simplifier
from cvtgs.errors import DroppedDataWarning
from cvtgs.views import automatic_views
from hard_cases import CASES, each_case
from hard_scenes import (
    DEVICES,
    PRESETS,
    changed,
    devices,
    dtypes,
    presets,
    simplifier,
    valid_case,
    valid_rows,
)
from scenes import assert_same_gaussians, assert_standard, moved

COUNT = 60
LUCK = ("flyaways", "far_flyaways", "two_clusters", "crowd_beside_loners")


pytestmark = pytest.mark.usefixtures("coarse_light")


def counts_for(total):
    return sorted({1, max(1, total // 5), max(1, total - 1), total})


def moments_only(preset):
    return Simplifier(None, config=preset, device="cpu")


def run_and_watch(scene, preset, device, count):
    """Return the scene, the report and the categories of warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        small, report = simplifier(preset, device).run(scene, count=count)
    return small, report, [warning.category for warning in caught]


@pytest.mark.slow
@dtypes
@each_case
def test_each_case_at_every_count_and_in_another_order(make, dtype, subtests):
    scene = make(COUNT, dtype)
    fifth = max(1, len(scene) // 5)
    for device in DEVICES:
        there = scene.to(device)
        for preset in PRESETS:
            found = {
                count: run_and_watch(there, preset, device, count)
                for count in counts_for(len(scene))
            }
            for count, (small, report, warned) in found.items():
                name = "exact count, finite output, sane report, one warning"
                with subtests.test(name, device=device, preset=preset, count=count):
                    assert warned == [DroppedDataWarning] * (not valid_rows(scene).all())
                    check_result(there, small, report, count)
            if device == "cpu":
                with subtests.test("the order of the rows changes nothing", preset=preset):
                    check_another_order(scene, preset, fifth, found[fifth][0])


def check_result(scene, small, report, count):
    valid = int(valid_rows(scene).sum())
    assert len(small) == report.output_count == min(count, valid)
    assert (small.dtype, small.device) == (scene.dtype, scene.device)
    assert (small.comments, small.layout) == (scene.comments, scene.layout)
    assert report.invalid_count == len(scene) - valid
    assert (report.shortfall == "") == (count <= valid)
    if count < len(scene):
        assert_standard(small)
    else:  # the rows of the input
        assert torch.equal(small.means, scene.means[valid_rows(scene)])
    masses = report.mass_in, report.mass_out, report.energy, *report.energies
    assert all(math.isfinite(mass) and mass >= 0 for mass in masses)
    assert 0 <= report.filtered_mass_share <= 1


def check_another_order(scene, preset, count, small):
    """Ties between coincident, equal or equally faint rows are broken by mass."""
    shuffle = torch.randperm(len(scene), generator=torch.Generator().manual_seed(1))
    other = run_and_watch(scene.select(shuffle), preset, "cpu", count)[0]
    assert_same_gaussians(small, other)


@pytest.mark.long
@each_case
def test_each_case_in_another_unit_shifted_and_turned(make, subtests):
    """Check float64 scenes in another unit, shifted by twice their size, and turned."""
    scene = valid_case(make, COUNT, torch.float64)
    count = max(1, len(scene) // 5)
    extent = float((scene.means - scene.means.median(dim=0).values).abs().median()) or 1.0
    motions = [{"scale": 1e3}, {"shift": (2 * extent, -extent, 0.3 * extent)}]
    if make.__name__ != "denormals":  # denormal numbers lose digits
        motions.append({"scale": 1e-3})
    # Sites are equally near: see test_scenes_with_equal_distances_give_the_same_image.
    if make.__name__ in ("isotropic_cells", "duplicates", "coincident"):
        motions = []
    for preset in PRESETS:
        run = simplifier(preset)
        small = run.simplify(scene, count=count)
        for motion in motions:
            with subtests.test("unit and shift change nothing", preset=preset, **motion):
                found = run.simplify(moved(scene, **motion), count=count)
                assert_same_gaussians(found, moved(small, **motion))
        with subtests.test("a turn gives cells of equal quality", preset=preset):
            check_a_turn(make, preset)


def check_a_turn(make, preset):
    scene = valid_case(make, 300, torch.float64)
    count = max(1, len(scene) // 5)
    first, second = (
        moments_only(preset).run(s, count=count).report
        for s in (scene, moved(scene, quat=(0.9, 0.1, -0.3, 0.2)))
    )
    assert second.mass_in == pytest.approx(first.mass_in, rel=1e-9)
    if make.__name__ not in LUCK:
        assert second.energy <= 1.5 * first.energy + 1e-12


@pytest.mark.slow
@presets
@pytest.mark.parametrize("name", ["isotropic_cells", "giants"])
def test_scenes_with_equal_distances_give_the_same_image(name, preset):
    """Compare images to 25 dB; single Gaussians differ as much as the network can change them."""
    scene = valid_case(CASES[name], 300, torch.float64)
    there = moved(scene, shift=(1.0, 2.0, -3.0))
    views = automatic_views(scene, 2, width=32, height=32, seed=0)
    first = simplifier(preset).simplify(scene, 0.2)
    second = moved(simplifier(preset).simplify(there, 0.2), shift=(-1.0, -2.0, 3.0))
    ours, theirs = (cvtgs.render(s, views).rgb.clamp(0, 1) for s in (first, second))
    assert -10 * float((ours - theirs).square().mean().log10()) > 25


@dtypes
@devices
@pytest.mark.parametrize("name", ["flyaways", "far_flyaways"])
def test_flyaways_do_not_affect_the_rest_of_the_scene(name, device, dtype):
    """No Gaussian is larger than the scene, and the mass is as without flyaways."""
    scene = CASES[name](300, dtype).to(device)
    small, report = simplifier("standard", device).run(scene, count=60)
    assert report.filtered_count >= 5
    assert float(small.means.abs().amax()) < 2
    assert float(small.scales.amax()) < 1
    alone = simplifier("standard", device).simplify(scene.select(torch.arange(300) >= 5), count=60)
    assert float(small.masses.sum()) == pytest.approx(float(alone.masses.sum()), rel=0.05)


@dtypes
def test_flyaways_stay_in_their_own_cells_with_paper(dtype):
    """The filter of the paper keeps them, but no Gaussian spans the distance to them."""
    small = simplifier("paper").simplify(CASES["flyaways"](300, dtype), count=60)
    near = small.means.abs().amax(dim=1) < 2
    assert int(near.sum()) >= 50
    assert float(small.scales[near].amax()) < 1


@presets
@dtypes
def test_copies_of_a_gaussian_merge_into_it(dtype, preset):
    """There are five copies of each Gaussian, and as many cells as different Gaussians."""
    scene = CASES["duplicates"](COUNT, dtype)
    small = simplifier(preset).simplify(scene, count=COUNT // 5)
    places = scene.means[::5]
    gaps = torch.cdist(small.means.double(), places.double())
    assert float(gaps.amin(dim=1).median()) < 0.05
    assert_standard(small)


def test_the_report_counts_filtered_faint_and_transparent_rows():
    for name in ("all_faint", "all_transparent"):
        scene = CASES[name](COUNT, torch.float32)
        faint = simplifier("standard").run(scene, count=6).report
        assert faint.filtered_mass_share <= 0.01
        paper = simplifier("paper").run(scene, count=6).report
        assert paper.filtered_count == COUNT - 6
        assert paper.output_count == 6


@dtypes
def test_huge_colours_stay_within_the_range_of_the_input(dtype):
    scene = CASES["huge_colours"](COUNT, dtype)
    small = moments_only("standard").simplify(scene, count=12)
    assert float(small.sh0.amax()) <= float(scene.sh0.amax()) * (1 + 1e-6)
    assert float(small.sh0.amin()) >= float(scene.sh0.amin()) * (1 + 1e-6)
    grey = changed(scene, sh0=scene.sh0 * 0 + 1e4)
    torch.testing.assert_close(
        moments_only("standard").simplify(grey, count=12).sh0, grey.sh0[:12], rtol=1e-6, atol=0
    )
