"""Blending weights: an image as a matrix times colours, and images with contributions at once."""

import pytest
import torch

import cvtgs
from cvtgs.rendering import blending_weights, contributions, observe, render
from render_cases import around, backends, one_camera
from scenes import random_scene


@backends
def test_painting_a_scene_s_own_colours_gives_its_image(backend):
    scene = random_scene(60, degree=0, dtype=torch.float64)
    camera = one_camera(37, 29)
    colors = (0.5 + 0.28209479177387814 * scene.sh0[:, 0]).clamp_min(0)
    weights = blending_weights(scene, camera, backend=backend)
    image = render(scene, camera, backend="torch").rgb[0]
    assert torch.allclose(weights.paint(colors), image, atol=2e-6)


@backends
def test_products_are_those_of_one_matrix(backend):
    """The matrix, column by column, from images of single Gaussians that are white."""
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


def test_what_lies_behind_a_finished_pixel_has_no_weight():
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
