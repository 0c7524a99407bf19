"""The gsplat backend, with a stand-in for gsplat: dtypes, distances, many images, and errors."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import gsplat_stand_in
from cvtgs.rendering import error_shares, gsplat_backend, observe, torch_backend
from render_cases import around
from scenes import random_scene


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Install the stand-in, and return the numbers of cameras that it has rendered at once."""
    together = []

    def rasterization(**options):
        together.append(len(options["viewmats"]))
        return gsplat_stand_in.rasterization(**options)

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    return together


def images(scene, cameras):
    """Return the images of both backends."""
    backends = gsplat_backend, torch_backend
    return [backend.rasterize(scene, cameras, sh_degree=0).rgb for backend in backends]


@pytest.mark.parametrize("scale", [1e-1, 1e9, 1e12])
def test_scenes_of_any_size_are_drawn(scale):
    scene, cameras = random_scene(20, seed=5), around(2)
    log_scales = scene.log_scales + torch.tensor(scale).log()
    large = scene.with_tensors({"means": scale * scene.means, "log_scales": log_scales}, {})
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] *= scale
    found, wanted = images(large, replace(cameras, viewmats=viewmats))
    assert float(wanted.amax()) > 0.5
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [("sh0", torch.nan), ("sh0", torch.inf), ("sh0", -torch.inf), ("shN", torch.nan)],
)
def test_colors_that_are_not_finite_are_not_drawn(name, value):
    scene, cameras = random_scene(40, degree=1), around(2)
    poisoned = scene.tensors()[name].clone()
    poisoned[::5] = value
    leaf = scene.means.clone().requires_grad_()
    scene = scene.with_tensors({name: poisoned, "means": leaf}, {})
    found, wanted = (
        backend.rasterize(scene, cameras, sh_degree=1)
        for backend in (gsplat_backend, torch_backend)
    )
    assert wanted.rgb.isfinite().all()
    torch.testing.assert_close(found.rgb, wanted.rgb, rtol=0, atol=1e-3)
    torch.testing.assert_close(found.alpha, wanted.alpha, rtol=0, atol=1e-3)
    found.rgb.sum().backward()
    assert leaf.grad.isfinite().all()
    assert not leaf.grad[::5].any()


def test_a_camera_far_away_does_not_blur_the_images_of_others():
    cameras = around(3)
    viewmats = cameras.viewmats.clone()
    viewmats[2, 2, 3] += 1e7
    found, wanted = images(random_scene(20, seed=5), replace(cameras, viewmats=viewmats))
    torch.testing.assert_close(found[:2], wanted[:2], rtol=0, atol=1e-3)


@pytest.mark.parametrize(("pixels", "groups"), [(2 * 37 * 29, [2, 1]), (37 * 29 - 1, [1, 1, 1])])
def test_few_pixels_are_rendered_at_once(installed, monkeypatch, pixels, groups):
    monkeypatch.setattr(gsplat_backend, "PIXELS_TOGETHER", pixels)
    scene, cameras = random_scene(5), around(3)
    gsplat_backend.rasterize(scene, cameras, sh_degree=0)
    list(gsplat_backend.contributions(scene, cameras))
    assert installed == 2 * groups


@pytest.fixture(params=[torch.bfloat16, torch.float64])
def default_dtype(request):
    before = torch.get_default_dtype()
    torch.set_default_dtype(request.param)
    gsplat_backend._failure.cache_clear()
    yield
    gsplat_backend._failure.cache_clear()
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("default_dtype")
def test_the_probe_does_not_depend_on_the_default_dtype():
    assert gsplat_backend._failure("cpu") == ""


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_errors_are_shared_out_as_by_torch(monkeypatch, mode):
    monkeypatch.setattr(gsplat_backend, "require", lambda device: None)
    scene = random_scene(20, degree=1, seed=5)
    views = observe(scene, around(3), backend="torch")
    with mode():
        found = error_shares(scene[:9], views, backend="gsplat")
        none = error_shares(scene[:0], views, backend="gsplat")
    wanted = error_shares(scene[:9], views, backend="torch")
    torch.testing.assert_close(found.clone(), wanted, rtol=1e-3, atol=1e-2)
    assert len(none) == 0


def test_images_of_interleaved_sizes_are_in_the_order_of_the_cameras() -> None:
    cameras = replace(around(4), strides=(1, 2, 2, 1))
    found, wanted = images(random_scene(20, seed=5), cameras)
    assert float((wanted[1] - wanted[2]).abs().amax()) > 0.1
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3)


def test_observed_images_have_depths() -> None:
    scene, camera = random_scene(20, degree=0, seed=5), around(1)
    ((found, _),) = gsplat_backend.observe(scene, camera, sh_degree=0)
    wanted = torch_backend.rasterize(scene, camera, sh_degree=0)
    assert float(wanted.depth.amax()) > 1.0
    torch.testing.assert_close(found.depth, wanted.depth, rtol=1e-3, atol=1e-2)
