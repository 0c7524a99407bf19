"""Images, by every backend that is installed: against the oracle, hard cases, properties."""

import math
from dataclasses import replace
from importlib import import_module

import pytest
import torch

import cvtgs.synthetic
from cvtgs.rendering import render
from cvtgs.rendering.torch_backend import TILE
from render_cases import (
    BACKENDS,
    MIP,
    around,
    assert_oracle,
    backends,
    dtypes,
    scene_of,
    straight,
)
from scenes import random_scene

# Against the oracle


SLOW = pytest.mark.slow
double_or_slow = pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=SLOW)]
)


@backends
@double_or_slow
@pytest.mark.parametrize("degree", [*(pytest.param(n, marks=SLOW) for n in (0, 1, 2)), 3])
@pytest.mark.parametrize("comments", [(), MIP], ids=["plain", "mip"])
def test_random_scenes(backend, dtype, degree, comments):
    scene = random_scene(25, seed=degree, degree=degree, dtype=dtype, size=0.2)
    scene = replace(scene, comments=comments)
    assert_oracle(
        scene, around(1, 23, 19, 22.0), backend, atol=1e-4 if dtype == torch.float32 else 1e-9
    )


HARD = {
    "nearly at the near plane": ((0.001, 0, 0.0101), (0.001, 0.002, 0.001), 0.7, (1.0, 0.5, 0)),
    "before the near plane": ((0, 0, 0.0099), (0.001, 0.001, 0.001), 0.7, (1.0, 0.5, 0)),
    "behind the camera": ((0, 0, -1), (0.5, 0.5, 0.5), 0.7, (1.0, 0.5, 0)),
    "huge": ((3, 1, 5), (1e4, 1e4, 1e4), 0.5, (1.0, 0.5, 0)),
    "tiny": ((0, 0, 2), (1e-9, 1e-9, 1e-9), 0.5, (1.0, 0.5, 0)),
    "needle": ((0, 0, 2), (3.0, 1e-6, 1e-6), 0.9, (1.0, 0.5, 0), (0.924, 0, 0, 0.383)),
    "long needle": ((0, 0, 2), (1e3, 1e-4, 1e-4), 0.9, (1.0, 0.5, 0), (0.9, 0.01, 0, 0.4)),
    "needle along the view": ((0.3, 0, 2), (1e-4, 1e-4, 1.0), 0.9, (1.0, 0.5, 0)),
    "pancake": ((0, 0, 2), (0.5, 0.5, 1e-7), 0.9, (1.0, 0.5, 0), (0.9, 0.3, 0.1, 0)),
    "pancake on edge": ((0, 0, 2), (0.5, 1e-7, 0.5), 0.9, (1.0, 0.5, 0)),
    "far to the side": ((30, 0, 2), (4.0, 4.0, 4.0), 0.9, (1.0, 0.5, 0)),
    "far away": ((0, 0, 1e6), (1.0, 1.0, 1.0), 0.9, (1.0, 0.5, 0)),
    "faint": ((0, 0, 2), (0.2, 0.2, 0.2), 0.0041, (1.0, 0.5, 0)),
    "colour below 0": ((0, 0, 2), (0.2, 0.2, 0.2), 0.9, (-1.0, 0.5, 3.0)),
}


@backends
@double_or_slow
@pytest.mark.parametrize("row", HARD.values(), ids=HARD)
@pytest.mark.parametrize(
    "comments", [pytest.param((), id="plain"), pytest.param(MIP, id="mip", marks=SLOW)]
)
def test_hard_gaussians(backend, dtype, row, comments):
    behind = ((0, 0, 8.0), (0.8, 1.5, 1.0), 0.6, (0, 0, 1.0))
    scene = scene_of(row, behind, dtype=dtype, comments=comments)
    assert_oracle(scene, straight(), backend, atol=1e-4 if dtype == torch.float32 else 1e-7)


@backends
@dtypes
def test_hard_gaussians_have_finite_gradients(backend, dtype):
    rows = [row if len(row) > 4 else (*row, (1.0, 0, 0, 0)) for row in HARD.values()]
    for comments in ((), MIP):
        scene = scene_of(*rows, dtype=dtype, comments=comments)
        extreme = torch.tensor([60.0, -200.0], dtype=dtype)
        scales = torch.cat([scene.log_scales[:-2], extreme[:, None].expand(2, 3)])
        logits = torch.cat([scene.logit_opacities[:-2], extreme.sign() * math.inf])
        changed = {"log_scales": scales, "logit_opacities": logits}
        tensors = {
            name: tensor.clone().requires_grad_()
            for name, tensor in (scene.tensors() | changed).items()
        }
        leaves = scene.with_tensors(tensors, {})
        found = render(leaves, straight(), backend=backend, depth=True)
        (found.rgb.sum() + found.alpha.sum() + found.depth.sum()).backward()
        grads = [tensor.grad for tensor in tensors.values() if tensor.numel()]
        assert all(grad.isfinite().all() for grad in grads)


@backends
@dtypes
@pytest.mark.parametrize("log_scale", [20.0, 44.0, 80.0, 88.7])
def test_a_gaussian_of_any_valid_scale_is_drawn(backend, dtype, log_scale):
    scene = scene_of(((0.3, 0, 5), (1.0, 1.0, 1.0), 0.5, (1.0, 0.5, 0)), dtype=dtype)
    scene = scene.with_tensors({"log_scales": torch.full_like(scene.log_scales, log_scale)})
    alpha = render(scene, straight(), backend=backend).alpha
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.5))


