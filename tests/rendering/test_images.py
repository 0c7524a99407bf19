"""Images, by every backend that is installed: hand-computed, shapes, error texts."""

import math
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from cvtgs.errors import InvalidArgumentError, OutOfMemoryError
from cvtgs.rendering import blending_weights, contributions, observe, render
from render_cases import MIP, around, backends, dtypes, scene_of, straight
from scenes import random_scene

# Hand-computed answers


@backends
@dtypes
def test_one_gaussian(backend, dtype):
    """Variance (20 px / 2 units * 0.1)^2 + 0.3 = 1.3 squared pixels, centre at (4.5, 3.5)."""
    scene = scene_of(((0, 0, 2), (0.1, 0.1, 0.1), 0.8, (1.0, 0.5, 0.25)), dtype=dtype)
    found = render(scene, straight(), backend=backend, depth=True)
    assert found.rgb.dtype == found.alpha.dtype == dtype
    for y in range(7):
        for x in range(9):
            alpha = 0.8 * math.exp(-((x - 4) ** 2 + (y - 3) ** 2) / (2 * 1.3))
            alpha = alpha if alpha >= 1 / 255 else 0.0
            assert found.alpha[0, y, x].item() == pytest.approx(alpha, abs=1e-6)
            color = [alpha, 0.5 * alpha, 0.25 * alpha]
            assert found.rgb[0, y, x].tolist() == pytest.approx(color, abs=1e-6)
            assert found.depth[0, y, x].item() == pytest.approx(2.0 if alpha else 0.0, rel=1e-4)


@backends
def test_the_nearer_of_two_is_in_front_whatever_their_order(backend):
    near = ((0, 0, 2), (0.5, 0.5, 0.5), 0.6, (1.0, 0, 0))
    far = ((0, 0, 3), (0.75, 0.75, 0.75), 0.5, (0, 1.0, 0))
    for rows in ((near, far), (far, near)):
        pixel = render(scene_of(*rows), straight(), backend=backend).rgb[0, 3, 4].tolist()
        assert pixel == pytest.approx([0.6, 0.4 * 0.5, 0.0])


@backends
def test_equal_depths_keep_the_order_of_the_scene(backend):
    rows = [((0, 0, 2), (0.5, 0.5, 0.5), 0.6, color) for color in ((1.0, 0, 0), (0, 1.0, 0))]
    assert render(scene_of(*rows), straight(), backend=backend).rgb[0, 3, 4].tolist() == (
        pytest.approx([0.6, 0.4 * 0.6, 0.0])
    )


@backends
def test_background_shines_through(backend):
    scene = scene_of(((0, 0, 2), (0.5, 0.5, 0.5), 0.25, (1.0, 0, 0)))
    cameras = straight()
    found = render(scene, cameras, backend=backend, background=torch.tensor([0.0, 1.0, 0.5]))
    assert found.rgb[0, 3, 4].tolist() == pytest.approx([0.25, 0.75, 0.375])
    for color in ((0.0, 1, 0.5), [0, 1.0, 0.5]):
        same = render(scene, cameras, backend=backend, background=color)
        assert torch.equal(same.rgb, found.rgb)
    two = replace(cameras, viewmats=cameras.viewmats.repeat(2, 1, 1), Ks=cameras.Ks.repeat(2, 1, 1))
    each = torch.tensor([[0.0, 0, 0], [1.0, 1, 1]])
    found = render(scene, two, backend=backend, background=each).rgb[:, 3, 4]
    assert found[0].tolist() == pytest.approx([0.25, 0, 0])
    assert found[1].tolist() == pytest.approx([1.0, 0.75, 0.75])


@backends
def test_opacity_0_and_1(backend):
    scene = scene_of(((0, 0, 2), (0.5, 0.5, 0.5), 0.5, (1.0, 1.0, 1.0)))
    for logit, alpha in ((-math.inf, 0.0), (math.inf, 0.99), (40.0, 0.99), (-5.6, 0.0)):
        changed = scene.with_tensors({"logit_opacities": torch.tensor([logit]).double()}, {})
        found = render(changed, straight(), backend=backend)
        assert found.alpha[0, 3, 4].item() == pytest.approx(alpha)


@backends
def test_blending_stops_before_transmittance_falls_below_the_limit(backend):
    """0.02^2 = 4e-4 is left, and a third one would leave 8e-6; 0.5^13 is the last above 1e-4."""
    rows = [((0, 0, 2.0 + k), (9.0, 9.0, 9.0), 0.98, (1.0, 1.0, 1.0)) for k in range(4)]
    found = render(scene_of(*rows), straight(), backend=backend).alpha[0, 3, 4].item()
    assert found == pytest.approx(1 - 4e-4)
    faint = [((0, 0, 2.0 + k), (9.0, 9.0, 9.0), 0.5, (1.0, 1.0, 1.0)) for k in range(40)]
    found = render(scene_of(*faint), straight(), backend=backend).alpha[0, 3, 4].item()
    assert found == pytest.approx(1 - 0.5**13, abs=1e-5)


