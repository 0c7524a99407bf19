"""Statistics of a scene."""

import math

import pytest
import torch

from cvtgs import GaussianScene, describe, synthetic
from cvtgs.errors import InvalidSceneError
from pretended_device import pretended_cuda
from scenes import random_scene

NAN = float("nan")


def spheres(opacities: list[float], radii: list[float]) -> GaussianScene:
    count = len(opacities)
    means = torch.zeros(count, 3, dtype=torch.float64)
    means[:, 0] = torch.arange(count)
    return GaussianScene(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1),
        log_scales=torch.tensor(radii, dtype=torch.float64).log()[:, None].repeat(1, 3),
        logit_opacities=torch.logit(torch.tensor(opacities, dtype=torch.float64)),
        sh0=torch.zeros(count, 1, 3, dtype=torch.float64),
        shN=torch.zeros(count, 0, 3, dtype=torch.float64),
    )


def test_statistics_equal_those_by_hand():
    """The masses are pi * (0.05, 0.5, 0.8, 3.6)."""
    info = describe(spheres([0.05, 0.5, 0.2, 0.9], [1.0, 1.0, 2.0, 2.0]))
    assert info.count == 4
    assert info.bounds == ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert info.robust_center == (1.0, 0.0, 0.0)
    assert info.robust_radius == 1.0
    assert info.mass == pytest.approx(4.95 * math.pi)
    assert info.faint_share == 0.25
    assert info.faint_mass_share == pytest.approx(0.05 / 4.95)
    assert info.mass_shares == pytest.approx((3.6 / 4.95, 3.6 / 4.95, 3.6 / 4.95, 4.4 / 4.95))
    assert info.opacity_quantiles[0] == pytest.approx(0.05)
    assert info.opacity_quantiles[-1] == pytest.approx(0.9)
    assert info.dtype == "float64"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 500])
@pytest.mark.slow
def test_statistics_of_any_scene_are_consistent(degree, count):
    info = describe(random_scene(count, degree=degree))
    assert (info.count, info.sh_degree) == (count, degree)
    assert info.invalid_count == 0
    assert info.invalid_rows == {}
    assert list(info.opacity_quantiles) == sorted(info.opacity_quantiles)
    assert list(info.mass_shares) == sorted(info.mass_shares)
    assert 0 <= info.faint_share <= 1
    assert math.isfinite(info.mass)


def test_opacity_quantiles_equal_those_by_hand():
    opacities = [(i + 0.5) / 101 for i in range(101)]
    info = describe(spheres(opacities, [1.0] * 101))
    wanted = [opacities[i] for i in (0, 5, 25, 50, 75, 95, 100)]
    assert info.opacity_quantiles == pytest.approx(wanted)


def test_tags_columns_and_comments_are_listed():
    scene = GaussianScene(
        **random_scene(5).tensors(),
        extras={"label": torch.arange(5)},
        comments=("SplatRenderMode: mip",),
    )
    info = describe(scene)
    assert info.antialiased
    assert info.comments == ("SplatRenderMode: mip",)
    assert info.extra_columns == ("label",)
    assert info.plan.extras.active


def test_invalid_rows_are_counted_and_left_out():
    scene = spheres([0.5, 0.5, 0.5], [1.0, 1.0, 1.0])
    means, quats = scene.means.clone(), scene.quats.clone()
    means[2, 0], quats[2] = NAN, 0.0
    info = describe(scene.with_tensors({"means": means, "quats": quats}, {}))
    assert info.count == 3
    assert info.invalid_count == 1
    assert info.invalid_rows == {"means": 1, "quats": 1}
    assert info.bounds[1] == (1.0, 0.0, 0.0)
    assert info.mass == pytest.approx(math.pi)


def test_shares_are_0_if_the_mass_underflows():
    scene = random_scene(5)
    tiny = scene.with_tensors({"log_scales": scene.log_scales * 0 - 400.0}, {})
    info = describe(tiny)
    assert info.mass == 0.0
    assert info.faint_mass_share == 0.0
    assert info.mass_shares == (0.0, 0.0, 0.0, 0.0)
    assert info.plan.unbounded.figure == 0.0


@pytest.mark.parametrize("count", [0, 3])
def test_no_valid_row_is_an_error(count):
    scene = random_scene(count)
    scene = scene.with_tensors({"means": scene.means * NAN}, {})
    with pytest.raises(InvalidSceneError) as caught:
        describe(scene)
    assert str(caught.value) == f"none of the {count} Gaussians is valid."


def test_figures_that_overflow_can_be_read_back():
    """The squares of such coefficients are infinite in float32."""
    bright = random_scene(50)
    found = describe(bright.with_tensors(shN=torch.full_like(bright.shN, 1e30)))
    assert found.plan.sh.figure == float("inf")
    assert type(found).model_validate_json(found.model_dump_json()) == found


def test_a_device_gives_the_figures_of_the_cpu():
    scene = random_scene(50)
    with pretended_cuda():
        found = describe(scene.to("cuda"))
    assert found.mass_shares == pytest.approx(describe(scene).mass_shares, rel=1e-12)


def test_tensors_that_require_gradients_give_the_same_figures():
    scene = random_scene(100)
    tensors = {name: rows.clone().requires_grad_() for name, rows in scene.tensors().items()}
    assert describe(scene.with_tensors(tensors)) == describe(scene)


def test_figures_do_not_depend_on_the_number_of_threads(two_threads):
    """A part of an operation that torch splits has last bits of its own."""
    scene = synthetic.scene("object", 70_001, sh_degree=0, seed=0)
    two = describe(scene)
    torch.set_num_threads(1)
    assert two.to_json() == describe(scene).to_json()
