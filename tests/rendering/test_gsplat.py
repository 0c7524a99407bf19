"""The gsplat backend against a stand-in for gsplat: probe, choice, arguments, values, gradients."""

import inspect
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch

import gsplat_stand_in
from cvtgs import GaussianScene, synthetic
from cvtgs.cameras import Cameras
from cvtgs.errors import MissingDependencyError
from cvtgs.rendering import choose_backend, gsplat_backend, observe, projection, render
from cvtgs.rendering.render import contributions_to_each
from cvtgs.views import find_view_positions, mixed_views
from cvtgs.views.scoring import image_device
from render_cases import MIP, around, oracle_images, scene_of, straight
from scenes import random_scene

CUDA = torch.device("cuda")
SMALL = Cameras(
    viewmats=torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])[None],
    Ks=torch.tensor([[[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]]),
    width=8,
    height=6,
)
mip = pytest.mark.parametrize("comments", [(), MIP], ids=["plain", "mip"])


@pytest.fixture
def install(monkeypatch):
    """Return an installer of a function as gsplat's, unprobed, on a CPU posing as CUDA."""
    for kind in (GaussianScene, Cameras):
        on_cpu = partial(lambda move, self, device: move(self, torch.device("cpu")), kind.to)
        monkeypatch.setattr(kind, "to", lambda self, device, _move=on_cpu: _move(self, device))
    require = gsplat_backend.require
    monkeypatch.setattr(gsplat_backend, "require", lambda device: require(CUDA))
    gsplat_backend._failure.cache_clear()

    def take(rasterization):
        module = rasterization and SimpleNamespace(rasterization=rasterization)
        monkeypatch.setitem(sys.modules, "gsplat", module)

    yield take
    gsplat_backend._failure.cache_clear()


def reason():
    """Return the reason for not choosing gsplat."""
    with pytest.raises(MissingDependencyError) as caught:
        choose_backend("gsplat", CUDA)
    begin, end = (
        "backend 'gsplat' needs a working gsplat, but ",
        "; install it with python -m pip install \"cvtgs[gsplat]\", or use backend='torch'.",
    )
    assert str(caught.value).startswith(begin)
    assert str(caught.value).endswith(end)
    assert choose_backend("auto", CUDA)[0] != "gsplat"
    return str(caught.value)[len(begin) : -len(end)]


def test_auto_takes_a_gsplat_that_renders_as_documented(install):
    install(gsplat_stand_in.rasterization)
    assert choose_backend("auto", CUDA) == ("gsplat", gsplat_backend)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_probe_does_not_need_the_gradients_of_its_caller(install, mode):
    install(gsplat_stand_in.rasterization)
    with mode():
        assert choose_backend("auto", CUDA)[0] == "gsplat"
        assert not torch.is_grad_enabled()


def test_without_gsplat(install):
    install(None)
    assert reason() == ("it cannot be imported (import of gsplat halted; None in sys.modules)")


def test_a_late_failure_of_gsplat_is_probed_once_and_reported_in_one_line(install):
    calls = []

    def rasterization(**_):
        calls.append(1)
        raise AttributeError("'NoneType' has no attribute 'forward'\nmany\nmore lines")

    install(rasterization)
    for _ in range(2):
        assert reason() == (
            "it failed to render (AttributeError: 'NoneType' has no attribute 'forward')"
        )
    assert len(calls) == 1


def without(name):
    """Return the stand-in for a version of gsplat that lacks an argument."""

    def rasterization(**arguments):
        if name in arguments:
            raise TypeError(f"rasterization() got an unexpected keyword argument '{name}'")
        return gsplat_stand_in.rasterization(**arguments)

    return rasterization


@pytest.mark.parametrize("name", ["eps2d", "render_mode", "rasterize_mode", "viewmats"])
def test_a_gsplat_without_a_needed_argument_is_refused(install, name):
    install(without(name))
    assert f"unexpected keyword argument '{name}'" in reason()


def changed(**changes):
    """Return the stand-in with other values of some arguments."""

    def rasterization(**arguments):
        replaced = {name: change(arguments[name]) for name, change in changes.items()}
        return gsplat_stand_in.rasterization(**(arguments | replaced))

    return rasterization


def shift_window(intrinsics, *, right, down):
    """Move the principal point."""
    return intrinsics + intrinsics.new_tensor([[0, 0, right], [0, 0, down], [0, 0, 0]])


