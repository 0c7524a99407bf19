"""Merged cells against the scalar oracle, and conserved quantities."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.special import spence

import oracles
from cvtgs import GaussianScene
from cvtgs.cells import Partition, gaussian_moments, merge_cells
from cvtgs.cells.merge import (
    FULL_DEPTH,
    depth_from_integrated,
    gather_members,
    integrated_depth,
    mean_and_covariance,
    merged_depth,
)
from cvtgs.cells.moments import mass_unit
from cvtgs.config import MergeConfig
from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.tags import ANTIALIASED
from scenes import assert_same_gaussians, covariances_of, moved, oracle_rows, random_scene

INF = float("inf")
RULES = {
    "paper": MergeConfig(area_power=0.0, opacity="union"),
    "between": MergeConfig(area_power=0.5, opacity="saturating"),
    "standard": MergeConfig(area_power=1.0, opacity="saturating"),
}
each_rule = pytest.mark.parametrize("config", RULES.values(), ids=RULES)


def random_cells(total: int, count: int, seed: int = 0) -> Partition:
    labels = torch.randint(0, count, (total,), generator=torch.Generator().manual_seed(seed))
    labels[: 2 * count] = torch.arange(2 * count) % count
    return Partition.from_labels(labels, count)


def merged(scene: GaussianScene, cells: Partition, config: MergeConfig) -> GaussianScene:
    return merge_cells(scene, cells, config=config)


def assert_equals_oracle(scene, cells, config, *, tolerance: float) -> None:
    small = merged(scene, cells, config)
    matrices = covariances_of(small)
    offsets, order = cells.offsets.tolist(), cells.order.tolist()
    for cell in range(len(cells)):
        rows = order[offsets[cell] : offsets[cell + 1]]
        wanted = oracles.merge(
            oracle_rows(scene, rows), area_power=config.area_power, opacity=config.opacity
        )
        size = math.sqrt(float(wanted.covariance.max()))
        assert small.means[cell].tolist() == pytest.approx(wanted.mean, abs=tolerance * size)
        difference = (matrices[cell] - torch.from_numpy(wanted.covariance)).abs().amax()
        assert float(difference) < tolerance * size * size
        assert small.opacities[cell].item() == pytest.approx(wanted.opacity, abs=tolerance)
        torch.testing.assert_close(
            small.sh[cell].double(), torch.from_numpy(wanted.sh), rtol=tolerance, atol=tolerance
        )


@pytest.mark.slow
@each_rule
@pytest.mark.parametrize(("total", "count"), [(2, 1), (50, 1), (200, 20), (300, 150)])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-5), (torch.float64, 1e-9)])
def test_cells_equal_the_oracle(total, count, dtype, tolerance, config):
    scene = random_scene(total, seed=count, degree=2, dtype=dtype)
    assert_equals_oracle(scene, random_cells(total, count), config, tolerance=tolerance)


@each_rule
def test_thin_and_faint_and_opaque_members_equal_the_oracle(config):
    scene = random_scene(60, dtype=torch.float64)
    log_scales, logits = scene.log_scales.clone(), scene.logit_opacities.clone()
    log_scales[::3, 2] -= 12.0
    logits[::4], logits[1::4] = -30.0, 30.0
    scene = scene.with_tensors({"log_scales": log_scales, "logit_opacities": logits}, {})
    assert_equals_oracle(scene, random_cells(60, 9), config, tolerance=1e-8)


@each_rule
def test_moments_of_the_mixture_are_conserved(config):
    """First and second raw moments of each cell, summed over the whole scene by weight."""
    scene, cells = random_scene(400, dtype=torch.float64), random_cells(400, 30)
    members = gather_members(scene, cells)
    all_weights = members.weights(config.area_power)
    means, matrices = mean_and_covariance(members, all_weights)
    second = parameters.build_covariances(members.scales, members.quats)
    second = second + members.means[:, :, None] * members.means[:, None, :]
    for cell in range(30):
        rows = slice(int(cells.offsets[cell]), int(cells.offsets[cell + 1]))
        weights = all_weights[rows]
        assert float(weights.sum()) == pytest.approx(1.0)
        torch.testing.assert_close(means[cell], (weights[:, None] * members.means[rows]).sum(0))
        torch.testing.assert_close(
            matrices[cell] + means[cell][:, None] * means[cell],
            (weights[:, None, None] * second[rows]).sum(0),
        )


@pytest.mark.parametrize("shift", [-7.0, 0.0])
def test_saturating_conserves_the_sum_of_depth_over_an_image(shift: float):
    """By quadrature of -log(1 - a g) over the image, where no cell is opaque."""
    scene, cells = random_scene(400, dtype=torch.float64), random_cells(400, 150)
    scene = scene.with_tensors({"logit_opacities": 0.3 * scene.logit_opacities + shift}, {})
    small = merged(scene, cells, RULES["standard"])

    def image_sums(opacities: torch.Tensor, areas: torch.Tensor) -> torch.Tensor:
        gaussian = (torch.arange(20_000) + 0.5) / 20_000  # g has a uniform density dx = dg / g
        through = -torch.log1p(-opacities[:, None] * gaussian) / gaussian
        return through.mean(1) * areas

    wanted = torch.stack([
        part.sum()
        for part in image_sums(scene.opacities, scene.areas)[cells.order].split(
            cells.offsets.diff().tolist()
        )
    ])  # fmt: skip
    areas = parameters.mean_projected_area(small.scales)
    clear = (small.opacities < 0.989) & (cells.offsets.diff() > 1)
    assert int(clear.sum()) > 50
    found = image_sums(small.opacities, areas)
    torch.testing.assert_close(found[clear], wanted[clear], rtol=1e-4, atol=0)
    opaque = (wanted >= FULL_DEPTH * areas) & (cells.offsets.diff() > 1)
    torch.testing.assert_close(small.opacities[opaque], torch.full_like(areas[opaque], 0.99))


def test_saturating_never_gains_mass_and_never_exceeds_one():
    scene, cells = random_scene(500, dtype=torch.float64, spread=0.02), random_cells(500, 10)
    small = merged(scene, cells, RULES["standard"])
    assert bool((small.opacities < 1).all())
    areas = parameters.mean_projected_area(small.scales)
    assert bool((small.masses <= areas).all())


def test_saturating_averages_two_depths_for_antialiased_scenes():
    """The square root of both depths' product, which is computed here member by member."""
    scene, cells = random_scene(400, dtype=torch.float64), random_cells(400, 150)
    plain = merged(scene, cells, RULES["standard"])
    tagged = merged(replace(scene, comments=(ANTIALIASED.text,)), cells, RULES["standard"])
    opaque = -math.log(0.01)
    member_depths = -torch.log1p(-scene.opacities)
    images = (member_depths.clamp_max(opaque) * scene.areas)[cells.order]
    areas = parameters.mean_projected_area(plain.scales)
    sums = torch.stack([part.sum() for part in images.split(cells.offsets.diff().tolist())])
    plain_depths = -torch.log1p(-plain.opacities)
    wanted = torch.sqrt(plain_depths * (sums / areas).clamp_max(opaque))
    several = cells.offsets.diff() > 1
    found = -torch.log1p(-tagged.opacities)
    torch.testing.assert_close(found[several], wanted[several])
    assert float((found - plain_depths)[several].amax()) > 0.1
    for name in ("means", "log_scales", "quats", "sh0"):
        torch.testing.assert_close(getattr(tagged, name), getattr(plain, name), rtol=0, atol=0)


