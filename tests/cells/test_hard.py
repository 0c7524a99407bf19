"""Merges that are numerically hard."""

import pytest
import torch

from cvtgs import GaussianScene
from cvtgs.cells import Partition, merge_cells
from cvtgs.cells.merge import normalized_weights
from cvtgs.config import SimplifyConfig
from scenes import assert_standard, covariances_of, moved, random_scene

CONFIGS = {name: SimplifyConfig.from_preset(name).merge for name in ("standard", "paper")}
each_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
INF = float("inf")


def merged(scene: GaussianScene, labels: torch.Tensor, config) -> GaussianScene:
    cells = Partition.from_labels(labels, int(labels.amax()) + 1)
    return merge_cells(scene, cells, config=config)


def pairs(count: int) -> torch.Tensor:
    return torch.arange(count) // 2


def changed(scene: GaussianScene, **tensors: torch.Tensor) -> GaussianScene:
    cast = {name: tensor.to(scene.dtype) for name, tensor in tensors.items()}
    return scene.with_tensors(cast, scene.extras)


@each_config
@dtypes
@pytest.mark.parametrize("exponent", [-40.0, -20.0, 20.0])
def test_extreme_scales(exponent, dtype, config):
    scene = random_scene(40, dtype=dtype)
    scene = changed(scene, log_scales=scene.log_scales * 0 + exponent)
    small = merged(scene, pairs(40), config)
    assert_standard(small)
    smallest = -13.9 + small.log_scales.amax(dim=1)  # scales are floored at 1e-6 of the largest
    assert bool((small.log_scales.amin(dim=1) >= smallest).all())


@each_config
@dtypes
def test_tiny_beside_huge(dtype, config):
    scene = random_scene(40, dtype=dtype)
    exponents = torch.where(torch.arange(40) % 2 == 0, -40.0, 20.0)
    small = merged(changed(scene, log_scales=exponents[:, None].expand(40, 3)), pairs(40), config)
    assert_standard(small)
    assert bool((small.log_scales.amax(dim=1) > 14).all())


@each_config
@dtypes
def test_coincident_members_and_needles_and_pancakes(dtype, config):
    scene = random_scene(40, dtype=dtype)
    log_scales = scene.log_scales.clone()
    log_scales[:20, 1:], log_scales[20:, 2] = -14.0, -20.0
    small = merged(changed(scene, means=scene.means * 0, log_scales=log_scales), pairs(40), config)
    assert_standard(small)
    assert not bool(small.means.any())


@each_config
@dtypes
def test_extreme_opacities(dtype, config):
    scene = random_scene(40, dtype=dtype)
    logits = torch.tensor([INF, -INF, 700.0, -700.0, INF, INF, -INF, -INF, -4.0, -4.0]).repeat(4)
    assert_standard(merged(changed(scene, logit_opacities=logits), pairs(40), config))


@each_config
def test_a_transparent_member_does_not_move_an_opaque_one(config):
    scene = random_scene(2, dtype=torch.float64)
    logits = torch.tensor([-INF, INF])
    scene = changed(scene, logit_opacities=logits, log_scales=scene.log_scales * 0 - 2.0)
    small = merged(scene, torch.zeros(2, dtype=torch.int64), config)
    torch.testing.assert_close(small.means[0], scene.means[1], rtol=0, atol=1e-5)
    torch.testing.assert_close(small.sh[0], scene.sh[1], rtol=0, atol=1e-5)


@each_config
@dtypes
def test_quaternions_of_any_length_and_sign(dtype, config):
    scene = random_scene(40, dtype=dtype)
    factors = torch.tensor([1e-30, -1.0, 1e30, 1e-3]).repeat(10).to(dtype)
    plain = merged(scene, pairs(40), config)
    scaled = merged(changed(scene, quats=scene.quats * factors[:, None]), pairs(40), config)
    assert_standard(scaled)
    torch.testing.assert_close(covariances_of(scaled), covariances_of(plain), rtol=1e-4, atol=1e-6)


@each_config
@dtypes
@pytest.mark.parametrize("far", [1e6, 1e18])
def test_two_clusters_far_apart(dtype, far, config):
    scene = random_scene(40, dtype=dtype)
    means = scene.means.clone()
    means[::2] += far
    small = merged(changed(scene, means=means), pairs(40), config)
    assert_standard(small)
    assert bool((small.means.amax(dim=1) <= far * (1 + 1e-6)).all())


@each_config
def test_detail_far_from_the_origin_is_kept(config):
    scene = random_scene(60, dtype=torch.float64, spread=1e-2, size=1e-3)
    labels = torch.arange(60) // 5
    near = merged(scene, labels, config)
    far = merged(moved(scene, shift=(1e6, -1e6, 1e6)), labels, config)
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    torch.testing.assert_close(far.means - shift, near.means, rtol=0, atol=1e-9)
    torch.testing.assert_close(far.scales, near.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(far.opacities, near.opacities, rtol=1e-5, atol=0)


@each_config
@dtypes
def test_a_cell_of_a_hundred_thousand_beside_cells_of_one(dtype, config):
    total = 100_010
    scene = random_scene(total, degree=0, dtype=dtype)
    labels = torch.cat([torch.zeros(100_000, dtype=torch.int64), torch.arange(1, 11)])
    small = merged(scene, labels, config)
    large = small.select(torch.tensor([0]))
    assert_standard(large)
    assert torch.equal(small.means[1:], scene.means[100_000:])
    raw = scene.opacities.double() * scene.areas**config.area_power
    shares = raw[:100_000] / raw[:100_000].sum()
    wanted = (shares[:, None] * scene.means[:100_000].double()).sum(dim=0)
    torch.testing.assert_close(large.means[0].double(), wanted, rtol=0, atol=1e-6)


@each_config
@dtypes
def test_huge_colours(dtype, config):
    scene = random_scene(40, degree=3, dtype=dtype)
    small = merged(changed(scene, sh0=1e4 * scene.sh0, shN=1e30 * scene.shN), pairs(40), config)
    assert_standard(small)
    assert float(small.sh0.amax()) <= float(1e4 * scene.sh0.amax()) * (1 + 1e-6)


@dtypes
def test_members_with_underflowing_masses_weigh_the_same(dtype):
    """exp(-400)^2 is below the smallest float64."""
    scene = random_scene(4, dtype=dtype)
    scene = changed(scene, log_scales=scene.log_scales * 0 - 400.0)
    assert not bool(scene.masses.any())
    small = merged(scene, torch.zeros(4, dtype=torch.int64), CONFIGS["standard"])
    assert_standard(small)
    torch.testing.assert_close(small.means[0], scene.means.mean(dim=0), rtol=1e-5, atol=1e-6)


def test_weights_of_zero_become_equal_shares():
    weights = torch.tensor([0.0, 0.0, 1.0, 3.0, 5e-324, 5e-324], dtype=torch.float64)
    shares = normalized_weights(
        weights, torch.tensor([0, 2, 4, 6]), torch.tensor([0, 0, 1, 1, 2, 2])
    )
    assert shares.tolist() == pytest.approx([0.5, 0.5, 0.25, 0.75, 0.5, 0.5])


def test_gradients():
    weights = torch.rand(5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weights.requires_grad_()
    offsets, cells = torch.tensor([0, 2, 5]), torch.tensor([0, 0, 1, 1, 1])
    assert torch.autograd.gradcheck(lambda w: normalized_weights(w, offsets, cells), (weights,))