WRONG = {
    "no dilation": changed(eps2d=lambda _: 0.0),
    "half a pixel to the right": changed(Ks=partial(shift_window, right=0.5, down=0.0)),
    "half a pixel up": changed(Ks=partial(shift_window, right=0.0, down=-0.5)),
    "quaternions with w last": changed(quats=lambda q: q.roll(-1, 1)),
    "logarithms of scales": changed(scales=lambda s: s.log()),
    "harmonics in another order": changed(colors=lambda sh: sh.flip(1)),
    "detached": changed(means=lambda means: means.detach() + 0 * means),
    "fainter": changed(opacities=lambda o: 0.9 * o),
    "not a number": changed(colors=lambda sh: sh * float("nan")),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_gsplat_that_renders_something_else_is_refused(install, name):
    install(WRONG[name])
    kind = "gradient" if name == "detached" else "image"
    found = reason()
    assert found.startswith(f"its {kind} of one Gaussian differs by ")
    assert found.endswith("% from that of backend 'torch'")


@pytest.mark.parametrize("center", [0.0, 1.0])
def test_a_gsplat_that_samples_corners_of_pixels_is_refused(install, monkeypatch, center):
    monkeypatch.setattr(gsplat_stand_in, "CENTER", center)
    install(gsplat_stand_in.rasterization)
    assert reason().startswith("its image of one Gaussian differs by ")


@pytest.mark.parametrize("degree", [0, 1, 3])
@mip
def test_values(install, degree, comments):
    """Same images as the torch backend; no alpha is above 0.99, where the rules differ."""
    install(gsplat_stand_in.rasterization)
    scene = random_scene(40, seed=2, degree=degree, dtype=torch.float64)
    scene = GaussianScene(**scene.tensors(), comments=comments)
    scene = scene.with_tensors({"logit_opacities": scene.logit_opacities.clamp_max(4.0)}, {})
    both = [render(scene, around(), backend=name, depth=True) for name in ("gsplat", "torch")]
    assert [one.backend for one in both] == ["gsplat", "torch"]
    for name in ("rgb", "alpha"):
        found, wanted = (getattr(one, name) for one in both)
        assert found.dtype == torch.float64
        # A pixel at a cut-off may lie on its other side in float32.
        assert ((found - wanted).abs() > 1e-5).double().mean() < 1e-3
        torch.testing.assert_close(found, wanted, rtol=0, atol=2 / 255)
    solid = both[1].alpha > 0.05
    torch.testing.assert_close(both[0].depth[solid], both[1].depth[solid], rtol=1e-3, atol=0.01)


def test_values_by_hand(install):
    """A Gaussian half a pixel from four pixel centres, and alpha up to 0.999."""
    install(gsplat_stand_in.rasterization)
    near = scene_of(((0.0, 0, 1), (0.1, 0.1, 0.1), 0.5, (1.0, 1, 1)), dtype=torch.float32)
    image = render(near, straight(8, 8, 8.0), backend="gsplat")
    assert image.alpha.amax().item() == pytest.approx(0.5 * 2.718281828 ** (-0.25 / 0.94), abs=1e-6)
    opaque = scene_of(((0.0, 0, 1), (9.0, 9, 9), 1 - 1e-6, (1.0, 1, 1)), dtype=torch.float32)
    assert render(opaque, straight(), backend="gsplat").alpha[0, 3, 4].item() == pytest.approx(
        0.999
    )


@mip
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh0", "shN"])
def test_gradients(install, name, comments):
    install(gsplat_stand_in.rasterization)
    scene = random_scene(12, seed=4, degree=1, dtype=torch.float64)
    scene = GaussianScene(**scene.tensors(), comments=comments)
    changes = {"logit_opacities": scene.logit_opacities.clamp_max(3), "sh0": scene.sh0.abs() + 1}
    scene = scene.with_tensors(changes, {})
    gradients = []
    for backend in ("gsplat", "torch"):
        leaf = scene.tensors()[name].clone().requires_grad_()
        image = render(scene.with_tensors({name: leaf}, {}), around(), backend=backend, depth=False)
        ramp = torch.linspace(0, 1, image.rgb.numel()).double().reshape(image.rgb.shape)
        ((image.rgb * ramp).sum() + (image.alpha * ramp[..., 0]).sum()).backward()
        gradients.append(leaf.grad)
    limit = 1e-3 * gradients[1].abs().amax().item()
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=limit)