@backends
@pytest.mark.parametrize("log_scale", [50.0, 80.0])
def test_a_huge_gaussian_before_others_is_as_in_float64(backend, log_scale):
    """It is turned, so that its ellipse has no axis along the image."""
    scene = random_scene(60, degree=0, size=0.1)
    log_scales = scene.log_scales.clone()
    log_scales[3] = torch.tensor([log_scale, log_scale - 2, log_scale - 1])
    scene = scene.with_tensors({"log_scales": log_scales}, {})
    double = scene.with_tensors({k: v.double() for k, v in scene.tensors().items()}, {})
    found = render(scene, around(), backend=backend).rgb
    wanted = render(double, around(), backend="torch").rgb.float()
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)


@backends
def test_rows_that_are_not_finite_are_not_rendered(backend):
    good = random_scene(10, degree=1, size=0.3)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        for bad in (math.nan, math.inf):
            if (name, bad) == ("logit_opacities", math.inf):
                continue
            tensors = {key: tensor.clone() for key, tensor in good.tensors().items()}
            tensors[name][3] = bad
            wanted = render(good.select(torch.arange(10) != 3), around(1), backend=backend)
            found = render(good.with_tensors(tensors, {}), around(1), backend=backend)
            assert torch.equal(found.rgb, wanted.rgb)


# Properties


@backends
def test_images_do_not_depend_on_tiles(backend, monkeypatch):
    scene = random_scene(200, degree=1, dtype=torch.float64, size=0.15)
    wanted = render(scene, around(), backend=backend)
    for side in (5, 13, 64):
        if backend == "torch":
            monkeypatch.setitem(TILE, "cpu", side)
        else:
            monkeypatch.setattr(import_module("cvtgs.rendering.numba_backend"), "SIDE", side)
        found = render(scene, around(), backend=backend)
        torch.testing.assert_close(found.rgb, wanted.rgb, rtol=0, atol=1e-12)
        torch.testing.assert_close(found.alpha, wanted.alpha, rtol=0, atol=1e-12)


@backends
def test_two_halves_are_the_whole(backend):
    """Gaussians astride the cut; none so far out that its Jacobian is clamped in one half."""
    scene = random_scene(3000, degree=1, dtype=torch.float64, spread=0.5)
    scene = scene.with_tensors({"log_scales": torch.full((3000, 3), math.log(0.03)).double()}, {})
    whole = around(1, 38, 29, 70.0)
    shift = torch.tensor([[0.0, 0, 19], [0, 0, 0], [0, 0, 0]]).double()
    left = replace(whole, width=19)
    right = replace(whole, Ks=whole.Ks - shift, width=19)
    halves = [render(scene, half, backend=backend).rgb for half in (left, right)]
    together = render(scene, whole, backend=backend).rgb
    assert together[:, :, 17:21].amin() > 0
    torch.testing.assert_close(torch.cat(halves, dim=2), together, rtol=0, atol=1e-12)


@backends
def test_cameras_together_equal_cameras_alone(backend):
    scene = random_scene(50, degree=2)
    cameras = around(3)
    together = render(scene, cameras, backend=backend, depth=True)
    for row in range(3):
        alone = render(scene, cameras.select(torch.tensor([row])), backend=backend, depth=True)
        assert torch.equal(together.rgb[row], alone.rgb[0])
        assert torch.equal(together.depth[row], alone.depth[0])


@backends
def test_a_lower_degree_ignores_the_higher_bands(backend):
    scene = random_scene(50, degree=3)
    poisoned = scene.with_tensors({"shN": scene.shN.clone()}, {})
    poisoned.shN[:, 3:] = math.nan
    cut = scene.with_tensors({"shN": scene.shN[:, :3].clone()}, {})
    wanted = render(cut, around(1), backend=backend).rgb
    assert torch.equal(render(poisoned, around(1), backend=backend, sh_degree=1).rgb, wanted)
    assert not torch.equal(render(scene, around(1), backend=backend).rgb, wanted)
    poisoned.shN[:] = math.nan
    assert render(poisoned, around(1), backend=backend, sh_degree=0).rgb.isfinite().all()


@backends
def test_views_may_carry_a_scale(backend):
    """A view matrix that shrinks the world shows the same image, as distances shrink alike."""
    scene = random_scene(30, degree=1, dtype=torch.float64)
    cameras = around(1)
    small = torch.diag(torch.tensor([0.5, 0.5, 0.5, 1.0])).double()
    shrunk = replace(cameras, viewmats=small @ cameras.viewmats)
    wanted = render(scene, cameras, backend=backend).rgb
    found = render(scene, shrunk, backend=backend).rgb
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


@pytest.mark.skipif("numba" not in BACKENDS, reason="numba is not installed")
@pytest.mark.parametrize("kind", ["courtyard", "haze", "landscape"])
def test_backends_agree(kind):
    scene = cvtgs.synthetic.scene(kind, 3000, sh_degree=2, seed=1)
    ours, theirs = (
        render(scene, around(2, 70, 50, 60.0), backend=name, depth=True) for name in BACKENDS
    )
    difference = (ours.rgb - theirs.rgb).abs()
    assert difference.mean() < 1e-5
    assert difference.amax() < 2 / 255
    assert (ours.alpha - theirs.alpha).abs().mean() < 1e-5