def test_union_adds_depths():
    scene, cells = random_scene(100, dtype=torch.float64), random_cells(100, 40)
    members = gather_members(scene, cells)
    depths = merged_depth(members, torch.ones(40).double(), rule="union")
    for cell in range(40):
        rows = cells.order[int(cells.offsets[cell]) : int(cells.offsets[cell + 1])]
        through = (1 - scene.opacities[rows]).prod()
        assert float(torch.exp(-depths[cell])) == pytest.approx(float(through))


@each_rule
@pytest.mark.parametrize(
    "motion",
    [
        {"quat": (0.3, -0.5, 0.8, 0.1), "shift": (3.0, -2.0, 5.0)},
        {"scale": 1e3},
        {"scale": 1e-3, "quat": (0.0, 1.0, 0.0, 0.0)},
    ],
    ids=["rigid", "kilo", "milli"],
)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_merge_moves_with_the_scene(degree, motion, config):
    """With given cells, a merge is equivariant under every rigid motion and change of unit."""
    scene, cells = random_scene(80, degree=degree, dtype=torch.float64), random_cells(80, 12)
    assert_same_gaussians(
        merged(moved(scene, **motion), cells, config),
        moved(merged(scene, cells, config), **motion),
        tolerance=1e-7,
    )


@each_rule
def test_order_of_members_does_not_matter(config):
    scene, cells = random_scene(200, dtype=torch.float64), random_cells(200, 12)
    shuffle = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    labels = torch.empty(200, dtype=torch.int64)
    labels[cells.order] = torch.repeat_interleave(torch.arange(12), cells.counts)
    other = Partition.from_labels(labels[shuffle], 12)
    assert_same_gaussians(
        merged(scene, cells, config), merged(scene.select(shuffle), other, config), tolerance=1e-9
    )


