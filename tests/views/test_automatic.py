"""Automatic views: up direction, inside or outside, and well-placed cameras."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

import cvtgs
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import psnr
from cvtgs.math import parameters
from cvtgs.rendering import render
from cvtgs.synthetic import KINDS
from cvtgs.views import automatic_views, mixed_views, random_views
from cvtgs.views.automatic import choose_candidates
from cvtgs.views.layout import find_layout
from cvtgs.views.scoring import score_cameras
from scenes import random_scene

COUNT = 10_000
HALF = math.sqrt(0.5)
TURNS = {"y-down": (1.0, 0.0, 0.0, 0.0), "z-up": (HALF, -HALF, 0.0, 0.0)}


def generated(kind: str, count: int = COUNT) -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene(kind, count, sh_degree=0, seed=1)


def turned(scene: cvtgs.GaussianScene, quat: tuple[float, ...]) -> cvtgs.GaussianScene:
    matrix = parameters.quats_to_matrices(torch.tensor([quat]))[0]
    frames = parameters.quats_to_matrices(parameters.normalize_quats(scene.quats))
    tensors = {
        "means": scene.means @ matrix.T,
        "quats": parameters.matrices_to_quats(matrix @ frames),
    }
    return scene.with_tensors(tensors, scene.extras)


def with_rows(scene: cvtgs.GaussianScene, **changes: Tensor) -> cvtgs.GaussianScene:
    """Append copies of the first Gaussian with other values."""
    count = len(next(iter(changes.values())))
    extra = scene.select(torch.zeros(count, dtype=torch.long)).with_tensors(changes, {})
    tensors = {
        name: torch.cat([old, extra.tensors()[name]]) for name, old in scene.tensors().items()
    }
    return scene.with_tensors(tensors, {})


def with_flyaways(scene: cvtgs.GaussianScene, count: int = 40) -> cvtgs.GaussianScene:
    g = torch.Generator().manual_seed(5)
    return with_rows(
        scene,
        means=1e4 * torch.randn(count, 3, generator=g),
        log_scales=torch.full((count, 3), 3.0),
        logit_opacities=torch.full((count,), 4.0),
    )


def ups(cameras: cvtgs.Cameras) -> Tensor:
    return -cameras.viewmats[:, 1, :3].float()


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn", TURNS)
def test_views_of_every_kind(kind, turn):
    if (kind, turn) == ("room", "z-up"):
        pytest.xfail("a closed room has no cue but its axes: y is taken as up")
    scene = turned(generated(kind), TURNS[turn])
    cameras = automatic_views(scene, 6, width=48, height=36)
    up = parameters.quats_to_matrices(torch.tensor([TURNS[turn]]))[0] @ torch.tensor(
        [0.0, -1.0, 0.0]
    )
    assert (ups(cameras) @ up > 0.5).all(), "images are upright"
    images = render(scene, cameras, depth=True)
    assert (images.alpha.mean(dim=(1, 2)) > 0.1).all(), "no image is empty"
    radius = find_layout(scene).frame.radius
    near = (images.alpha > 0.5) & (images.depth < 0.1 * radius)
    assert (near.float().mean(dim=(1, 2)) < 0.05).all(), "nothing is before the lens"
    assert (images.rgb.std(dim=(1, 2)).mean(dim=1) > 0.02).all(), "there is something to see"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_only_rooms_are_viewed_from_inside(kind):
    layout = find_layout(generated(kind))
    cameras, _ = choose_candidates(layout, 4, size=(64, 48), turn=0.5)[0]
    assert (layout.room is not None) == (kind == "room")
    distances = torch.linalg.vector_norm(cameras.centers.double() - layout.center, dim=1)
    assert (distances < layout.radius).all() == (kind == "room")


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_flyaways_hardly_change_the_views(kind):
    scene = generated(kind)
    plain = automatic_views(scene, 4, width=32, height=24)
    strewn = automatic_views(with_flyaways(scene), 4, width=32, height=24)
    radius = find_layout(scene).frame.radius
    moves = torch.linalg.vector_norm(plain.centers - strewn.centers, dim=1)
    assert float(moves.median()) < 0.3 * radius


@pytest.mark.slow
def test_a_camera_inside_of_a_floater_moves():
    scene = generated("object")
    first = automatic_views(scene, 4, width=32, height=24)
    blocked = with_rows(
        scene,
        means=first.centers[:1].float(),
        log_scales=torch.full((1, 3), math.log(0.4)),
        logit_opacities=torch.tensor([6.0]),
    )
    again = automatic_views(blocked, 4, width=32, height=24)
    moves = torch.linalg.vector_norm(first.centers - again.centers, dim=1)
    assert float(moves[0]) > 0.4
    layout = find_layout(blocked)
    distances = torch.linalg.vector_norm(again.centers.double() - layout.center, dim=1)
    assert layout.room is None
    assert bool(score_cameras(layout, again, distances=distances)[0].all())


@pytest.mark.slow
def test_a_camera_moves_if_a_wall_blocks_its_view():
    scene = generated("object")
    first = automatic_views(scene, 1, width=32, height=24)
    grid = torch.linspace(-0.6, 0.6, 13)
    right, down, ahead = first.viewmats[0, :3, :3].float()
    spots = torch.cartesian_prod(grid, grid)
    wall = first.centers.float() + 0.8 * ahead + spots[:, :1] * right + spots[:, 1:] * down
    walled = with_rows(
        scene,
        means=wall,
        log_scales=torch.full((len(wall), 3), math.log(0.06)),
        logit_opacities=torch.full((len(wall),), 6.0),
    )
    again = automatic_views(walled, 1, width=32, height=24)
    seen = render(walled, again, depth=True)
    before = render(walled, first, depth=True)
    assert float((before.depth < 1.0).float().mean()) > 0.3
    assert float(((seen.alpha > 0.5) & (seen.depth < 1.0)).float().mean()) < 0.1


@pytest.mark.slow
def test_the_same_scene_gives_the_same_views():
    scene = generated("courtyard", 5000)
    one, two = (automatic_views(scene, 5, width=40, height=30) for _ in range(2))
    assert torch.equal(one.viewmats, two.viewmats)
    assert one.names == ("view 1", "view 2", "view 3", "view 4", "view 5")
    assert (one.width, one.height) == (40, 30)
    other = automatic_views(scene, 5, width=40, height=30, seed=1)
    assert not torch.equal(one.viewmats, other.viewmats)


@pytest.mark.slow
def test_the_scene_is_in_the_middle_of_upright_images():
    scene = turned(generated("object"), (0.9, 0.2, 0.1, 0.3))
    cameras = automatic_views(scene, 4, width=64, height=64)
    center = scene.means.median(dim=0).values
    viewmats = cameras.viewmats.float()
    local = viewmats[:, :3, :3] @ center + viewmats[:, :3, 3]
    assert (local[:, :2].abs() < 0.2 * local[:, 2:]).all()
    matrix = parameters.quats_to_matrices(
        parameters.normalize_quats(torch.tensor([[0.9, 0.2, 0.1, 0.3]]))
    )[0]
    assert (ups(cameras) @ (matrix @ torch.tensor([0.0, -1, 0])) > 0.7).all()


@pytest.mark.parametrize("count", [1, 2, 3, 50])
@pytest.mark.slow
def test_scenes_of_few_gaussians_have_views(count):
    scene = random_scene(count, seed=count)
    cameras = automatic_views(scene, 3, width=32, height=24)
    assert bool(torch.isfinite(cameras.viewmats).all())
    assert len(cameras) == 3


@pytest.mark.slow
def test_faint_coinciding_and_flat_scenes_have_views():
    scene = random_scene(200)
    faint = scene.with_tensors({"logit_opacities": torch.full((200,), -5.0)}, {})
    heap = scene.with_tensors({"means": torch.ones(200, 3)}, {})
    flat = scene.with_tensors({"means": scene.means * torch.tensor([1.0, 1.0, 0.0])}, {})
    for one in (faint, heap, flat, with_flyaways(heap, 3)):
        assert bool(torch.isfinite(automatic_views(one, 2, width=32, height=24).viewmats).all())


@pytest.mark.slow
def test_infinite_opacities_and_bad_rows_do_no_harm():
    scene = generated("object", 2000)
    logits = scene.logit_opacities.clone()
    logits[:10] = math.inf
    means = scene.means.clone()
    means[20:30] = math.nan
    damaged = scene.with_tensors({"logit_opacities": logits, "means": means}, {})
    assert bool(torch.isfinite(automatic_views(damaged, 2, width=32, height=24).viewmats).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["32", "64"])
@pytest.mark.parametrize(
    "choose",
    [
        lambda scene: automatic_views(scene, 3, width=64, height=48),
        lambda scene: random_views(scene, 3, size=64, seed=0),
        lambda scene: mixed_views(scene, 4, size=64),
    ],
    ids=["automatic", "random", "mixed"],
)
@pytest.mark.long
def test_views_of_a_georeferenced_scene_are_those_of_the_scene_at_the_origin(dtype, choose):
    """At 6e6 float32 resolves steps of 0.5; the scene spans a kilometre and is rounded to them."""
    scene = generated("object", 2000)
    shift = torch.tensor([6e6, -5e5, 3e6], dtype=torch.float64)
    tensors = {name: values.to(dtype) for name, values in scene.tensors().items()}
    tensors["log_scales"] = tensors["log_scales"] + math.log(1e3)
    means = (1e3 * scene.means.double() + shift).to(dtype)
    far = scene.with_tensors(tensors | {"means": means}, {})
    near = far.with_tensors({"means": (means.double() - shift).to(dtype)}, {})
    there, here = choose(far), choose(near)
    assert there.viewmats.dtype == there.Ks.dtype == torch.float64
    torch.testing.assert_close(there.centers - shift, here.centers, rtol=0, atol=1e-5)
    for backend in ("torch", "numba"):
        one, other = (render(*pair, backend=backend).rgb for pair in ((far, there), (near, here)))
        assert float(one.std()) > 0.05
        assert float(psnr(one.clamp(0, 1), other.clamp(0, 1)).amin()) > 60


def test_bad_arguments_are_refused():
    scene = random_scene(10)
    for words, text in (
        ({"count": 0}, "count must be a whole number above 0, found 0."),
        ({"count": 1.5}, "count must be a whole number above 0, found 1.5."),
        ({"seed": 0.5}, "seed must be a whole number, found 0.5."),
        ({"width": 0}, "width must be a whole number above 0, found 0."),
    ):
        with pytest.raises(ValueError, match=text):
            automatic_views(scene, **words)
    bad = scene.with_tensors({"means": torch.full((10, 3), math.nan)}, {})
    with pytest.raises(cvtgs.errors.InvalidSceneError, match="none of 10 is valid"):
        automatic_views(bad)


def test_large_scenes_are_thinned_and_look_the_same(monkeypatch):
    """The Gaussians of the sample are enlarged, which keeps the mass and views of the scene."""
    scene = cvtgs.synthetic.scene("courtyard", 6000, sh_degree=0, seed=3)
    whole = find_layout(scene)
    monkeypatch.setattr("cvtgs.views.layout.SAMPLE_SIZE", 3000)
    monkeypatch.setattr("cvtgs.views.layout._HEAVIEST", 500)
    thinned = find_layout(scene)
    assert len(whole.sample) == 6000
    assert 2000 < len(thinned.sample) <= 3000
    torch.testing.assert_close(
        thinned.sample.masses.sum(), whole.sample.masses.sum(), rtol=0.1, atol=0.0
    )
    assert float(thinned.up @ whole.up) > 0.99
    assert abs(thinned.radius / whole.radius - 1) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("count", [500, 800, 1200])
def test_small_objects_are_no_rooms(count):
    for seed in range(3):
        scene = cvtgs.synthetic.scene("object", count, sh_degree=0, seed=seed)
        assert find_layout(scene).room is None
    room = cvtgs.synthetic.scene("room", 4000, sh_degree=0, seed=0)
    assert find_layout(room).room is not None


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_scenes_that_require_gradients_and_any_seeds():
    scene = random_scene(50)
    leaves = {name: values.clone().requires_grad_() for name, values in scene.tensors().items()}
    for seed in (0, 2**70, -1):
        found = automatic_views(scene.with_tensors(leaves), 2, width=32, height=32, seed=seed)
        wanted = automatic_views(scene, 2, width=32, height=32, seed=seed)
        assert torch.equal(found.viewmats, wanted.viewmats)
        assert not found.viewmats.requires_grad
    minus = [
        automatic_views(scene, 2, width=32, height=32, seed=seed).viewmats for seed in (-1, -2)
    ]
    assert not torch.equal(*minus)


@pytest.mark.slow
def test_numbers_of_numpy_are_accepted():
    scene = random_scene(50)
    count, seed = np.int64(8), np.int64(2)
    found = automatic_views(scene, count, width=32, height=24, seed=seed)
    wanted = automatic_views(scene, 8, width=32, height=24, seed=2)
    assert torch.equal(found.viewmats, wanted.viewmats)
    found = mixed_views(scene, count, size=32, seed=seed)
    assert torch.equal(found.viewmats, mixed_views(scene, 8, size=32, seed=2).viewmats)


@pytest.mark.parametrize("count", [-1, 1.5, None, True])
def test_random_views_need_a_whole_number_of_views(count):
    with pytest.raises(InvalidArgumentError, match=f"at least 0, found {count}"):
        random_views(random_scene(50), count, size=32, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("reach", [(1,), 1, None, (3, 1), (-1, 0), (0, math.nan), ("a", 2)])
def test_random_views_need_a_range_of_distances(reach):
    with pytest.raises(InvalidArgumentError, match="two ascending numbers of at least 0, found"):
        random_views(random_scene(50), 2, size=32, seed=0, reach=reach)
