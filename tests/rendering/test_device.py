"""Images and refinement on a pretended CUDA device: no mixing of devices, the CPU's values."""

import pytest
import torch

from cvtgs import Simplifier, SimplifyConfig
from cvtgs.errors import MissingDependencyError
from cvtgs.evaluation import EvaluationSettings, evaluate
from cvtgs.refinement import refine
from cvtgs.rendering import contributions, render
from cvtgs.views import automatic_views
from pretended_device import DeviceTensor, pretended_cuda
from refine_cases import as_dtype, discolored, full_scene, quick, small_scene
from render_cases import around, dtypes
from scenes import random_scene

# Tiles are larger on a device, so sums differ in the last bits.
CLOSE = {
    torch.float32: {"rtol": 1e-4, "atol": 1e-4},
    torch.float64: {"rtol": 1e-11, "atol": 1e-11},
}

REFINED = {
    torch.float32: {"rtol": 1e-3, "atol": 1e-3},
    torch.float64: {"rtol": 1e-6, "atol": 1e-6},
}
"""Steps accumulate differences in the last bits."""


@dtypes
@pytest.mark.slow
def test_images_and_gradients(dtype):
    def results(scene):
        leaf = scene.means.detach().requires_grad_()
        image = render(scene.with_tensors({"means": leaf}, {}), around(), backend=name, depth=True)
        (gradient,) = torch.autograd.grad(image.rgb.square().sum(), leaf)
        seen = contributions(scene, around(), backend=name)
        return image.rgb.detach(), image.alpha.detach(), image.depth.detach(), gradient, seen

    scene, name = random_scene(60, degree=2, dtype=dtype), "torch"
    wanted = results(scene)
    with pretended_cuda():
        name = "auto"
        found = [one.cpu() for one in results(scene.to("cuda")) if isinstance(one, DeviceTensor)]
    assert len(found) == len(wanted)
    for one, same in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, same, **CLOSE[dtype])


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["sh0", "shN"])
def test_colors_that_are_not_finite_are_not_rendered(name, value):
    scene, cameras = random_scene(40, degree=1), around()
    poisoned = scene.tensors()[name].clone()
    poisoned[::5] = value
    scene = scene.with_tensors({name: poisoned}, {})
    wanted = render(scene, cameras, backend="torch", depth=True)
    with pretended_cuda():
        found = render(scene.to("cuda"), cameras, depth=True)
        images = {name: getattr(found, name).cpu() for name in ("rgb", "alpha", "depth")}
    assert wanted.rgb.isfinite().all()
    for layer, image in images.items():
        torch.testing.assert_close(image, getattr(wanted, layer), **CLOSE[torch.float32])


@pytest.fixture
def _torch_only(monkeypatch) -> None:
    """Render by the torch backend on the CPU too."""

    def fail(device: torch.device) -> None:
        raise MissingDependencyError("numba is not to be used.")

    monkeypatch.setattr("cvtgs.rendering.numba_backend.require", fail)


@pytest.mark.long
@pytest.mark.usefixtures("_torch_only")
@dtypes
def test_refinement(dtype):
    full = as_dtype(full_scene(300), dtype)
    small, config = discolored(small_scene(full)), quick(check_every=4)
    wanted = refine(small, full, steps=12, config=config, device="cpu")
    with pretended_cuda():
        found = refine(small.to("cuda"), full.to("cuda"), steps=12, config=config, device="cuda")
        after = found.scene.to("cpu")
    assert found.report.backend == wanted.report.backend == "torch"
    assert found.report.gain == pytest.approx(wanted.report.gain, abs=1e-3)
    assert wanted.report.gain > 0
    torch.testing.assert_close(after.sh0, wanted.scene.sh0, **REFINED[dtype])


@pytest.mark.long
@pytest.mark.usefixtures("_torch_only")
@dtypes
def test_presets_that_refine(dtype):
    changes = {"steps": 4, "check_every": 2, "size": 32, "heldout": 4, "batch": 4}
    settings = {"preset": "high", "refine": changes, "visibility": {"views": 4, "size": 32}}
    config = SimplifyConfig.from_mapping(settings)
    scene = random_scene(200, degree=1, dtype=dtype)
    wanted, on_cpu = Simplifier(config=config, device="cpu").run(scene, 0.2)
    with pretended_cuda():
        small, report = Simplifier(config=config, device="cuda").run(scene.to("cuda"), 0.2)
        assert isinstance(small.means, DeviceTensor)
        found = small.to("cpu")
    assert report.refinement.device == "cuda:0"
    # A square image has 2.5 * 2.5 pixels for each Gaussian, so there are 2.5 times the steps.
    assert report.refinement.steps == on_cpu.refinement.steps == 10
    for name, tensor in wanted.tensors().items():
        torch.testing.assert_close(found.tensors()[name], tensor, **REFINED[dtype])


@pytest.mark.long
@pytest.mark.usefixtures("_torch_only")
@dtypes
def test_the_preset_that_matches(dtype):
    settings = {
        "preset": "matched",
        "visibility": {"views": 4, "size": 32, "stride": 1},
        "match": {"color_iterations": 6},
        "refine": {"steps": 0},
    }
    config = SimplifyConfig.from_mapping(settings)
    scene = random_scene(200, degree=1, dtype=dtype)
    wanted = Simplifier(config=config, device="cpu").simplify(scene, 0.2)
    with pretended_cuda():
        small = Simplifier(config=config, device="cuda").simplify(scene.to("cuda"), 0.2)
        found = small.to("cpu")
    for name, tensor in wanted.tensors().items():
        torch.testing.assert_close(found.tensors()[name], tensor, **CLOSE[dtype])


@pytest.mark.usefixtures("_torch_only")
@dtypes
@pytest.mark.slow
def test_scores(dtype):
    full = as_dtype(full_scene(300), dtype)
    small, settings = discolored(small_scene(full)), EvaluationSettings(lpips="off")
    cameras = automatic_views(full, 2, width=32, height=24)
    wanted = evaluate(full, {"small": small}, cameras, settings=settings).scenes[0]
    with pretended_cuda():
        there, other = full.to("cuda"), {"small": small.to("cuda")}
        (found,) = evaluate(there, other, cameras, settings=settings).scenes
    for name in ("psnr", "ssim", "alpha_error"):
        wanted_values = getattr(wanted, name).views
        assert getattr(found, name).views == pytest.approx(wanted_values, rel=1e-4)
