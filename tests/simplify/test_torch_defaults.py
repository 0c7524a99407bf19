"""Results do not depend on settings of torch that a program may have changed."""

from contextlib import contextmanager

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.cvt import stratified_seeds
from cvtgs.io import axes as axes_module
from cvtgs.outofcore import simplify_file
from cvtgs.rendering import contributions
from cvtgs.streams import plan_stream, stream_file, write_sog_stream, write_tiles
from cvtgs.synthetic import scene as make
from cvtgs.views import automatic_views, find_view_positions, mixed_views
from render_cases import backends
from scenes import same_bits

IMAGES = {
    "preset": "matched",
    "visibility": {"views": 8, "size": 48, "stride": 1},
    "refine": {"steps": 6, "size": 48, "stride": 1, "check_every": 3},
}


@contextmanager
def another_dtype(dtype=torch.float64):
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def short_dtype():
    return another_dtype(torch.bfloat16)


def another_device():
    """A default device that holds no values: whatever lands there fails at once."""
    return torch.device("meta")


def autocast():
    return torch.autocast("cpu", dtype=torch.bfloat16)


@contextmanager
def coarse_products():
    """Products of 8 bits, on CPUs that have them."""
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision("highest")


settings = pytest.mark.parametrize(
    "setting",
    [
        torch.no_grad,
        torch.inference_mode,
        autocast,
        coarse_products,
        another_dtype,
        short_dtype,
        another_device,
    ],
)


@pytest.fixture(scope="module")
def scene():
    return make("object", 500, sh_degree=1, seed=0)


def simplify(scene):
    keep = scene.means[:, 0] > scene.means[:, 0].median()
    simplifier = Simplifier("standard", device="cpu")
    kept = simplifier.simplify(scene, 0.6, keep=keep)
    return [*[level.scene for level in simplifier.levels(scene, [0.3, 0.05])], kept]


def simplify_by_images(scene):
    """The steps of a refinement need gradients of their own."""
    result = Simplifier(config=SimplifyConfig.from_mapping(IMAGES), device="cpu").run(scene, 0.2)
    refined = result.report.refinement
    assert refined is not None
    assert refined.gain > 0
    return [result.scene]


def simplify_as_published(scene):
    return [Simplifier("paper", device="cpu").simplify(scene, 0.1)]


def through_a_file(scene, folder):
    cvtgs.save(scene, folder / "scene.sog", overwrite=True)
    return [cvtgs.load(folder / "scene.sog"), scene[3:7]]


@settings
@pytest.mark.parametrize(
    "work",
    [simplify, pytest.param(simplify_by_images, marks=pytest.mark.slow), simplify_as_published],
)
def test_simplification(scene, setting, work):
    wanted = work(scene)
    with setting():
        found = work(scene)
    assert all(same_bits(one, other) for one, other in zip(found, wanted, strict=True))


@settings
def test_files_and_rows(scene, setting, tmp_path):
    wanted = through_a_file(scene, tmp_path)
    with setting():
        found = through_a_file(scene, tmp_path)
    assert all(same_bits(one, other) for one, other in zip(found, wanted, strict=True))


def in_blocks(scene, folder):
    cvtgs.save(scene, folder / "scene.ply", overwrite=True)
    for preset in ("standard", SimplifyConfig.from_mapping(IMAGES)):
        simplifier = Simplifier(config=preset, device="cpu")
        options = {"simplifier": simplifier, "blocks": 3, "overwrite": True}
        simplify_file(folder / "scene.ply", folder / "small.ply", 0.2, **options)
        yield cvtgs.load(folder / "small.ply")


def streamed(scene, folder):
    scene = scene.with_tensors({"shN": 0.1 * scene.shN})  # in the range of tiles
    cvtgs.save(scene, folder / "scene.ply", overwrite=True)
    rhos = [0.5, 0.1]
    options = {"kind": "3dtiles", "blocks": 3, "overwrite": True}
    stream_file(folder / "scene.ply", folder / "blocks", rhos, **options)
    plan = plan_stream(Simplifier(device="cpu").levels(scene, rhos), chunk_gaussians=64)
    write_sog_stream(plan, folder / "sog", overwrite=True)
    write_tiles(plan, folder / "tiles", overwrite=True)
    for file in sorted(folder.glob("*/*.glb")):
        yield cvtgs.load(file)
    yield cvtgs.load(folder / "sog" / "lod-meta.json")


