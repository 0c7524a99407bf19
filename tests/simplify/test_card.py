"""Tests on a CUDA device, or on the pretended one if there is none.

Devices round differently, so scenes are compared by their images. ``nox -s gpu`` runs these on a
GPU, together with the tests that need one.
"""

from collections.abc import Iterator
from contextlib import nullcontext

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.evaluation import EvaluationSettings, evaluate
from cvtgs.refinement import refine
from cvtgs.rendering import render
from cvtgs.views import automatic_views
from pretended_device import pretended_cuda
from refine_cases import discolored, full_scene, quick, small_scene
from scenes import same_bits

pytestmark = pytest.mark.cuda
DEVICE = torch.device("cuda")
CLOSE = EvaluationSettings(lpips="off")


@pytest.fixture(autouse=True)
def _device() -> Iterator[None]:
    with nullcontext() if torch.cuda.is_available() else pretended_cuda():
        yield


def made(count: int = 500, degree: int = 1) -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", count, sh_degree=degree, seed=0)


def assert_looks_like(found: cvtgs.GaussianScene, wanted: cvtgs.GaussianScene) -> None:
    assert found.device.type == "cuda"
    found = found.to("cpu")
    assert len(found) == len(wanted)
    cameras = automatic_views(wanted, 2, width=48, height=32)
    (scores,) = evaluate(wanted, {"found": found}, cameras, settings=CLOSE).scenes
    assert min(scores.psnr.views) > 35.0


@pytest.mark.long
@pytest.mark.parametrize("preset", ["draft", "fast", "standard", "paper"])
def test_presets_look_the_same_as_on_the_cpu(preset):
    scene = made()
    wanted = Simplifier(config=preset, device="cpu").simplify(scene, 0.1)
    simplifier = Simplifier(config=preset, device=DEVICE)
    first, second = (simplifier.simplify(scene.to(DEVICE), 0.1) for _ in range(2))
    assert same_bits(first.to("cpu"), second.to("cpu"))
    assert_looks_like(first, wanted)


@pytest.mark.slow
def test_levels_and_protected_regions():
    scene = made(1000)
    there, simplifier = scene.to(DEVICE), Simplifier(device=DEVICE)
    for level, rho in zip(simplifier.levels(there, [0.2, 0.04]), (0.2, 0.04), strict=True):
        assert len(level.scene) == rho * 1000
    keep = torch.arange(1000) % 40 == 0
    small = simplifier.simplify(there, 0.1, keep=keep).to("cpu")
    assert same_bits(small.select(torch.arange(25)), scene.select(keep))


@pytest.mark.slow
def test_images_and_gradients_match_those_of_the_cpu():
    scene = made(100)
    cameras = automatic_views(scene, 1, width=48, height=32)

    def results(scene, backend):
        leaf = scene.sh0.detach().requires_grad_()
        moved = scene.with_tensors({"sh0": leaf}, {})
        image = render(moved, cameras, backend=backend).rgb
        (gradient,) = torch.autograd.grad(image.square().sum(), leaf)
        return image.detach().cpu(), gradient.cpu()

    wanted = results(scene, "torch")
    for backend in ("torch", "auto"):
        for found, same in zip(results(scene.to(DEVICE), backend), wanted, strict=True):
            torch.testing.assert_close(found, same, rtol=2e-3, atol=2e-3)


@pytest.mark.long
def test_refinement_gains():
    full = full_scene(300)
    small = discolored(small_scene(full)).to(DEVICE)
    config = quick(check_every=4)
    refined = refine(small, full.to(DEVICE), steps=8, config=config, device=DEVICE)
    assert refined.scene.device.type == "cuda"
    assert refined.report.gain > 0


@pytest.mark.long
def test_errors_in_given_cameras_count_on_the_device():
    scene = made(300)
    cameras = automatic_views(scene, 4, width=32, height=24)
    settings = {"preset": "matched", "refine": {"steps": 0}, "visibility": {"size": 32}}
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(settings), device=DEVICE)
    keep = torch.arange(300) % 50 == 0
    for kept in (None, keep):
        small, report = simplifier.run(scene.to(DEVICE), 0.1, cameras=cameras, keep=kept)
        assert (len(small), small.device.type) == (30, "cuda")
        assert "errors" in [stage.stage for stage in report.stages]


@pytest.mark.long
def test_a_preset_that_refines_works_on_the_device():
    changes = {"steps": 2, "check_every": 2, "size": 32, "heldout": 4, "batch": 4}
    settings = {"preset": "high", "refine": changes, "visibility": {"views": 4, "size": 32}}
    config = SimplifyConfig.from_mapping(settings)
    small, report = Simplifier(config=config, device=DEVICE).run(made(300).to(DEVICE), 0.1)
    assert len(small) == 30
    assert report.refinement.device.startswith("cuda")
    assert report.refinement.gain >= 0
