"""Gradients of images, by every backend that is installed."""

from dataclasses import replace

import pytest
import torch

import cvtgs.synthetic
from cvtgs.cameras import Cameras, look_at
from cvtgs.errors import InvalidArgumentError
from cvtgs.rendering import contributions, projection, render
from render_cases import BACKENDS, MIP, backends, scene_of, straight
from scenes import random_scene


def cameras_at(eyes, width, height, focal):
    eyes = torch.tensor(eyes, dtype=torch.float64)
    rows = [[focal, 0, 0.5 * width + 0.3], [0, 0.95 * focal, 0.5 * height - 0.4], [0, 0, 1]]
    up = torch.tensor([0.0, -1, 0], dtype=torch.float64)
    return Cameras(
        viewmats=look_at(eyes, torch.zeros_like(eyes), up),
        Ks=torch.tensor(rows, dtype=torch.float64).expand(len(eyes), 3, 3),
        width=width,
        height=height,
    )


TWO = cameras_at([[0.3, 0.2, -4.0], [1.0, -1.0, -3.0]], 14, 11, 12.0)
FEW = cameras_at([[0.3, 0.2, -4.0]], 3, 2, 3.0)


def smooth_scene(degree, comments):
    """Four Gaussians so wide that no pixel is near a cut-off, none opaque, none black."""
    scene = random_scene(4, seed=3, degree=degree, dtype=torch.float64, spread=0.4)
    noise = torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double()
    changes = {
        "log_scales": 0.4 + 0.3 * noise,
        "logit_opacities": 1.0 + 0.2 * scene.logit_opacities,
        "sh0": 1.0 + 0.3 * scene.sh0,
    }
    return replace(scene.with_tensors(changes, {}), comments=comments)


@backends
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh0", "shN"])
@pytest.mark.parametrize("comments", [(), MIP], ids=["plain", "mip"])
@pytest.mark.slow
def test_every_tensor_of_a_smooth_scene(backend, name, comments):
    scene = smooth_scene(3, comments)

    def layers(tensor):
        found = render(scene.with_tensors({name: tensor}, {}), FEW, backend=backend, depth=True)
        return found.rgb, found.alpha, found.depth

    leaf = scene.tensors()[name].clone().requires_grad_()
    # The fast mode compares projections of the Jacobian: there are many coefficients.
    assert torch.autograd.gradcheck(layers, leaf, nondet_tol=0.0, fast_mode=name == "shN")


@backends
def test_background_and_truncated_degree(backend):
    scene = smooth_scene(3, ())

    def image(background, shN):  # noqa: N803
        changed = scene.with_tensors({"shN": shN}, {})
        return render(changed, FEW, backend=backend, background=background, sh_degree=1).rgb

    leaves = (torch.tensor([0.2, 0.5, 0.9]).double(), scene.shN.clone())
    assert torch.autograd.gradcheck(
        image, [leaf.requires_grad_() for leaf in leaves], fast_mode=True
    )
    image(*leaves).sum().backward()
    assert leaves[1].grad[:, :3].any()
    assert not leaves[1].grad[:, 3:].any()


@pytest.mark.slow
@backends
def test_crop_of_a_scene_with_all_its_cut_offs(backend):
    """Cosine above 0.999 with central differences, over the entries that matter most."""
    scene = cvtgs.synthetic.scene("courtyard", 1500, sh_degree=1, seed=0)
    tensors = {name: tensor.double() for name, tensor in scene.tensors().items()}
    scene = scene.with_tensors(tensors, {})
    crop = cameras_at([[5.0, -3.0, -9.0]], 24, 18, 40.0)
    weights = torch.rand(1, 18, 24, 3, generator=torch.Generator().manual_seed(1)).double() - 0.5

    def loss(changes):
        found = render(scene.with_tensors(changes, {}), crop, backend=backend)
        return (found.rgb * weights).sum()

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in tensors.items()}
    loss(leaves).backward()
    for name, leaf in leaves.items():
        entries = leaf.grad.abs().flatten().topk(8).indices
        estimates = []
        for entry in entries.tolist():
            step = torch.zeros(leaf.numel(), dtype=torch.float64)
            step[entry] = 1e-7
            step = step.view_as(leaf)
            with torch.no_grad():
                high, low = loss({name: leaf + step}), loss({name: leaf - step})
            estimates.append((high - low).item() / 2e-7)
        ours, theirs = leaf.grad.flatten()[entries], torch.tensor(estimates).double()
        assert torch.nn.functional.cosine_similarity(ours, theirs, dim=0) > 0.999, name


