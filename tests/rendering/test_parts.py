"""Splats that are listed and blended in parts give the image of one list."""

import pytest
import torch

pytest.importorskip("numba")

from cvtgs.rendering import contributions, numba_backend, render
from render_cases import around
from scenes import random_scene

VIEWS = around(2, 70, 50, 60.0)


def scene_of(logit, dtype=torch.float32):
    scene = random_scene(300, degree=1, seed=2, size=0.5, dtype=dtype)
    return scene.with_tensors({"logit_opacities": scene.logit_opacities + logit}, {})


def layers_and_gradients(scene):
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.tensors().items()}
    found = render(scene.with_tensors(leaves, {}), VIEWS, backend="numba", depth=True)
    (found.rgb.square().sum() + found.alpha.sum() + found.depth.sum()).backward()
    layers = [found.rgb.detach(), found.alpha.detach(), found.depth.detach()]
    return layers + [leaf.grad for leaf in leaves.values()]


@pytest.fixture
def listed(monkeypatch):
    """The intersections in splat order and in the tiles' lists, of each call."""
    found = []
    original = numba_backend._list_splats

    def record(splats, *rest):
        tiles = original(splats, *rest)
        found.append((int(splats.starts[-1]), len(tiles.lists)))
        return tiles

    monkeypatch.setattr(numba_backend, "_list_splats", record)
    return found


@pytest.mark.parametrize(
    ("logit", "dtype", "most"),
    [
        (-2.0, torch.float32, 40),
        (-2.0, torch.float64, 1000),
        (8.0, torch.float32, 100),
        (8.0, torch.float64, 15),
        (-2.0, torch.float32, None),  # all intersections of one image
    ],
)
def test_parts_give_the_bits_of_one_list(logit, dtype, most, listed, monkeypatch):
    scene = scene_of(logit, dtype)
    whole, sums = layers_and_gradients(scene), contributions(scene, VIEWS, backend="numba")
    total = listed[0][0]
    most = most or total
    assert total > 1000
    assert len(listed) == 4  # two images with their gradients, and two sums of weights
    listed.clear()
    monkeypatch.setattr(numba_backend, "INTERSECTIONS", most)
    for expected, found in zip(whole, layers_and_gradients(scene), strict=True):
        assert torch.equal(found, expected)
    torch.testing.assert_close(
        contributions(scene, VIEWS, backend="numba"), sums, rtol=1e-5, atol=1e-8
    )
    if most > 24:  # a splat of up to 24 tiles is never divided
        assert max(count for count, _ in listed) <= most
    assert len(listed) >= min(total // most, 300)


def test_later_parts_leave_out_finished_tiles(listed, monkeypatch):
    monkeypatch.setattr(numba_backend, "INTERSECTIONS", 100)
    render(scene_of(8.0), VIEWS, backend="numba")
    opaque = list(listed)
    listed.clear()
    render(scene_of(-6.0), VIEWS, backend="numba")
    assert all(count == kept for count, kept in listed)
    assert opaque[0][0] == opaque[0][1]
    assert sum(kept for _, kept in opaque) < 0.8 * sum(count for count, _ in opaque)


def test_parts_end_with_the_last_open_pixel(listed, monkeypatch):
    scene = scene_of(8.0)
    wide = scene.with_tensors({"log_scales": scene.log_scales + 3}, {})
    (camera, _) = VIEWS.singles()
    whole = render(wide, camera, backend="numba")
    ((total, _),) = listed
    listed.clear()
    monkeypatch.setattr(numba_backend, "INTERSECTIONS", 100)
    assert torch.equal(render(wide, camera, backend="numba").rgb, whole.rgb)
    assert sum(count for count, _ in listed) < 0.5 * total


def test_a_scene_out_of_sight_has_no_parts(listed):
    scene = scene_of(0.0)
    (camera, _) = VIEWS.singles()
    ahead = camera.viewmats[0, 2, :3].to(scene.means)
    behind = scene.with_tensors({"means": scene.means - 1000 * ahead}, {})
    image = render(behind, camera, backend="numba", background=(0.25, 0.25, 0.25))
    assert image.rgb.unique().tolist() == [0.25]
    assert not image.alpha.any()
    assert not listed