@backends
def test_antialiased_scenes_lose_what_the_dilation_adds(backend):
    """Bare variance 1, dilated 1.3: the opacity is multiplied by 1 / 1.3."""
    row = ((0, 0, 2), (0.1, 0.1, 0.1), 0.8, (1.0, 1.0, 1.0))
    for comments, alpha in (((), 0.8), (MIP, 0.8 / 1.3)):
        found = render(scene_of(row, comments=comments), straight(), backend=backend)
        assert found.alpha[0, 3, 4].item() == pytest.approx(alpha)


@backends
def test_depths_that_are_equal_in_float32_still_decide_the_order(backend):
    """The camera is turned by 1e-6, so the second Gaussian is 5e-8 units nearer, at depth 2."""
    rows = [((x, 0, 2), (0.3, 0.3, 0.3), 0.9, color) for x, color in
            ((0.0, (1.0, 0.0, 0.0)), (0.05, (0.0, 1.0, 0.0)))]  # fmt: skip
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 2], turn[2, 0] = 1e-6, -1e-6
    camera = replace(straight(), viewmats=turn[None], Ks=straight().Ks.double())
    red, green, _ = render(scene_of(*rows, dtype=torch.float32), camera, backend=backend).rgb[
        0, 3, 4
    ]
    assert float(green) > 5 * float(red)


@backends
def test_a_camera_may_ignore_the_tag(backend):
    """Image, contributions, both at once, and weights are then those of an untagged scene."""
    plain = random_scene(20)
    tagged = replace(plain, comments=MIP)
    cameras = around(2)
    mixed = replace(cameras, ignores_tag=(False, True))
    found = render(tagged, mixed, backend=backend).rgb
    assert torch.equal(found[0], render(tagged, cameras, backend=backend).rgb[0])
    assert torch.equal(found[1], render(plain, cameras, backend=backend).rgb[1])
    assert not torch.equal(found[1], render(tagged, cameras, backend=backend).rgb[1])
    (_, ignoring), (_, second) = mixed.singles(), cameras.singles()
    for measure in (contributions, lambda *a, **b: observe(*a, **b).contributions):
        given = measure(tagged, ignoring, backend=backend)
        assert torch.equal(given, measure(plain, second, backend=backend))
    ours, theirs = (
        blending_weights(scene, camera, backend=backend).powers()
        for scene, camera in ((tagged, ignoring), (plain, second))
    )
    assert torch.equal(ours, theirs)


@backends
def test_cameras_may_be_of_two_sizes(backend):
    """Every third pixel of a larger image, and an image of its own, are rendered together."""
    scene, cameras = random_scene(20), around(2, 18, 12)
    both = replace(cameras, strides=(1, 3))
    found = render(scene, both, backend=backend).rgb
    assert torch.equal(found[0], render(scene, cameras, backend=backend).rgb[0])
    larger = cameras.resized(54, 36).every(3, first=(1, 1))
    torch.testing.assert_close(found[1], render(scene, larger, backend=backend).rgb[1])
    assert not torch.allclose(found[1], render(scene, cameras, backend=backend).rgb[1], atol=1e-3)


# Shapes


@backends
@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 40), (16, 16), (17, 33)])
def test_any_size_and_number_of_cameras(backend, width, height):
    scene = random_scene(20, degree=1)
    for count in (0, 1, 3):
        cameras = around(count, width, height)
        found = render(scene, cameras, backend=backend, depth=True)
        assert found.rgb.shape == (count, height, width, 3)
        assert found.alpha.shape == found.depth.shape == (count, height, width)
        assert found.backend == backend
    assert render(scene, around(1), backend=backend).depth is None


@backends
@pytest.mark.parametrize("comments", [(), MIP])
@pytest.mark.parametrize(("stride", "first"), [(2, (0, 1)), (2, (1, 0)), (3, (2, 1))])
def test_strided_pixels_equal_those_of_the_whole_image(backend, comments, stride, first):
    scene = replace(random_scene(60, degree=1), comments=comments)
    cameras = around()
    whole = render(scene, cameras, backend=backend)
    some = render(scene, cameras.every(stride, first=first), backend=backend)
    column, row = first
    torch.testing.assert_close(
        some.rgb, whole.rgb[:, row::stride, column::stride], rtol=1e-3, atol=1e-4
    )
    torch.testing.assert_close(
        some.alpha, whole.alpha[:, row::stride, column::stride], rtol=1e-3, atol=1e-4
    )
    assert float((some.rgb - whole.rgb[:, : some.rgb.shape[1], : some.rgb.shape[2]]).std()) > 0.01