@pytest.mark.skipif("numba" not in BACKENDS, reason="numba is not installed")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("comments", [(), MIP], ids=["plain", "mip"])
def test_backends_agree(dtype, comments):
    scene = replace(random_scene(300, degree=3, dtype=dtype, size=0.2), comments=comments)
    gradients = []
    for backend in BACKENDS:
        tensors = {name: t.clone().requires_grad_() for name, t in scene.tensors().items()}
        found = render(scene.with_tensors(tensors, {}), TWO, backend=backend, depth=True)
        (found.rgb.square().sum() + (found.depth * found.alpha).sum()).backward()
        gradients.append({name: tensor.grad for name, tensor in tensors.items()})
    for name, ours in gradients[0].items():
        theirs = gradients[1][name]
        allowed = 2e-4 if dtype == torch.float32 else 1e-10
        assert (ours - theirs).norm() <= allowed * theirs.norm(), name


@pytest.mark.slow
@backends
def test_results_are_deterministic_with_any_number_of_threads(backend):
    scene = random_scene(400, degree=2, size=0.2)
    found = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            tensors = {name: t.clone().requires_grad_() for name, t in scene.tensors().items()}
            image = render(scene.with_tensors(tensors, {}), TWO, backend=backend).rgb
            image.square().sum().backward()
            found.append([image.detach(), *(tensor.grad for tensor in tensors.values())])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(found[1], found[2], strict=True))
    if backend == "numba":
        assert torch.equal(found[0][0], found[1][0])


@backends
def test_gradients_of_cameras_add_up(backend):
    scene = random_scene(30, degree=1, dtype=torch.float64, size=0.3)

    def gradient(cameras):
        means = scene.means.clone().requires_grad_()
        changed = scene.with_tensors({"means": means}, {})
        render(changed, cameras, backend=backend).rgb.square().sum().backward()
        return means.grad

    alone = [gradient(TWO.select(torch.tensor([row]))) for row in range(2)]
    torch.testing.assert_close(gradient(TWO), alone[0] + alone[1])


def test_needles_that_vanish_when_compensated_have_finite_gradients() -> None:
    axes = torch.tensor([[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]], requires_grad=True)
    survival = vars(projection)["_ellipses"](axes, 0.3)[1]
    (gradient,) = torch.autograd.grad(survival.sum(), axes)
    assert 0.0 < survival.item() < 1 / 255
    assert not gradient.any()


@backends
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["sh0", "shN"])
def test_colors_that_are_not_finite_count_for_no_gradient(backend, name, value):
    scene = random_scene(30, seed=1, degree=1, dtype=torch.float64)
    poisoned = scene.tensors()[name].clone()
    poisoned[::3] = value
    is_kept = torch.arange(30) % 3 != 0
    leaf = scene.means.clone().requires_grad_()
    scene = scene.with_tensors({name: poisoned, "means": leaf}, {})
    render(scene, TWO, backend=backend).rgb.sum().backward()
    assert leaf.grad.isfinite().all()
    assert not leaf.grad[~is_kept].any()
    alone = leaf.detach()[is_kept].requires_grad_()
    render(
        scene[is_kept].with_tensors({"means": alone}, {}), TWO, backend=backend
    ).rgb.sum().backward()
    torch.testing.assert_close(leaf.grad[is_kept], alone.grad)
    seen = contributions(scene, TWO, backend=backend)
    if name == "sh0":
        assert not seen[~is_kept].any()


@backends
def test_gradients_cannot_be_differentiated(backend):
    """Where the loss is linear, torch itself would give zeros, or a part of the derivative."""
    scene = smooth_scene(0, ())
    leaf = scene.log_scales.clone().requires_grad_()
    image = render(scene.with_tensors({"log_scales": leaf}, {}), FEW, backend=backend).rgb
    (once,) = torch.autograd.grad(image.mean(), leaf, retain_graph=True)
    (gradient,) = torch.autograd.grad(image.mean(), leaf, create_graph=True)
    assert torch.equal(gradient, once)
    with pytest.raises(InvalidArgumentError, match="first derivatives only"):
        torch.autograd.grad(gradient.square().sum(), leaf, retain_graph=True)
    with pytest.raises(InvalidArgumentError, match="first derivatives only"):
        (image.mean() + gradient.square().sum()).backward()


@backends
@pytest.mark.parametrize("degree", [0, 2])
def test_unused_bands_have_gradients_of_zero(backend, degree):
    scene = random_scene(20, degree=degree)
    bands = scene.shN.clone().requires_grad_()
    image = render(scene.with_tensors(shN=bands), TWO, backend=backend, sh_degree=0).rgb
    (found,) = torch.autograd.grad(image.sum(), bands)
    assert torch.equal(found, torch.zeros_like(bands))


@backends
def test_only_colours_matter_where_alpha_is_the_largest(backend):
    """In every pixel, alpha would be above 0.99."""
    scene = scene_of(((0, 0, 2), (9.0, 9.0, 9.0), 0.99999, (1.0, 0.5, 0)), dtype=torch.float64)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.tensors().items()}
    image = render(scene.with_tensors(leaves, {}), straight(), backend=backend).rgb
    torch.testing.assert_close(image, torch.tensor([0.99, 0.495, 0.0]).double().expand_as(image))
    image.sum().backward()
    changing = {name for name, leaf in leaves.items() if leaf.grad is not None and leaf.grad.any()}
    assert changing == {"sh0"}
