"""Contributions and blending weights: sums over images, and how presets use them."""

import math
import re
import warnings

import pytest
import torch

import cvtgs
from baseline_cases import gaussians
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis import analyze
from cvtgs.analysis.analyze import measure_contributions
from cvtgs.cameras import Cameras, look_at
from cvtgs.config import MatchConfig
from cvtgs.edit import Motion, move
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.blind_views import check_seen
from cvtgs.matching import fit_colors
from cvtgs.rendering import blending_weights, contributions, error_shares, observe, render
from cvtgs.synthetic import demo_scene
from cvtgs.views import automatic_views, mixed_views
from render_cases import around, backends, one_camera
from scenes import random_scene


@backends
def test_contributions_are_alpha_times_transmittance_over_all_pixels(backend):
    """An image of one Gaussian alone is its alpha; Gaussians in front dim those behind."""
    scene = gaussians(
        [[0.0, 0, 0], [0.2, 0, 1], [-0.5, 0.1, -1]], opacities=[0.6, 0.9, 0.3], scales=[0.2] * 3
    )
    cameras = one_camera(16, 12)
    alone = [
        cvtgs.render(scene.select(torch.tensor([row])), cameras, backend="torch").alpha[0]
        for row in range(3)
    ]
    through, wanted = torch.ones_like(alone[0]), {}
    for row in (2, 0, 1):  # front to back
        wanted[row] = float((alone[row] * through).sum())
        through = through * (1 - alone[row])
    found = contributions(scene, cameras, backend=backend)
    assert found.tolist() == pytest.approx([wanted[row] for row in range(3)], rel=1e-9)


def test_wrong_numbers_of_cameras_are_refused():
    scene, cameras = random_scene(3), automatic_views(random_scene(30), 2, width=32, height=24)
    with pytest.raises(InvalidArgumentError, match="must hold at least one camera, found none"):
        observe(scene, cameras.select(torch.arange(0)))
    with pytest.raises(InvalidArgumentError, match="camera must be a single camera, found 2"):
        blending_weights(scene, cameras)


@backends
def test_contributions_ignore_colours_and_sum_to_the_alpha_of_images(backend):
    scene = random_scene(50, degree=1, dtype=torch.float64)
    dark = scene.with_tensors({"sh0": scene.sh0 - 100.0}, {})
    cameras = one_camera(16, 12)
    found = contributions(scene, cameras, backend=backend)
    assert torch.equal(found, contributions(dark, cameras, backend=backend))
    alpha = cvtgs.render(scene, cameras, backend="torch").alpha
    assert float(found.sum()) == pytest.approx(float(alpha.sum()), rel=1e-9)


@backends
def test_shares_of_errors_are_weighted_like_the_colours_of_an_image(backend):
    """Relative to the mean error of each image; a channel below 0, drawn as 0, does not matter."""
    scene = random_scene(50, degree=1, dtype=torch.float64)
    colors = scene.sh0.clone()
    colors.view(50, 3)[:10, 1] -= 100.0
    small, cameras = scene.with_tensors(sh0=colors), around(3, 24, 20)
    views = observe(scene, cameras)
    wanted = torch.zeros(50, dtype=torch.float64)
    for camera, truth in zip(cameras.singles(), views.rgb, strict=True):
        image = render(small, camera, backend="torch").rgb[0].clamp(0, 1)
        squares = (image - truth.clamp(0, 1)).square().sum(dim=2, keepdim=True)
        weights = blending_weights(small, camera, backend="torch")
        wanted += weights.collect(squares.expand(-1, -1, 3))[:, 0] / squares.mean()
    found = error_shares(small, views, backend=backend)
    assert found.dtype == torch.float64
    assert found.tolist() == pytest.approx(wanted.tolist(), rel=1e-5, abs=1e-8)
    assert float(found.sum()) > 100.0
    assert float(error_shares(scene, views, backend=views.backend).abs().max()) == 0.0
    with pytest.raises(InvalidArgumentError, match="views must be ObservedViews"):
        error_shares(scene, cameras)