@pytest.mark.parametrize("together", [1, 50, 1000])
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_contributions_to_each_image(install, monkeypatch, mode, together):
    install(gsplat_stand_in.rasterization)
    monkeypatch.setattr(gsplat_backend, "TOGETHER", together)
    scene = random_scene(20, seed=5).with_tensors({"logit_opacities": torch.zeros(20)}, {})
    for cameras in (around(3), around(3).in_two_sizes(2)):
        with mode():
            found = torch.stack(list(contributions_to_each(scene, cameras, backend="gsplat")))
        wanted = torch.stack(list(contributions_to_each(scene, cameras, backend="torch")))
        assert found.shape == (3, 20)
        torch.testing.assert_close(found.clone(), wanted, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.inference_mode])
def test_images_and_contributions_in_one_pass(install, mode, degree):
    install(gsplat_stand_in.rasterization)
    scene = random_scene(20, degree=degree, seed=5)
    scene = scene.with_tensors({"logit_opacities": torch.zeros(20)}, {})
    cameras = around(2).in_two_sizes(2)
    with mode():
        found = observe(scene, cameras, backend="gsplat")
    wanted = observe(scene, cameras, backend="torch")
    assert not found.rgb.requires_grad
    for name, limit in (("rgb", 1e-3), ("alpha", 1e-3), ("contributions", 1e-2)):
        torch.testing.assert_close(
            getattr(found, name).clone(), getattr(wanted, name), rtol=1e-4, atol=limit
        )


@pytest.mark.slow
def test_views_are_chosen_by_gsplat_as_on_the_host(install):
    positions = find_view_positions(synthetic.scene("object", 150, sh_degree=0, seed=0))
    wanted = mixed_views(positions, 4, size=64)
    together = []

    def rasterization(**options):
        together.append(len(options["viewmats"]))
        return gsplat_stand_in.rasterization(**options)

    gsplat_backend._failure.cache_clear()
    install(rasterization)
    there = replace(positions, layout=replace(positions.layout, device=CUDA))
    assert (image_device(positions.layout).type, image_device(there.layout)) == ("cpu", CUDA)
    assert torch.equal(mixed_views(there, 4, size=64).viewmats, wanted.viewmats)
    assert max(together) > 2


