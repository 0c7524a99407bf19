"""Cameras: invalid ones are refused; selection of every ``stride``-th pixel."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cvtgs.cameras import Cameras, join_cameras, look_at, view_scales
from cvtgs.errors import InvalidArgumentError
from cvtgs.rendering import render
from refine_cases import ring
from scenes import random_scene

GOOD = {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 4, "height": 3}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"viewmats": torch.eye(3)[None]},
            "viewmats must be a tensor of floats of shape (c, 4, 4), "
            "found torch.float32 of shape (1, 3, 3).",
        ),
        (
            {"Ks": torch.ones(1, 3, 3, dtype=torch.int64)},
            "Ks must be a tensor of floats of shape (1, 3, 3), "
            "found torch.int64 of shape (1, 3, 3).",
        ),
        (
            {"Ks": torch.eye(3).double()[None]},
            "viewmats and Ks must share device and dtype, found torch.float32 on cpu and "
            "torch.float64 on cpu.",
        ),
        (
            {"viewmats": torch.eye(4)},
            "viewmats must be a tensor of floats of shape (c, 4, 4), "
            "found torch.float32 of shape (4, 4).",
        ),
        ({"strides": 5}, "strides must be a tuple of type int, found 5."),
        ({"ignores_tag": 5}, "ignores_tag must be a tuple of type bool, found 5."),
        ({"width": 0}, "width must be a whole number above 0, found 0."),
        ({"height": 2.5}, "height must be a whole number above 0, found 2.5."),
        ({"strides": (0,)}, "every stride must be a whole number above 0, found 0."),
        ({"strides": (2, 2)}, "strides must hold one entry per camera, 1; found 2."),
        (
            {"width": torch.tensor(2.5)},
            "width must be a whole number above 0, found tensor(2.5000).",
        ),
        (
            {"viewmats": torch.eye(4)[None].numpy()},
            "viewmats must be a tensor of floats of shape (c, 4, 4), found ndarray.",
        ),
        ({"names": ("a", "b")}, "names must hold one entry per camera, 1; found 2."),
        ({"names": "a"}, "names must be a tuple of type str, found 'a'."),
        ({"names": (1,)}, "names must be a tuple of type str, found (1,)."),
        ({"ignores_tag": ("no",)}, "ignores_tag must be a tuple of type bool, found ('no',)."),
        (
            {"ignores_tag": (True, False)},
            "ignores_tag must hold one entry per camera, 1; found 2.",
        ),
    ],
)
def test_invalid_cameras_are_refused(changes, text):
    with pytest.raises(InvalidArgumentError) as caught:
        Cameras(**GOOD | changes)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("work", "text"),
    [
        (lambda camera: camera.every(0), "stride must be a whole number above 0, found 0."),
        (lambda camera: camera.in_two_sizes(0), "factor must be a whole number above 0, found 0."),
        (lambda camera: camera.interleaved(0), "stride must be a whole number above 0, found 0."),
        (lambda camera: camera.fitted(-5), "side must be a whole number above 0, found -5."),
        (lambda camera: camera.spread(-1), "count must be a whole number above 0, found -1."),
        (lambda camera: camera.resized("a", 1), "width must be a whole number above 0, found 'a'."),
        (lambda camera: camera.resized(8.5, 6), "width must be a whole number above 0, found 8.5."),
    ],
)
def test_sizes_that_are_no_whole_numbers_are_refused(work, text):
    with pytest.raises(InvalidArgumentError) as caught:
        work(Cameras(**GOOD))
    assert str(caught.value) == text


@pytest.mark.parametrize(
    "first", [(1,), 1, None, ("a", "b"), (0, 0, 0), (2, 0), (0, 5), (-1, 0), (0.5, 0)]
)
def test_first_pixels_beyond_the_stride_are_refused(first):
    with pytest.raises(InvalidArgumentError) as caught:
        Cameras(**GOOD).every(2, first=first)
    text = f"first must be a column from 0 to 1 and a row from 0 to 1, found {first!r}."
    assert str(caught.value) == text


@pytest.mark.parametrize("is_column", [True, False])
def test_first_pixels_beyond_the_image_are_refused(is_column):
    cameras = Cameras(**GOOD)
    width, height = cameras.width, cameras.height
    assert len(cameras.every(1000, first=(width - 1, height - 1))) == len(cameras)
    wish = f"a column from 0 to {width - 1} and a row from 0 to {height - 1}"
    with pytest.raises(InvalidArgumentError, match=f"^first must be {wish}, found"):
        cameras.every(1000, first=(width, 0) if is_column else (0, height))


@pytest.mark.parametrize(
    ("points", "found"),
    [
        (torch.zeros(3), "torch.float32 of shape (3,)"),
        (torch.zeros(5, 2), "torch.float32 of shape (5, 2)"),
        (torch.zeros(5, 3, dtype=torch.int64), "torch.int64 of shape (5, 3)"),
        (torch.zeros(5, 3).numpy(), "ndarray"),
        ([[0.0, 0.0, 1.0]], "list"),
        (None, "NoneType"),
    ],
)
def test_points_of_another_shape_are_refused(points, found):
    with pytest.raises(InvalidArgumentError) as caught:
        Cameras(**GOOD).shows_any(points)
    assert str(caught.value) == f"points must be a tensor of floats of shape (n, 3), found {found}."


def test_every_second_pixel_by_hand():
    """Pixel 3 of a row, the second of those kept from 1 on, keeps its place: at 3.5, now at 1.5."""
    Ks = torch.tensor([[[10.0, 0, 4], [0, 12, 3], [0, 0, 1]]])  # noqa: N806
    found = Cameras(viewmats=torch.eye(4)[None], Ks=Ks, width=8, height=5).every(2, first=(1, 0))
    assert (found.width, found.height, found.strides) == (4, 3, (2,))
    assert found.Ks[0].tolist() == [[5, 0, 1.75], [0, 6, 1.75], [0, 0, 1]]
    slope = (3.5 - 4) / 10
    assert 5 * slope + 1.75 == 1.5
    assert found.every(2).strides == (4,)


def test_interleaved_cameras_start_at_their_own_first_pixels():
    Ks = torch.tensor([[[10.0, 0, 4], [0, 12, 3], [0, 0, 1]]])  # noqa: N806
    one = Cameras(viewmats=torch.eye(4)[None], Ks=Ks, width=8, height=5)
    five = one.select(torch.zeros(5, dtype=torch.int64))
    found = five.interleaved(2)
    assert (found.width, found.height, found.strides) == (4, 2, (2,) * 5)
    for camera, first in zip(found.Ks, [(0, 0), (1, 0), (0, 1), (1, 1), (0, 0)], strict=True):
        assert torch.equal(camera, one.every(2, first=first).Ks[0])
    assert five.interleaved(1) is five


def test_cameras_are_selected_by_rows_and_by_masks():
    views = torch.eye(4).repeat(3, 1, 1) * torch.tensor([1.0, 2, 3])[:, None, None]
    three = Cameras(
        **GOOD | {"viewmats": views, "Ks": torch.eye(3).repeat(3, 1, 1)}, names=("a", "b", "c")
    )
    mask = torch.tensor([True, False, True])
    for rows in (torch.tensor([0, 2]), mask, mask.numpy(), [0, -1], slice(0, 3, 2)):
        for found in (three.select(rows), three[rows]):
            assert (found.names, found.viewmats[:, 0, 0].tolist()) == (("a", "c"), [1, 3])
    with pytest.raises(InvalidArgumentError, match=r"found 0; write \[0\] for a single one"):
        three[0]
    with pytest.raises(InvalidArgumentError, match="for each of 3 cameras, found 2"):
        three.select(torch.tensor([True, False]))
    with pytest.raises(InvalidArgumentError, match="must be from -3 to 2, found 3"):
        three.select(torch.tensor([3]))


def test_sizes_may_be_numbers_of_numpy_and_torch():
    cameras = Cameras(**GOOD | {"width": torch.tensor(8), "height": np.int64(6)}, strides=[2])
    assert (type(cameras.width), type(cameras.height)) == (int, int)
    assert cameras.strides == (2,)
    assert cameras.fitted(torch.tensor(4)).width == 4
    strided = cameras.every(torch.tensor(2))
    assert (strided.width, strided.height, strided.strides) == (4, 3, (4,))
    assert type(strided.strides[0]) is int


@pytest.mark.parametrize(
    ("target", "up", "text"),
    [
        ((1.0, 2, 3), (0.0, 1, 0), "targets must be finite and differ from the positions"),
        ((math.nan, 2, 3), (0.0, 1, 0), "targets must be finite and differ from the positions"),
        ((0.0, 0, 0), (0.0, 0, 0), "up must be a finite direction other than 0"),
    ],
)
def test_directions_that_do_not_exist_are_refused(target, up, text):
    eyes, targets = torch.tensor([[0.0, 9, 0], [1, 2, 3]]), torch.tensor([[0.0] * 3, target])
    with pytest.raises(InvalidArgumentError, match=text):
        look_at(eyes, targets, torch.tensor(up))


@pytest.mark.parametrize("size", [1e-30, 1e-20, 1e20, 1e30])
def test_targets_may_be_at_any_distance(size):
    eyes, up = torch.zeros(1, 3), torch.tensor([0.0, -1.0, 0.0])
    target = torch.tensor([[1.0, 2.0, 3.0]])
    found = look_at(eyes, size * target, size * up)
    torch.testing.assert_close(found, look_at(eyes, target, up), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("eyes", "targets", "text"),
    [
        ([[0.0, 0, 0]], torch.ones(1, 3), "eyes must be a tensor of floats of shape (c, 3), found"),
        (torch.zeros(1, 3).int(), torch.ones(1, 3), "found torch.int32 of shape (1, 3)."),
        (torch.zeros(2, 4), torch.ones(2, 4), "found torch.float32 of shape (2, 4)."),
        (torch.zeros(1, 3), torch.ones(3), "targets must be a tensor of floats of shape (1, 3), f"),
    ],
)
def test_wrong_positions(eyes, targets, text):
    with pytest.raises(InvalidArgumentError) as caught:
        look_at(eyes, targets, torch.tensor([0.0, -1.0, 0.0]))
    assert text in str(caught.value)


def test_cameras_may_share_a_target_and_up_may_be_of_whole_numbers():
    eyes, target = torch.randn(3, 3), torch.tensor([[0.0, 0.0, 9.0]])
    wanted = look_at(eyes, target.expand(3, 3), torch.tensor([0.0, -1.0, 0.0]))
    assert torch.equal(look_at(eyes, target, torch.tensor([0, -1, 0])), wanted)
    with pytest.raises(InvalidArgumentError, match=r"of shape \(3, 3\) or .*, found .*\(2, 3\)"):
        look_at(eyes, torch.zeros(2, 3), torch.tensor([0, -1, 0]))


def test_positions_may_have_several_dtypes():
    eyes, targets = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 5.0]], dtype=torch.float64)
    found = look_at(eyes, targets, torch.tensor([0.0, -1.0, 0.0]))
    assert found.dtype == torch.float64
    assert torch.equal(found, look_at(eyes.double(), targets, torch.tensor([0.0, -1.0, 0.0])))


def test_a_camera_may_look_along_its_up_direction():
    found = look_at(torch.zeros(1, 3), torch.tensor([[0.0, 5, 0]]), torch.tensor([0.0, -2, 0]))
    rotation = found[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))
    assert rotation[2].tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("point", "is_seen"),
    [
        ((0, 0, 1), True),
        ((3.9, 2.9, 1), True),
        ((4.1, 0, 1), False),
        ((0, 3.1, 1), False),
        ((-0.1, 0, 1), False),
        ((8, 6, 2.1), True),
        ((0, 0, -1), False),
        ((0, 0, 0.011), True),
        ((0, 0, 0.009), False),  # nearer than the near plane, where renderers draw nothing
    ],
)
def test_whether_a_point_is_in_an_image(point, is_seen):
    points = torch.tensor([[9.0, 9, 1], point])
    assert Cameras(**GOOD).shows_any(points) is is_seen


def test_about_every_second_camera_sees_a_larger_image():
    four = Cameras(**GOOD).select(torch.zeros(4, dtype=torch.int64))
    found = four.in_two_sizes(3)
    assert found.strides == (1, 3, 3, 1)
    assert found.every(2).strides == (2, 6, 6, 2)
    assert four.every(2).in_two_sizes(3).strides == (2, 6, 6, 2)
    assert found.select(torch.tensor([3, 2])).strides == (1, 3)
    assert [single.strides for single in found.singles()] == [(1,), (3,), (3,), (1,)]
    assert torch.equal(found.Ks, four.Ks)
    assert (found.width, found.height) == (four.width, four.height)
    assert four.in_two_sizes(1) is four


def test_a_loop_over_cameras_gives_single_ones():
    two = Cameras(**GOOD).select([0, 0]).every(2)
    assert [len(camera) for camera in two] == [1, 1]
    assert next(iter(two)).strides == (2,)
    assert list(two.select([])) == []


def test_about_every_third_camera_ignores_the_tag():
    four = Cameras(**GOOD).select(torch.zeros(4, dtype=torch.int64)).in_both_modes()
    assert four.ignores_tag == (False, False, True, False)
    assert four.select(torch.tensor([3, 2])).ignores_tag == (False, True)
    assert four.in_both_modes() is four
    single = four.every(2).to("cpu").singles()[2]
    assert single.ignores_tag == (True,)
    assert Cameras(**GOOD).singles()[0].ignores_tag == ()


@pytest.mark.parametrize("step", [1, 7, 8, 9, 10])
def test_held_out_cameras_are_of_both_kinds(step):
    many = Cameras(**GOOD).select(torch.zeros(300, dtype=torch.int64))
    many = many.in_two_sizes(2).in_both_modes()
    modes, strides = many.ignores_tag[step // 2 :: step], many.strides[step // 2 :: step]
    assert sum(modes) / len(modes) == pytest.approx(1 / 3, abs=0.07)
    assert strides.count(2) / len(strides) == pytest.approx(1 / 2, abs=0.07)
    for first in range(0, len(modes) - 8):
        assert len(set(modes[first : first + 8])) == 2
        assert len(set(strides[first : first + 8])) == 2


def test_a_uniform_scale_of_a_view_changes_neither_centre_nor_depth():
    plain = ring(1, width=64, height=64)
    scaled = plain.viewmats.clone()
    scaled[:, :3] *= 2
    views = torch.cat([plain.viewmats, scaled])
    both = Cameras(viewmats=views, Ks=plain.Ks.repeat(2, 1, 1), width=64, height=64)
    torch.testing.assert_close(both.centers, both.centers[:1].expand(2, 3))
    scene = random_scene(50)
    images = render(scene, both, depth=True)
    torch.testing.assert_close(images.rgb[1], images.rgb[0])
    torch.testing.assert_close(images.depth[1], images.depth[0])


def test_autocast_does_not_move_cameras():
    eyes, up = random_scene(5).means, torch.tensor([0.0, -1.0, 0.0])
    wanted = look_at(eyes, eyes + 1, up)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(look_at(eyes, eyes + 1, up), wanted)


def test_autocast_changes_neither_centres_nor_what_is_seen():
    cameras = ring(4)
    wanted = cameras.centers
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(cameras.centers, wanted)
        assert not Cameras(**GOOD).shows_any(torch.tensor([[4.005, 1.0, 1.0]]))


def test_joined_cameras_keep_what_each_is_like():
    one, two = ring(2), ring(3).every(2, first=(0, 0))
    assert join_cameras([one, one]).strides == ()
    assert join_cameras([one, one]).ignores_tag == ()
    two = replace(two, width=one.width, height=one.height, ignores_tag=(True,) * len(two))
    joined = join_cameras([one, two])
    assert joined.strides == (1,) * len(one) + (2,) * len(two)
    assert joined.ignores_tag == (False,) * len(one) + (True,) * len(two)
    assert torch.equal(joined.Ks[len(one) :], two.Ks)
    assert torch.equal(joined.viewmats[: len(one)], one.viewmats)


def test_small_scales_of_view_matrices_are_no_rounding() -> None:
    viewmats = torch.eye(4).repeat(3, 1, 1)
    viewmats[:, :3, :3] *= torch.tensor([1.0005, 1.002, 0.998])[:, None, None]
    scales = view_scales(viewmats)
    assert scales[0] == 1.0
    torch.testing.assert_close(scales[1:], torch.tensor([1.002, 0.998]))


@pytest.mark.parametrize("digits", [4, 6])
def test_centres_are_where_renderers_put_cameras_with_rounded_rotations(digits: int) -> None:
    """Far from the origin, the transpose of a rounded rotation is the inverse of none."""
    eyes = torch.tensor([[500_000.0, 4_000_000.0, 100.0]], dtype=torch.float64)
    target = eyes + torch.tensor([[1.0, 2.0, 0.5]], dtype=torch.float64)
    viewmats = look_at(eyes, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    viewmats[:, :3, :3] = viewmats[:, :3, :3].round(decimals=digits)
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] @ eyes[:, :, None])[:, :, 0]
    cameras = Cameras(viewmats=viewmats, Ks=torch.eye(3)[None].double(), width=8, height=8)
    torch.testing.assert_close(cameras.centers, eyes, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_centres_have_the_dtype_of_the_cameras(dtype: torch.dtype) -> None:
    viewmats = torch.eye(4, dtype=dtype)[None]
    viewmats[0, :3, 3] = torch.tensor([1.0, 2.0, -4.0])
    cameras = Cameras(viewmats=viewmats, Ks=torch.eye(3, dtype=dtype)[None], width=8, height=8)
    assert torch.equal(cameras.centers, torch.tensor([[-1.0, -2.0, 4.0]], dtype=dtype))
