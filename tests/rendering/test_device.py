"""Images and refinement on a pretended CUDA device: no mixing of devices, the CPU's values."""

import pytest
import torch

from cvtgs import Simplifier, SimplifyConfig
from cvtgs.refinement import refine
from cvtgs.rendering import contributions, render
from pretended_device import DeviceTensor, pretended_cuda
from refine_cases import discolored, full_scene, quick, small_scene
from render_cases import around, dtypes
from scenes import random_scene

# Tiles are larger on a device, so sums are other ones in the last bits.
CLOSE = {
    torch.float32: {"rtol": 1e-4, "atol": 1e-4},
    torch.float64: {"rtol": 1e-11, "atol": 1e-11},
}


@dtypes
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


@pytest.mark.slow
def test_refinement():
    full = full_scene(300)
    small, config = discolored(small_scene(full)), quick(check_every=4)
    wanted = refine(small, full, steps=12, config=config, device="cpu")
    with pretended_cuda():
        found = refine(small.to("cuda"), full.to("cuda"), steps=12, config=config, device="cuda")
        after = found.scene.to("cpu")
    assert found.report.backend == "torch"
    assert found.report.gain == pytest.approx(wanted.report.gain, abs=1e-3)
    assert wanted.report.gain > 0
    torch.testing.assert_close(after.sh0, wanted.scene.sh0, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_preset_that_refines():
    changes = {"steps": 4, "check_every": 2, "size": 32, "heldout": 4, "batch": 4}
    config = SimplifyConfig.from_mapping({"preset": "high", "refine": changes})
    scene = random_scene(200, degree=1)
    with pretended_cuda():
        small, report = Simplifier(config=config, device="cuda").run(scene.to("cuda"), 0.2)
        assert isinstance(small.means, DeviceTensor)
    assert len(small) == 40
    assert report.refinement.device == "cuda:0"