@pytest.mark.slow
@backends
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_errors_are_shared_out_in_modes_without_gradients(backend, mode):
    def shares():
        scene = random_scene(20)
        cameras = automatic_views(scene, 1, width=16, height=16)
        return error_shares(scene[:9], observe(scene, cameras, backend=backend), backend=backend)

    wanted = shares()
    with mode():
        found = shares()
    assert torch.equal(found, wanted)
    assert float(found.sum()) > 0.0


def test_hidden_gaussians_contribute_nothing():
    """Nothing behind an opaque wall contributes, however opaque."""
    shield = [[x / 4, y / 4, -1.0] for x in range(-4, 5) for y in range(-4, 5)]
    back = [[x, y, z + 2] for x, y, z in shield]
    cameras = one_camera(16, 16)
    scene = gaussians(shield + back, opacities=[0.99] * 162, scales=[0.3] * 162)
    seen = contributions(scene, cameras, backend="torch")
    assert float(seen[:81].sum()) > 50 * float(seen[81:].sum())


def test_contributions_need_no_gradients_and_leave_none():
    scene = random_scene(20)
    with torch.no_grad():
        found = contributions(scene, automatic_views(scene, 1, width=16, height=16))
    assert not found.requires_grad
    assert scene.sh0.grad is None


def ball_and_core(count: int = 600) -> cvtgs.GaussianScene:
    """An opaque shell around as many hidden Gaussians."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    core = 0.5 * torch.rand(count, 1, generator=generator) * directions
    places = torch.cat([directions, core]).tolist()
    return gaussians(places, opacities=[0.95] * len(places), scales=[0.08] * len(places))


def test_cells_go_to_visible_regions():
    scene = ball_and_core()
    colors = torch.rand(len(scene), 1, 3, generator=torch.Generator().manual_seed(1))
    scene = scene.with_tensors(
        {"sh0": 4 * colors.double()}, {}
    )  # their contrast lets masses count most
    powers = {"allocation.color": "0", "allocation.mass_power": "0.72"}
    settings = {"merge.network": "false", "cvt.hidden_share": "1", **powers}
    blind = SimplifyConfig.compose(settings=settings)
    seeing = SimplifyConfig.compose(
        settings=settings | {"visibility.views": "6", "visibility.mass_share": "0.1"}
    )
    inside = []
    for config in (blind, seeing):
        small, report = Simplifier(config=config, device="cpu").run(scene, 0.1)
        inside.append(int((small.means.norm(dim=1) < 0.6).sum()))
        assert len(small) == 120
    assert [stage.stage for stage in report.stages][:3] == ["check", "plan", "visibility"]
    assert inside[1] < 0.7 * inside[0]


def test_given_cameras_decide_what_is_seen():
    """Only one half of a plane is in the image, and most cells lie there."""
    steps = torch.linspace(-2, 2, 30)
    places = [[float(x), float(y), 0.0] for x in steps for y in steps]
    scene = gaussians(places, opacities=[0.9] * 900, scales=[0.06] * 900)
    eye = torch.tensor([[1.2, 0.0, -3.0]])
    cameras = Cameras(
        viewmats=look_at(eye, torch.tensor([[1.2, 0.0, 0.0]]), torch.tensor([0.0, -1.0, 0.0])),
        Ks=torch.tensor([[[48.0, 0, 16], [0, 48.0, 16], [0, 0, 1]]]),
        width=32,
        height=32,
    )
    config = SimplifyConfig.compose(
        settings={
            "merge.network": "false",
            "visibility.views": "4",
            "visibility.mass_share": "0.5",
            "cvt.area_power": "1",
            "allocation.oversampling": "1",
            "allocation.reassign": "false",
        }
    )
    simplifier = Simplifier(config=config, device="cpu")
    small = simplifier.simplify(scene, 0.1, cameras=cameras)
    assert int((small.means[:, 0] > 0).sum()) > 60
    even = simplifier.simplify(scene, 0.1, cameras=cameras.select(torch.tensor([0, 0])))
    assert torch.equal(even.means, small.means)


def test_images_that_show_nothing_change_nothing():
    scene = random_scene(200)
    away = Cameras(
        viewmats=look_at(
            torch.tensor([[50.0, 0, 0]]), torch.tensor([[90.0, 0, 0]]), torch.tensor([0.0, -1, 0])
        ),
        Ks=torch.tensor([[[30.0, 0, 16], [0, 30.0, 16], [0, 0, 1]]]),
        width=32,
        height=32,
    )
    seeing = SimplifyConfig.compose(settings={"visibility.views": "4"})
    estimated = analyze(scene, seeing)
    with pytest.warns(UserWarning, match="images of the scene show nothing"):
        measured = measure_contributions(scene, estimated, seeing, cameras=away)
    assert torch.equal(measured.apparent_areas, estimated.apparent_areas)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "is_hidden"), [(1.0, False), (0.1, False), (3e-3, True)])
def test_a_scene_too_small_for_the_near_plane_is_warned_about(scale, is_hidden):
    scene = move(demo_scene(1000, seed=1), Motion(scale=scale))
    config = SimplifyConfig.compose(settings={"visibility.views": "4", "visibility.size": "32"})
    analysis = analyze(scene, config)
    few = mixed_views(scene, 4, size=32)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        measure_contributions(scene, analysis, config)
        measure_contributions(scene, analysis, config, cameras=few)  # checked elsewhere
        check_seen(scene, few, name="full")
    found = [re.sub(r"\d+%", "n%", str(one.message)) for one in caught]
    text = "lack n% of the Gaussians before their cameras: renderers draw nothing nearer than"
    wanted = [f"images of {name} {text} 0.01 units; scale it up." for name in ("the scene", "full")]
    assert found == (wanted if is_hidden else [])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["draft", "fast", "matched", "high"])
def test_every_preset_gives_the_exact_count(name):
    settings = {"refine.size": "32", "visibility.size": "32", "refine.heldout": "2"}
    if name in ("matched", "high"):
        settings |= {"refine.steps": "2"}
    config = SimplifyConfig.compose(preset=name, settings=settings)
    scene = cvtgs.synthetic.scene("object", 700, sh_degree=1, seed=1)
    small, report = Simplifier(config=config, device="cpu").run(scene, 0.1)
    assert len(small) == 70
    names = [stage.stage for stage in report.stages]
    assert ("refine" in names) == (name in ("matched", "high"))
    assert ("visibility" in names) == ("network" in names) == (name not in ("draft", "fast"))
    assert ("match" in names) == (name in ("matched", "high"))
    assert report.checkpoint == ("none" if name in ("draft", "fast") else "standard")


@pytest.mark.long
@backends
def test_painting_a_scene_s_own_colours_gives_its_image(backend):
    scene = random_scene(60, degree=0, dtype=torch.float64)
    camera = one_camera(37, 29)
    colors = (0.5 + 0.28209479177387814 * scene.sh0[:, 0]).clamp_min(0)
    weights = blending_weights(scene, camera, backend=backend)
    image = render(scene, camera, backend="torch").rgb[0]
    assert torch.allclose(weights.paint(colors), image, atol=2e-6)


@backends
@pytest.mark.slow
def test_products_equal_those_of_the_weight_matrix(backend):
    """The columns of the matrix are images of single white Gaussians."""
    scene, camera = random_scene(12, degree=0, dtype=torch.float64), one_camera(20, 18)
    weights = blending_weights(scene, camera, backend=backend)
    columns = []
    for row in range(12):
        white = torch.zeros(12, 3, dtype=torch.float64)
        white[row] = 1.0
        columns.append(weights.paint(white)[..., 0].flatten())
    matrix = torch.stack(columns, dim=1)
    generator = torch.Generator().manual_seed(1)
    colors = torch.rand(12, 3, generator=generator, dtype=torch.float64)
    image = torch.rand(18, 20, 3, generator=generator, dtype=torch.float64)
    collected = matrix.T @ image.reshape(-1, 3)
    assert torch.allclose(weights.collect(image), collected, rtol=1e-5, atol=1e-5)
    assert torch.allclose(weights.normal(colors), matrix.T @ matrix @ colors, rtol=1e-5, atol=1e-5)
    powers = torch.stack([matrix.sum(dim=0), matrix.square().sum(dim=0)], dim=1)
    assert torch.allclose(weights.powers().double(), powers, rtol=1e-5, atol=1e-5)
    assert torch.allclose(powers[:, 0], contributions(scene, camera), rtol=1e-5, atol=1e-6)


def test_gaussians_behind_a_finished_pixel_have_no_weight():
    """Memory that was used before must not show through where nothing was written."""
    scene = cvtgs.synthetic.scene("courtyard", 3000, sh_degree=0, seed=0)
    scene = scene.with_tensors({"logit_opacities": scene.logit_opacities + 4.0}, {})
    for camera in around(3, 64, 48).singles():
        junk = [torch.full((500_000,), 1e6) for _ in range(4)]
        del junk
        weights = blending_weights(scene, camera)
        alpha = weights.paint(torch.ones(len(scene), 3))[..., 0]
        assert torch.allclose(alpha, render(scene, camera).alpha[0], atol=1e-5)


@backends
@pytest.mark.parametrize("degree", [0, 2])
def test_observed_views_are_images_and_contributions(backend, degree):
    scene, cameras = random_scene(80, degree=degree), around(3)
    views = observe(scene, cameras, backend=backend)
    images = render(scene, cameras, backend=backend)
    assert torch.equal(views.rgb, images.rgb)
    assert torch.equal(views.alpha, images.alpha)
    assert torch.equal(views.contributions, contributions(scene, cameras, backend=backend))
    assert not views.rgb.requires_grad


@backends
def test_colours_and_images_of_other_sizes_are_refused(backend):
    scene = random_scene(50)
    weights = blending_weights(scene, around(1), backend=backend)
    image = weights.paint(torch.ones(50, 3))
    height, width = image.shape[:2]
    for colors in (torch.ones(50, 1), torch.ones(49, 3), torch.ones(51, 3), torch.ones(3)):
        for product in (weights.paint, weights.normal):
            with pytest.raises(InvalidArgumentError, match=r"^colors must .* of shape \(50, 3\)"):
                product(colors)
    for wrong in (image[:, 1:], image[1:], image[..., :1], image.reshape(-1, 3)):
        shape = rf"of shape \({height}, {width}, 3\)"
        with pytest.raises(InvalidArgumentError, match=f"^image must .* {shape}"):
            weights.collect(wrong)


@pytest.mark.slow
@backends
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_take_colours_and_images_of_any_dtype(backend, dtype):
    scene, camera = random_scene(12, degree=0, dtype=torch.float64), one_camera(20, 18)
    weights = blending_weights(scene, camera, backend=backend)
    colors = torch.rand(12, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
    image = weights.paint(colors)
    assert torch.allclose(image.double(), weights.paint(colors.double()).double(), atol=1e-6)
    collected, normal = weights.collect(image.to(dtype)), weights.normal(colors)
    assert torch.allclose(collected.double(), normal.double(), atol=1e-4)


@backends
def test_gaussians_with_invalid_bands_paint_nothing(backend):
    """Contributions and weights, too, which are of the constant band alone."""
    scene, cameras = random_scene(60, degree=1), around(1)
    shN = scene.shN.clone()  # noqa: N806
    shN[::2, 1, 0] = math.nan
    scene = scene.with_tensors(shN=shN)
    drawn = render(scene, cameras, backend=backend).alpha.sum().double()
    assert float(drawn) > 1.0
    for found in (
        contributions(scene, cameras, backend=backend),
        observe(scene, cameras, backend=backend).contributions,
        blending_weights(scene, cameras, backend=backend).powers()[:, 0].double(),
    ):
        assert not bool(found[::2].any())
        torch.testing.assert_close(found.sum(), drawn, rtol=1e-4, atol=0)
    config = MatchConfig(color_iterations=3)
    fitted = fit_colors(scene[1:6], observe(scene, cameras, backend=backend), config=config)
    assert bool(fitted.sh0.isfinite().all())
