"""What the layout of a scene is read from, with answers found by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidSceneError
from cvtgs.math.frames import RobustFrame
from cvtgs.views import automatic, layout, mixed, own, positions, scoring, up
from cvtgs.views.layout import SceneLayout
from cvtgs.views.scoring import SplatSizes
from cvtgs.views.up import Voxels
from scenes import random_scene

UP = torch.tensor([0.0, 0.0, 1.0]).double()


def sphere(count: int = 2000) -> Tensor:
    """Return evenly spread unit vectors."""
    steps = torch.arange(count).double() + 0.5
    heights, angles = 1 - 2 * steps / count, steps * math.pi * (3 - math.sqrt(5))
    widths = (1 - heights.square()).sqrt()
    return torch.stack([widths * angles.cos(), widths * angles.sin(), heights], dim=1)


def voxels_at(points: Tensor, normals: Tensor | None = None) -> Voxels:
    return Voxels(
        points=points,
        normals=points if normals is None else normals.expand_as(points),
        log_sizes=torch.zeros(len(points)).double(),
    )


def layout_of(**changes) -> SceneLayout:
    frame = RobustFrame(center=torch.zeros(3).double(), radius=1.0)
    plain = {"frame": frame, "up": UP, "floor": None, "room": None, "cutaway": None}
    return replace(layout.find_layout(random_scene(20)), **plain | changes)


def test_a_surface_hides_what_is_behind_it_but_not_what_is_beside_or_before_it():
    wall = torch.cartesian_prod(torch.linspace(-0.5, 0.5, 11), torch.linspace(-0.5, 0.5, 11))
    points = torch.cat([torch.ones(121, 1), wall], dim=1).double()
    behind, before, beside, over = [2.0, 0, 0.03], [0.8, 0, 0], [2.0, 1.4, 0], [2.0, 0, 1.4]
    eyes = torch.tensor([behind, before, beside, over, [-2.0, 0, 0], [0.0, 0, 0]]).double()
    hidden = layout.are_hidden(eyes, torch.zeros(3).double(), points)
    assert hidden.tolist() == [True, False, False, False, False, False]


def test_nobody_stands_behind_the_walls_of_a_room_that_is_open_to_a_side():
    steps = torch.linspace(-1.0, 1.0, 41).double()
    across, up = torch.cartesian_prod(steps, 0.6 * steps).unbind(1)
    wall = torch.stack([torch.ones_like(across), across, up], dim=1)
    ahead, aside = torch.cartesian_prod(steps, steps).unbind(1)
    ceiling = torch.stack([ahead, aside, torch.full_like(ahead, 0.9)], dim=1)
    room = layout_of(voxels=voxels_at(torch.cat([wall, ceiling])), cutaway=torch.zeros(3).double())
    before, above = [-2.0, 0.0, 0.3], [-0.8, 0.0, 2.0]
    behind, over_the_wall = [2.0, 0.0, 0.3], [1.6, 0.0, 1.2]
    eyes = torch.tensor([before, above, behind, over_the_wall]).double()
    assert positions.stand_free(room, eyes).tolist() == [True, False, False, False]
    assert positions.stand_free(replace(room, cutaway=None), eyes).all()
    assert not layout.are_hidden(eyes[3:], UP * 0.0, wall).any()  # its line passes over the wall


def test_a_layout_is_found_from_valid_rows_only():
    scene = random_scene(20)
    means = scene.means.clone()
    means[3] = math.nan
    part = layout.viewable_part(scene.with_tensors({"means": means}))
    assert torch.equal(part.means, torch.cat([means[:3], means[4:]]))


def test_surfaces_beneath_do_not_enclose():
    directions, eye = sphere(), torch.zeros(3).double()
    assert layout.enclosure(eye, directions[directions @ UP < 0], UP) == 0.0
    assert layout.enclosure(eye, directions, UP) == 1.0
    one = torch.tensor([[0.5, 0.1, 0.9]]).double()
    assert layout.enclosure(eye, one, UP) == pytest.approx(1 / 60)


def test_a_flyaway_at_the_largest_float32_does_not_matter_but_a_whole_scene_there_is_refused():
    largest = torch.finfo(torch.float32).max
    scene = random_scene(200)
    means = scene.means / scene.means.abs().amax()
    with pytest.raises(InvalidSceneError, match=r"within 1e\+14 units of .* one of \S+e\+38 units"):
        layout.find_layout(scene.with_tensors({"means": largest * means}))
    means[:2] = torch.tensor([[largest, -largest, 0], [-largest, largest, 0]])
    assert layout.find_layout(scene.with_tensors({"means": means})).frame.radius < 2


@pytest.mark.parametrize(("least_height", "is_free"), [(-1.0, False), (0.0, True), (0.5, True)])
def test_only_what_is_hidden_from_above_and_below_is_inside_matter(least_height, is_free):
    points = sphere()
    points = points[points @ UP > least_height]
    eye = torch.zeros(1, 3).double()
    assert positions.stand_free(layout_of(voxels=voxels_at(points)), eye).tolist() == [is_free]


def test_positions_near_a_surface_are_not_free_in_units_of_the_radius():
    frame = RobustFrame(center=torch.ones(3).double(), radius=2.0)
    eyes = 1.0 + torch.tensor([[1.8, 0, 0], [1.6, 0, 0], [2.2, 0, 0], [2.4, 0, 0]]).double()
    place = layout_of(frame=frame, voxels=voxels_at(sphere()[:1000]))
    assert positions.stand_free(place, eyes).tolist() == [False, True, False, True]


def test_sides_seen_from_below_are_not_sharp(monkeypatch):
    def smallest(_, cameras) -> SplatSizes:
        return SplatSizes(*torch.zeros(3, len(cameras)))

    monkeypatch.setattr(positions, "splat_sizes", smallest)
    directions = vars(positions)["_side_directions"]()
    assert float((sphere() @ directions.T).amax(dim=1).amin()) > 0.85  # they are evenly spread
    sharp = vars(positions)["_sharp_sides"](layout_of(), 2 * directions)
    assert sharp.tolist() == (directions @ UP >= 0).tolist()
    assert int(sharp.sum()) == 16


def test_what_lies_beneath_a_floor_speaks_against_it():
    """Of 100 columns, 10 end one unit lower; 20 others carry something one unit above."""
    side = 0.15 * (torch.arange(10).double() + 0.5)
    floor = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, 1))
    points = torch.cat([floor, floor[:10] - UP, floor[10:30] + UP])
    found = vars(up)["_lowest_level"](voxels_at(points, UP), UP)
    trust = 1 - 3 * 10 / 130
    assert found.height == pytest.approx(0.1)
    assert found.share == pytest.approx(0.9 * trust)
    assert found.bare == pytest.approx(0.7 * trust)


def test_a_plane_is_fitted_to_its_points():
    """It rises by 0.2 along x, and the first guess is level."""
    side = torch.linspace(-2, 2, 41).double()
    points = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, 1))
    points[:, 2] = 0.2 * points[:, 0]
    found = vars(up)["_refined"](voxels_at(points, UP), UP, 0.0)
    wanted = torch.tensor([-0.2, 0.0, 1.0]).double() / math.sqrt(1.04)
    assert float((found.normal @ wanted).abs()) == pytest.approx(1.0)
    assert found.height == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("sky", [[0.0, 0, 1], [0.0, 0, -1], [1.0, 0, 0]])
def test_a_sky_shows_what_is_up(sky):
    found = up.find_up(voxels_at(sphere()), torch.tensor([sky] * 9).double())
    assert found.tolist() == sky


def test_a_floor_moves_with_the_scene(monkeypatch):
    monkeypatch.setattr(layout, "find_floor", lambda *_: -0.25)
    monkeypatch.setattr(layout, "find_up", lambda *_, **__: UP)
    scene = random_scene(20)
    shifted = scene.with_tensors({"means": scene.means + torch.tensor([5.0, 6.0, 7.0])}, {})
    heights = [layout.find_layout(one).floor for one in (scene, shifted)]
    assert heights[1] - heights[0] == pytest.approx(7.0, abs=1e-5)


def test_a_camera_is_inside_a_needle_only_along_it():
    """The needle points along x = y; its deviations are 2 and 0.1."""
    turn = math.radians(45) / 2
    needle = random_scene(1, degree=0).with_tensors(
        {
            "means": torch.zeros(1, 3),
            "quats": torch.tensor([[math.cos(turn), 0, 0, math.sin(turn)]]),
            "log_scales": torch.tensor([[2.0, 0.1, 0.1]]).log(),
            "logit_opacities": torch.full((1,), 3.0),
        },
        {},
    )
    eyes = torch.tensor([[1.5, 1.5, 0], [1.5, -1.5, 0], [4.0, 4.0, 0]]).double()
    cameras = scoring.cameras_at(eyes, eyes, UP, size=(8, 8), field=45.0)
    found = vars(scoring)["_inside_gaussians"](layout_of(sample=needle), cameras)
    assert found.tolist() == [True, False, False]


@pytest.mark.parametrize(("room", "least"), [(None, 1.4), (UP, 0.2)])
def test_alternates_around_a_scene_are_not_near(room, least):
    reaches = []

    def near(count: int, reach: tuple[float, float], seed: int) -> Tensor:
        reaches.append((reach, seed))
        return 2 * torch.eye(3)[:count].double()

    place = SimpleNamespace(layout=layout_of(room=room), near=near)
    found = automatic.found_candidates(place, 2, size=(8, 8), seed=5)
    assert reaches == [((least, 3.0), 5), ((least, 3.0), 6)]
    assert [len(cameras) for cameras, _ in found] == [2, 2]


def test_random_views_aim_at_an_eighth_of_a_radius_around_the_middle():
    frame = RobustFrame(center=torch.tensor([5.0, 6.0, 7.0]).double(), radius=2.0)
    place = SimpleNamespace(layout=layout_of(frame=frame))
    aims = vars(mixed)["_targets"](place, torch.zeros(2000, 3).double(), 0) - frame.center
    torch.testing.assert_close(aims.amax(dim=0), torch.full((3,), 0.25).double(), rtol=0.02, atol=0)
    torch.testing.assert_close(-aims.amin(dim=0), aims.amax(dim=0), rtol=0.02, atol=0)


@pytest.mark.parametrize(
    ("pixel", "is_seen"),
    [((90, 40), True), ((90, 60), False), ((110, 40), False), ((5, -1), False)],
)
def test_a_camera_looks_at_what_is_in_its_image(pixel, is_seen):
    cameras = Cameras(
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[100.0, 0, 50], [0, 100, 25], [0, 0, 1]]]),
        width=100,
        height=50,
    )
    place = torch.tensor([[2 * (pixel[0] - 50) / 100, 2 * (pixel[1] - 25) / 100, 2.0]])
    tensors = {"means": place, "logit_opacities": torch.ones(1)}
    scene = random_scene(1).with_tensors(tensors, {})
    assert vars(own)["_looking"](cameras, scene).tolist() == [is_seen]


@pytest.mark.parametrize(("count", "growth"), [(7, 0.0), (8, 1.0)])
def test_eight_gaussians_in_a_direction_show_how_sizes_grow(count, growth):
    x = 0.5 * torch.arange(1, count + 1, dtype=torch.float64)
    sized = layout.SizedPoints(torch.stack([x, 0 * x, 0 * x], dim=1), x.log())
    eye = torch.zeros(1, 3, dtype=torch.float64)
    assert layout.size_growths(sized, eye, 1.0) == pytest.approx([growth])


def test_a_floor_with_half_of_all_beneath_it_counts_as_none():
    side = 0.15 * (torch.arange(10).double() + 0.5)
    floor = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, 1))
    below = torch.cat([floor[:10] - (1 + 0.3 * step) * UP for step in range(10)])
    found = vars(up)["_lowest_level"](voxels_at(torch.cat([floor, below]), UP), UP)
    assert (found.share, found.bare) == (0.0, 0.0)