def test_empty(install):
    install(gsplat_stand_in.rasterization)
    empty = random_scene(3).select(torch.zeros(0, dtype=torch.int64))
    assert not render(empty, straight(), backend="gsplat").alpha.any()


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("comments", [(), ("SplatRenderMode: mip",)], ids=["plain", "mip"])
def test_arguments_of_gsplat(monkeypatch, degree, comments):
    """A stand-in for gsplat keeps its arguments; nothing here needs CUDA."""
    arguments = {}

    def rasterization(**options):
        arguments.update(options)
        layers = torch.arange(4.0).expand(1, 6, 8, 4)
        return layers, torch.full((1, 6, 8, 1), 0.5), {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    scene = random_scene(5, degree=degree, dtype=torch.float64)
    scene = type(scene)(**scene.tensors(), comments=comments)
    output = gsplat_backend.rasterize(scene, SMALL, sh_degree=min(1, degree))
    assert output.rgb.dtype == torch.float64
    assert output.rgb[0, 0, 0].tolist() == [0, 1, 2]
    assert output.depth[0, 0, 0] == 3
    assert output.alpha[0, 0, 0] == 0.5
    assert arguments["colors"].shape == ((5, 4, 3) if degree else (5, 3))
    assert arguments["sh_degree"] == (1 if degree else None)
    assert arguments["rasterize_mode"] == ("antialiased" if comments else "classic")
    assert (arguments["near_plane"], arguments["eps2d"], arguments["packed"]) == (0.01, 0.3, False)
    assert torch.equal(arguments["scales"], scene.scales.float())
    rotation, shift = (
        arguments["viewmats"][0, :3, :3].double(),
        arguments["viewmats"][0, :3, 3].double(),
    )
    wanted = scene.means @ SMALL.viewmats[0, :3, :3].double().T
    wanted = wanted + SMALL.viewmats[0, :3, 3].double()
    torch.testing.assert_close(
        arguments["means"].double() @ rotation.T + shift, wanted, rtol=0, atol=1e-5
    )
    assert all(t.dtype == torch.float32 for t in arguments.values() if isinstance(t, torch.Tensor))


def test_a_uniform_scale_of_a_view_does_not_reach_gsplat(monkeypatch):
    found = []

    def rasterization(**options):
        found.append(options["viewmats"])
        return torch.zeros(1, 6, 8, 4), torch.zeros(1, 6, 8, 1), {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    scaled = SMALL.viewmats.clone()
    scaled[:, :3] *= 3
    for cameras in (SMALL, replace(SMALL, viewmats=scaled)):
        gsplat_backend.rasterize(random_scene(5), cameras, sh_degree=0)
    torch.testing.assert_close(*found)


def test_cameras_that_treat_the_tag_alike_are_rendered_together(monkeypatch):
    modes = []

    def rasterization(**options):
        modes.append((len(options["viewmats"]), options["rasterize_mode"]))
        return gsplat_stand_in.rasterization(**options)

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    scene = GaussianScene(**random_scene(5).tensors(), comments=MIP)
    cameras = around(3)
    gsplat_backend.rasterize(scene, cameras, sh_degree=0)
    ignoring = replace(cameras, ignores_tag=(True, True, True))
    gsplat_backend.rasterize(scene, ignoring, sh_degree=0)
    mixed = replace(cameras, ignores_tag=(False, True, False))
    output = gsplat_backend.rasterize(scene, mixed, sh_degree=0)
    assert modes == [(3, "antialiased"), (3, "classic"), (2, "antialiased"), (1, "classic")]
    monkeypatch.setattr(gsplat_backend, "TOGETHER", 1)
    alone = gsplat_backend.rasterize(scene, mixed, sh_degree=0)
    assert [number for number, _ in modes[4:]] == [1, 1, 1]
    torch.testing.assert_close(output.rgb, alone.rgb)  # in the order of the cameras


def test_cameras_of_two_sizes_are_rendered_apart(monkeypatch):
    widened = []

    def rasterization(**options):
        widened.append((len(options["viewmats"]), options["eps2d"]))
        return gsplat_stand_in.rasterization(**options)

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    gsplat_backend.rasterize(random_scene(5), around(2).every(2), sh_degree=0)
    gsplat_backend.rasterize(random_scene(5), around(2).in_two_sizes(2), sh_degree=0)
    dilation = projection.DILATION
    assert widened == [(2, dilation / 4), (1, dilation), (1, dilation / 4)]


def documented(scene, cameras, **options):
    """Call the stand-in with a scene in the way that gsplat documents."""
    return gsplat_stand_in.rasterization(
        scene.means.float(), scene.quats.float(), scene.scales.float(), scene.opacities.float(),
        scene.sh.float(), cameras.viewmats.float(), cameras.Ks.float(), cameras.width,
        cameras.height, sh_degree=scene.sh_degree, **options,
    )  # fmt: skip


@mip
def test_the_stand_in_follows_the_oracle(comments):
    scene = random_scene(15, seed=1, degree=3, dtype=torch.float64)
    scene = GaussianScene(**scene.tensors(), comments=comments)
    cameras = around(1, 19, 15, 20.0)
    mode = "antialiased" if comments else "classic"
    colors, alphas, _ = documented(scene, cameras, render_mode="RGB+ED", rasterize_mode=mode)
    rgb, alpha, depth = oracle_images(scene, cameras, max_alpha=0.999)
    torch.testing.assert_close(colors[..., :3].double(), rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(alphas[..., 0].double(), alpha, rtol=0, atol=1e-4)
    solid = alpha > 0.05
    torch.testing.assert_close(colors[..., 3].double()[solid], depth[solid], rtol=1e-3, atol=1e-3)


def test_the_stand_in_supports_packed_output():
    scene, cameras = random_scene(30, seed=6, spread=3.0), around()
    packed, loose = (documented(scene, cameras, packed=choice) for choice in (True, False))
    assert torch.equal(packed[0], loose[0])
    assert torch.equal(packed[1], loose[1])
    shown = (loose[2]["radii"] > 0).all(-1)
    assert loose[2]["radii"].shape == (2, 30, 2)
    assert 0 < len(packed[2]["gaussian_ids"]) == shown.sum() < 60
    assert torch.equal(packed[2]["radii"], loose[2]["radii"][shown])
    assert torch.equal(packed[2]["means2d"], loose[2]["means2d"][shown])


def test_the_stand_in_refuses_undocumented_arguments():
    scene, cameras = random_scene(2), straight()
    with pytest.raises(TypeError, match="antialiased"):
        documented(scene, cameras, antialiased=True)
    with pytest.raises(AssertionError, match="depth"):
        documented(scene, cameras, render_mode="depth")
    with pytest.raises(NotImplementedError):
        documented(scene, cameras, camera_model="fisheye")
    parameters = inspect.signature(gsplat_stand_in.rasterization).parameters
    assert [*parameters][:10] == [
        "means", "quats", "scales", "opacities", "colors",
        "viewmats", "Ks", "width", "height", "near_plane",
    ]  # fmt: skip
    assert len(parameters) == 34