def test_a_few_giants_do_not_set_the_unit_of_masses():
    assert float(mass_unit(torch.tensor([1.0, 1.0, 7.0]), 3.0)) == 3.0
    assert float(mass_unit(torch.ones(3), 1e60)) == 1e6


def test_integrated_depth_is_the_dilogarithm():
    logits = torch.linspace(-13.8, 13.8, 1001, dtype=torch.float64)
    centres = parameters.optical_depth_from_logit(logits)
    values = integrated_depth(centres)
    wanted = torch.from_numpy(spence(torch.sigmoid(-logits).numpy()))
    torch.testing.assert_close(values, wanted, rtol=1e-9, atol=0)
    torch.testing.assert_close(depth_from_integrated(values), centres, rtol=1e-9, atol=1e-9)


def test_integrated_depths_above_the_largest_are_clamped():
    values = torch.tensor([0.0, 1e-300, 1.6449341, 2.0, 1e30, INF], dtype=torch.float64)
    centres = depth_from_integrated(values)
    assert bool((centres >= 0).all())
    assert bool((centres.diff() >= 0).all())
    assert centres[:2].tolist() == pytest.approx([0.0, 1e-300], abs=1e-300)
    assert centres[3:].tolist() == [parameters.LOGIT_LIMIT] * 3


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
@pytest.mark.parametrize("function", [integrated_depth, depth_from_integrated])
def test_shape_and_dtype_of_depths_are_kept(function, shape):
    for dtype in (torch.float32, torch.float64):
        result = function(torch.full(shape, 0.25, dtype=dtype))
        assert (result.shape, result.dtype) == (shape, dtype)


def test_colours_of_moments_are_from_black_to_one_and_a_half():
    scene = random_scene(2, degree=0)
    scene = scene.with_tensors({"sh0": torch.tensor([[[-9.0] * 3], [[9.0] * 3]])}, {})
    frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)
    ones = torch.ones(2)
    found = gaussian_moments(scene, torch.arange(2), frame, masses=ones, apparent_masses=ones)
    assert found.colors.T.tolist() == [[0.0] * 3, [1.5] * 3]


def test_masses_are_in_units_of_their_mean_and_above_zero():
    """A group of members without mass still has a mean of these."""
    scene, frame = random_scene(3), RobustFrame(center=torch.zeros(3).double(), radius=1.0)
    masses = torch.tensor([0.0, 2.0, 4.0])
    found = gaussian_moments(scene, torch.arange(3), frame, masses=masses, apparent_masses=masses)
    assert found.masses.tolist() == [1e-12, 1.0, 2.0]
    assert found.apparent_masses.tolist() == [0.0, 1.0, 2.0]


def test_what_lies_on_one_another_is_opaque_to_99_percent_at_most():
    three = random_scene(1, dtype=torch.float64).select(torch.tensor([0, 0, 0]))
    three = three.with_tensors(logit_opacities=torch.full((3,), 9.0).double())
    cells = Partition.from_labels(torch.zeros(3, dtype=torch.int64), 1)
    assert merged(three, cells, RULES["standard"]).opacities.tolist() == pytest.approx([0.99])