@backends
def test_no_gaussians_and_none_in_view(backend):
    background = torch.tensor([0.1, 0.2, 0.3])
    behind = scene_of(((0, 0, -2), (0.5, 0.5, 0.5), 0.9, (1.0, 1.0, 1.0)), dtype=torch.float32)
    empty = behind.select(torch.zeros(1, dtype=torch.bool))
    for scene in (behind, empty):
        found = render(scene, straight(), backend=backend, background=background, depth=True)
        assert torch.equal(found.rgb, background.expand(1, 7, 9, 3))
        assert not found.alpha.any()
        assert not found.depth.any()


# Error texts


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"background": torch.zeros(4)},
            "background must be three numbers, or a tensor of shape (3,) or (1, 3), found shape "
            "(4,).",
        ),
        (
            {"background": (0.5, 0.5)},
            "background must be three numbers, or a tensor of shape (3,) or (1, 3), found shape "
            "(2,).",
        ),
        (
            {"background": "white"},
            "background must be three numbers, or a tensor of shape (3,) or (1, 3), found 'white'.",
        ),
        (
            {"background": (0.0, math.nan, 0.0)},
            "background must be finite, found NaN or infinite numbers.",
        ),
        ({"listener": 5}, "listener must be a function of a progress event, found 5."),
        (
            {"sh_degree": 2},
            "sh_degree must be from 0 to 1, the degree of the scene, found 2.",
        ),
        (
            {"backend": "opengl"},
            "backend must be one of auto, torch, numba, gsplat, found 'opengl'.",
        ),
    ],
)
def test_wrong_arguments_are_refused(options, text):
    with pytest.raises(InvalidArgumentError) as caught:
        render(random_scene(3), around(1), **options)
    assert str(caught.value) == text


def test_numbers_beyond_floats_are_no_background():
    with pytest.raises(InvalidArgumentError, match="background must be three numbers, or a tensor"):
        render(random_scene(3), around(1), background=(10**400, 0, 0))


@pytest.mark.parametrize(
    ("changes", "wish"),
    [
        ({"viewmats": torch.full((1, 4, 4), math.nan)}, "finite viewmats and Ks"),
        (
            {"viewmats": torch.zeros(1, 4, 4)},
            "viewmats that rotate, with at most a uniform scale",
        ),
        (
            {"viewmats": torch.diag(torch.tensor([2.0, 2, 1, 1]))[None]},
            "viewmats that rotate, with at most a uniform scale",
        ),
        (
            {"viewmats": torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None]},
            "viewmats that rotate, with at most a uniform scale",
        ),
        (
            {"viewmats": torch.diag(torch.tensor([1.0, 1, 1, 2]))[None]},
            "viewmats with the last row 0, 0, 0, 1",
        ),
        (
            {"Ks": torch.tensor([[[9.0, 1, 4], [0, 9, 4], [0, 0, 1]]])},
            "Ks of pinhole cameras, focal lengths above 0 and no skew",
        ),
        (
            {"Ks": torch.tensor([[[9.0, 0, 4], [1, 9, 4], [0, 0, 1]]])},
            "Ks of pinhole cameras, focal lengths above 0 and no skew",
        ),
        (
            {"Ks": torch.tensor([[[-9.0, 0, 4], [0, 9, 4], [0, 0, 1]]])},
            "Ks of pinhole cameras, focal lengths above 0 and no skew",
        ),
        (
            {"Ks": torch.tensor([[[9.0, 0, 4], [0, 0, 4], [0, 0, 1]]])},
            "Ks of pinhole cameras, focal lengths above 0 and no skew",
        ),
        (
            {"Ks": torch.tensor([[[9.0, 0, math.inf], [0, 9, 4], [0, 0, 1]]])},
            "finite viewmats and Ks",
        ),
        ({"Ks": 2 * straight(dtype=torch.float32).Ks}, "Ks with the last row 0, 0, 1"),
    ],
)
@backends
def test_wrong_cameras_are_refused(backend, changes, wish):
    cameras = straight(dtype=torch.float32)
    with pytest.raises(InvalidArgumentError) as caught:
        render(random_scene(3), replace(cameras, **changes), backend=backend)
    assert str(caught.value) == f"cameras must have {wish}; 1 of 1 do not, the first is camera 0."


@pytest.mark.long
@pytest.mark.skipif(not find_spec("numba"), reason="needs numba")
def test_images_larger_than_the_memory_are_refused():
    huge = replace(straight(dtype=torch.float32), width=10**9, height=10**9)
    with pytest.raises(OutOfMemoryError, match=r"^rendering 1 x 1,000,000,000 x .* needs more mem"):
        render(random_scene(3), huge, backend="numba")
