"""Small parts of the search for views, with answers found by hand."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch

from cvtgs.cameras import Cameras, look_at
from cvtgs.math.frames import RobustFrame
from cvtgs.views import CameraPositions, automatic, layout, mixed, positions, scoring, up
from cvtgs.views.layout import SceneLayout
from cvtgs.views.scoring import SplatSizes
from cvtgs.views.up import Voxels
from scenes import random_scene

UP = torch.tensor([0.0, 0.0, 1.0]).double()
CENTER = torch.tensor([1.0, -2.0, 3.0]).double()


@cache
def some_layout() -> SceneLayout:
    return layout.find_layout(random_scene(50))


def layout_of(**changes) -> SceneLayout:
    """Return the layout of a small scene with other values, in the unit of robust radii."""
    frame = RobustFrame(center=torch.zeros(3).double(), radius=1.0)
    return replace(some_layout(), **{"frame": frame, "up": UP} | changes)


def test_cameras_around_a_scene_rise_by_the_elevation_and_show_all_of_it():
    """At 45 degrees of view, a ball of radius 2 fills the image from ``2 / sin(22.5)`` away."""
    found = automatic.outside_candidates(
        layout_of(bounded=True, center=CENTER, radius=2.0), 4, size=(64, 48), turn=0.0
    )
    away = 2 / math.sin(math.radians(22.5))
    for number, lift, factor in ((0, 0, 1.0), (1, 12, 1.0), (4, 8, 0.75), (11, 50, 1.5)):
        cameras, distances = found[number]
        offsets = cameras.centers.double() - CENTER
        lengths = torch.linalg.vector_norm(offsets, dim=1)
        assert lengths.tolist() == pytest.approx([factor * away] * 4)
        assert distances.tolist() == pytest.approx([factor * away] * 4)
        rises = torch.rad2deg(torch.asin(offsets @ UP / lengths))
        wanted = [min(80, elevation + lift) for elevation in (20, 35, 12, 28)]
        assert rises.tolist() == pytest.approx(wanted)
        ahead = cameras.viewmats[:, 2, :3].double()
        torch.testing.assert_close(ahead, -offsets / lengths[:, None], atol=1e-6, rtol=0)


def test_cameras_in_a_room_look_down_a_little():
    found = automatic.inside_candidates(layout_of(), CENTER, 3, size=(64, 48), turn=0.25)
    for cameras, _ in found:
        falls = torch.rad2deg(torch.asin(cameras.viewmats[:, 2, :3].double() @ UP))
        assert falls.tolist() == pytest.approx([-10.0] * 3)


def cameras_on_a_line(places: list[float]) -> Cameras:
    eyes = torch.zeros(len(places), 3).double()
    eyes[:, 0] = torch.tensor(places)
    return Cameras(
        viewmats=look_at(eyes, eyes + torch.tensor([0.0, 1.0, 0.0]).double(), UP),
        Ks=torch.eye(3).double().repeat(len(places), 1, 1),
        width=8,
        height=8,
    )


@pytest.mark.parametrize(
    ("penalties", "good", "best"),
    [
        ([0.5, 0.2, 0.4, 0.3], [0, 0, 0, 0], 1),
        ([0.5, 0.2, 0.4, 0.3], [0, 0, 1, 1], 2),
        ([0.0, 0.2, 0.4, 0.3], [1, 1, 0, 0], 0),
    ],
)
def test_the_first_good_camera_is_taken_or_else_that_of_least_penalty(
    monkeypatch, penalties, good, best
):
    def scored(_, cameras, **__):
        (number,) = cameras.centers[:, 0].round().long().tolist()
        return torch.tensor([bool(good[number])]), torch.tensor([penalties[number]]).double()

    monkeypatch.setattr(automatic, "score_cameras", scored)
    every = SimpleNamespace(layout=None, admit=lambda eyes: torch.ones(len(eyes)).bool())
    rounds = [(cameras_on_a_line([float(number)]), torch.ones(1)) for number in range(4)]
    found = vars(automatic)["_best"](every, rounds)
    assert found.centers[0, 0].item() == best


def test_every_cell_of_the_cube_has_a_number_of_its_own():
    side = (torch.arange(10).double() + 0.5) / 5 - 1
    cells = torch.cartesian_prod(side, side)
    ends = torch.ones(100, 1).double()
    faces = [
        torch.cat([cells[:, :axis], sign * ends, cells[:, axis:]], dim=1)
        for axis in range(3)
        for sign in (-1, 1)
    ]
    numbers = vars(layout)["_cells_of_cube"](3.0 * torch.cat(faces))
    assert sorted(numbers.tolist()) == list(range(600))


def test_only_far_content_of_two_percent_shows_the_sky():
    places = torch.zeros(100, 3).double()
    places[:3, 2] = 8.0
    directions = vars(layout)["_far_directions"]
    assert directions(places, places.norm(dim=1)).tolist() == [[0.0, 0.0, 1.0]] * 3
    assert len(directions(places[2:], places[2:].norm(dim=1))) == 0


def test_a_voxel_is_among_others_if_two_are_within_two_steps():
    near = torch.tensor([[1.05, 1.05, 1.05], [1.25, 1.05, 1.05], [1.05, 1.25, 0.85]]).double()
    alone = torch.tensor([[-2.05, 0.05, 0.05], [2.95, 2.95, 2.95], [2.75, 2.95, 2.95]]).double()
    assert up.among_others(torch.cat([near, alone])).tolist() == [True] * 3 + [False] * 3


def test_sizes_that_shrink_upwards_show_what_is_up():
    """Parts that no image shows, mostly undersides, have larger Gaussians."""
    g = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(50, 3, generator=g)] * 2).double()
    points[50:, :2] *= -1  # so that x and y are not correlated with the sizes
    points[:, :2] -= points[:, :2].mean(dim=0)
    voxels = Voxels(points=points, normals=points, log_sizes=-3 * points[:, 2])
    growth = vars(up)["_growth"](voxels)
    assert growth[2].item() == pytest.approx(1.0)
    assert float(growth[:2].abs().amax()) < 0.3


def test_positions_that_are_too_low_are_mirrored_at_the_least_height():
    """The least height is 0.1 above a floor at -1: 0.4 below it becomes 0.4 above it."""
    eyes = torch.tensor([[5, 6, -1.3], [5, 6, -0.8]], dtype=torch.float64)
    found = positions.lifted(layout_of(floor=-1.0), eyes)
    assert found.tolist() == [pytest.approx([5, 6, -0.5]), [5, 6, -0.8]]
    assert positions.lifted(layout_of(floor=None), eyes) is eyes


@pytest.mark.parametrize(
    ("reach", "wanted"),
    [((0.9, 2.5), {1.0, 2.0}), ((0.1, 0.2), {0.5}), ((5.0, 9.0), {4.0}), ((2.6, 3.1), {2.0})],
)
def test_positions_within_a_range_of_distances_or_else_nearest_to_it(monkeypatch, reach, wanted):
    monkeypatch.setattr(CameraPositions, "admit", lambda _, eyes: torch.zeros(len(eyes)).bool())
    distances = torch.tensor([0.5, 1.0, 2.0, 4.0]).double()
    found = CameraPositions(
        layout=layout_of(),
        least_growth=0.0,
        sharp_sides=torch.zeros(32).bool(),
        cluttered=torch.zeros(0, 3).double(),
        eyes=distances[:, None] * UP,
        distances=distances,
    ).near(40, reach, seed=0)
    assert set(found[:, 2].tolist()) == wanted


@pytest.mark.parametrize(("other", "chosen"), [(1.9, 0), (2.1, 1)])
def test_a_view_is_too_close_at_less_than_half_of_the_usual_distance(monkeypatch, other, chosen):
    """Splats of one size at distances of 1 and, twice, of another."""

    def sizes(*_) -> SplatSizes:
        distances = torch.tensor([1.0, other, other]).double()
        same = torch.full((3,), 0.01).double()
        return SplatSizes(0.01 / distances, same, same)

    monkeypatch.setattr(mixed, "splat_sizes", sizes)
    tried = [(cameras_on_a_line([0.0, 1.0, 2.0]), 1)]
    (found,) = vars(mixed)["_sharp_ones"](SimpleNamespace(layout=None), tried)
    assert found.centers[:, 0].tolist() == [chosen]


@pytest.mark.parametrize(("size", "chosen"), [(0.049, 0), (0.051, 1)])
def test_splats_no_larger_than_those_of_smooth_sides_are_no_fog(monkeypatch, size, chosen):
    sizes = torch.tensor([size, 0.01, 0.01]).double()
    monkeypatch.setattr(mixed, "splat_sizes", lambda *_: SplatSizes(sizes, sizes, sizes))
    tried = [(cameras_on_a_line([0.0, 1.0, 2.0]), 1)]
    (found,) = vars(mixed)["_sharp_ones"](SimpleNamespace(layout=None), tried)
    assert found.centers[:, 0].tolist() == [chosen]


@pytest.mark.parametrize(
    ("subject", "least", "most"), [(2.0, 0, 0), (4.3, 0, 0), (6.0, 1, 1), (8.0, 1.3, 3)]
)
def test_what_is_much_nearer_than_the_subject_is_an_obstacle(subject, least, most):
    """A ball two units ahead hides the middle if the subject is more than ``2 / 0.45`` away.

    If it is more than ``2 / 0.3`` away, the ball is before the lens, too.
    """
    ball = random_scene(1, degree=0).with_tensors(
        {
            "means": torch.zeros(1, 3),
            "log_scales": torch.full((1, 3), math.log(0.5)),
            "logit_opacities": torch.full((1,), 5.0),
        },
        {},
    )
    eyes, distances = torch.tensor([[2.0, 0, 0]]).double(), torch.tensor([subject])
    cameras = scoring.cameras_at(eyes, -eyes, UP, size=(32, 32), field=45.0)
    place = layout_of(sample=ball, room=None)
    good, penalties = scoring.score_cameras(place, cameras, distances=distances)
    assert bool(good) is (most == 0)
    assert least <= float(penalties) <= most


def positions_of(place: SceneLayout) -> CameraPositions:
    distances = torch.tensor([0.5, 1.0, 2.0, 4.0]).double()
    return CameraPositions(
        layout=place,
        least_growth=0.0,
        sharp_sides=torch.zeros(32).bool(),
        cluttered=torch.zeros(0, 3).double(),
        eyes=distances[:, None] * UP + torch.tensor([0.1, 0.0, 0.0]).double(),
        distances=distances,
    )


@pytest.mark.parametrize(
    ("bounded", "room", "field"), [(True, None, 50.0), (False, None, 60.0), (False, CENTER, 65.0)]
)
def test_random_views_of_rooms_and_open_places_have_wider_fields(
    monkeypatch: pytest.MonkeyPatch, bounded: bool, room: torch.Tensor | None, field: float
) -> None:
    monkeypatch.setattr(CameraPositions, "admit", lambda _, eyes: torch.ones(len(eyes)).bool())
    place = positions_of(layout_of(bounded=bounded, room=room))
    found = mixed.random_views(place, 3, size=48, seed=0)
    focal = 24 / math.tan(math.radians(field / 2))
    assert found.Ks[:, 0, 0].tolist() == found.Ks[:, 1, 1].tolist() == pytest.approx([focal] * 3)


def test_random_views_aim_near_the_middle_or_in_a_room_at_surfaces_not_too_near() -> None:
    aims, eyes = vars(mixed)["_targets"], torch.zeros(200, 3).double()
    found = aims(positions_of(layout_of(room=None)), eyes, 0)
    away = torch.linalg.vector_norm(found, dim=1)
    assert 0.1 < float(away.amax()) <= 0.25
    points = torch.tensor([0.1, 0.29, 0.31, 0.5]).double()[:, None] * UP
    voxels = Voxels(points=points, normals=points, log_sizes=points[:, 2])
    found = aims(positions_of(layout_of(room=CENTER, voxels=voxels)), eyes, 0)
    assert set((found[:, 2] * 100).round().tolist()) == {31.0, 50.0}


@pytest.mark.parametrize("is_good", [True, False])
def test_random_positions_are_moved_by_a_twentieth_of_a_radius_if_still_good(
    monkeypatch: pytest.MonkeyPatch, is_good: bool
) -> None:
    good = torch.full((400,), is_good)
    monkeypatch.setattr(CameraPositions, "admit", lambda *_: good)
    frame = RobustFrame(center=torch.zeros(3).double(), radius=2.0)
    place = positions_of(layout_of(frame=frame))
    found = place.near(400, (0.9, 1.1), seed=0) - place.eyes[1]
    most = found.abs().amax(dim=0)
    assert bool(((most > 0.09) & (most <= 0.1)).all() if is_good else (most == 0).all())


def test_a_quarter_of_mixed_views_is_automatic_a_quarter_near_and_half_around(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[str, int]] = []

    def views(count: int) -> Cameras:
        return cameras_on_a_line([float(number) for number in range(count)])

    def found(_: object, count: int, **options: object) -> Cameras:
        asked.append(("automatic", count))
        return views(count)

    def drawn(_: object, count: int, *, reach: object = None, **options: object) -> Cameras:
        asked.append(("near" if reach == (0.2, 1.4) else "around", count))
        return views(count)

    monkeypatch.setattr(mixed, "automatic_views", found)
    monkeypatch.setattr(mixed, "random_views", drawn)
    assert len(mixed.mixed_views(positions_of(layout_of()), 13, size=8, sharp=False)) == 13
    assert asked == [("automatic", 3), ("near", 3), ("around", 7)]


@pytest.mark.parametrize("size", [(64, 32), (32, 64)])
def test_the_field_of_view_is_that_of_the_shorter_side(size: tuple[int, int]) -> None:
    eyes = torch.tensor([[2.0, 0.0, 0.0]]).double()
    found = scoring.cameras_at(eyes, -eyes, UP, size=size, field=90.0)
    width, height = size
    assert found.Ks[0].tolist() == [
        pytest.approx([16.0, 0.0, width / 2]), pytest.approx([0.0, 16.0, height / 2]), [0, 0, 1],
    ]  # fmt: skip