@pytest.mark.long
@pytest.mark.parametrize("setting", [another_device, autocast])
@pytest.mark.parametrize("work", [in_blocks, streamed])
def test_files_in_parts(scene, tmp_path, work, setting):
    wanted = list(work(scene, tmp_path))
    with setting():
        found = list(work(scene, tmp_path))
    assert len(found) > 1
    assert all(same_bits(one, other) for one, other in zip(found, wanted, strict=True))


@pytest.mark.long
@settings
@pytest.mark.parametrize("find", [automatic_views, mixed_views])
def test_views(scene, setting, find):
    size = {"size": 32} if find is mixed_views else {"width": 32, "height": 32}
    wanted = find(scene, 3, **size)
    with setting():
        found = find(scene, 3, **size)
    assert torch.equal(found.viewmats, wanted.viewmats)
    assert torch.equal(found.Ks, wanted.Ks)


@settings
def test_seeds(setting):
    weights = torch.rand(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = stratified_seeds(weights, 600)
    with setting():
        found = stratified_seeds(weights, 600)
    assert all(map(torch.equal, found, wanted))


@pytest.mark.long
@settings
def test_positions_above_a_floor(setting):
    scene = make("courtyard", 500, sh_degree=0, seed=1)
    wanted = find_view_positions(scene)
    with setting():
        found = find_view_positions(scene)
    assert wanted.layout.floor is not None
    assert torch.equal(found.eyes, wanted.eyes)


@pytest.mark.long
@backends
@settings
def test_contributions(scene, setting, backend):
    cameras = automatic_views(scene, 1, width=600, height=32)  # beyond 8 bits
    wanted = contributions(scene, cameras, backend=backend)
    with setting():
        again = scene.select(scene.means[:, 0] > -torch.inf)  # made with the setting
        found = contributions(again, cameras, backend=backend)
    assert torch.equal(found, wanted)


def test_axes_first_used_in_inference_mode_work_with_gradients(scene):
    scene = scene.with_tensors({name: x.double() for name, x in scene.tensors().items()}, {})
    axes_module._sh_signs.cache_clear()
    for axes in ("rub", "rfu"):
        with torch.inference_mode():
            axes_module.change_axes(scene, "rdf", axes)
        leaf = scene.shN.clone().requires_grad_()
        turned = axes_module.change_axes(scene.with_tensors({"shN": leaf}, {}), "rdf", axes)
        turned.shN.square().sum().backward()
        torch.testing.assert_close(leaf.grad, 2 * scene.shN)


@pytest.mark.slow
@pytest.mark.parametrize("work", [simplify, simplify_by_images])
def test_scenes_that_require_gradients(scene, work):
    leaves = {name: values.clone().requires_grad_() for name, values in scene.tensors().items()}
    found = work(scene.with_tensors(leaves, {}))
    assert all(same_bits(one, other) for one, other in zip(found, work(scene), strict=True))
    assert not any(values.requires_grad for values in found[0].tensors().values())


def test_no_result_requires_gradients(scene):
    """Where all Gaussians are kept, they are in the memory of the scene, but as plain tensors."""
    leaves = {name: values.clone().requires_grad_() for name, values in scene.tensors().items()}
    heat = torch.rand(len(scene), requires_grad=True)
    trained = scene.with_tensors(leaves, {"heat": heat})
    simplifier = Simplifier(device="cpu")
    whole, small = (level.scene for level in simplifier.levels(trained, [1.0, 0.1]))
    for found in (whole, small, simplifier.simplify(trained, max_count=10**6)):
        tensors = [*found.tensors().values(), *found.extras.values()]
        assert not any(values.requires_grad for values in tensors)
    assert whole.means.data_ptr() == trained.means.data_ptr()
    assert torch.equal(whole.means, scene.means)
