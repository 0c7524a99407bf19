"""Where cameras may be: above a floor, in a room, where images were taken, not inside matter."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import cvtgs
from cvtgs.cameras import Cameras, look_at
from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.refinement.images import generated_views
from cvtgs.rendering.render import contributions_to_each
from cvtgs.views import automatic_views, find_view_positions, mixed_views, random_views
from cvtgs.views.automatic import inside_candidates
from cvtgs.views.layout import find_layout, hidden_share
from cvtgs.views.mixed import NEAR
from cvtgs.views.scoring import measure_splats, splat_sizes
from cvtgs.views.up import Voxels, find_up

HALF = math.sqrt(0.5)
CONVENTIONS = {
    "y-down": (1.0, 0.0, 0.0, 0.0),
    "y-up": (0.0, 1.0, 0.0, 0.0),
    "z-up": (HALF, -HALF, 0.0, 0.0),
}
DOWN = torch.tensor([0.0, 1.0, 0.0])


def turned(kind: str, quat: tuple[float, ...], count: int = 4000) -> cvtgs.GaussianScene:
    scene = cvtgs.synthetic.scene(kind, count, sh_degree=0, seed=1)
    matrix = parameters.quats_to_matrices(torch.tensor([quat]))[0]
    frames = parameters.quats_to_matrices(parameters.normalize_quats(scene.quats))
    tensors = {
        "means": scene.means @ matrix.T,
        "quats": parameters.matrices_to_quats(matrix @ frames),
    }
    return scene.with_tensors(tensors, {})


def blobs(means: Tensor, log_scales: Tensor) -> cvtgs.GaussianScene:
    """Return grey, nearly opaque, round Gaussians."""
    count = len(means)
    return cvtgs.from_dict(
        {
            "means": means.float(),
            "scales": log_scales.float()[:, None].expand(count, 3),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4),
            "opacities": torch.full((count,), 4.0),
            "sh0": torch.zeros(count, 1, 3),
            "shN": torch.zeros(count, 0, 3),
        }
    )


def sphere(count: int, radius: float = 1.0) -> Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return radius * torch.nn.functional.normalize(points, dim=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["courtyard", "landscape"])
@pytest.mark.parametrize("floor", [True, False])
def test_people_in_an_open_place_stand_on_its_ground(kind, floor, monkeypatch):
    """They see the middle of the ground at most 35 degrees below them, from all around."""
    if not floor:
        monkeypatch.setattr("cvtgs.views.layout.find_floor", lambda voxels, up: None)
    positions = find_view_positions(cvtgs.synthetic.scene(kind, 4000, sh_degree=0, seed=1))
    layout = positions.layout
    assert layout.is_open
    assert (layout.floor is not None) == floor
    ground = float(layout.frame.center @ layout.up) if layout.floor is None else layout.floor
    offsets = (positions.eyes - layout.frame.center) / layout.frame.radius
    level = torch.linalg.vector_norm(offsets - (offsets @ layout.up)[:, None] * layout.up, dim=1)
    heights = (positions.eyes @ layout.up - ground) / layout.frame.radius
    assert 0.2 <= float(level.amin()) < 0.5
    assert 1.5 < float(level.amax()) <= 2.0
    lifted = 0.2 if floor else 0.0  # those too low are mirrored at a tenth of a radius
    assert bool((heights <= (math.tan(math.radians(35.0)) * level).clamp_min(lifted)).all())
    assert bool((heights > 0).all())
    directions = torch.nn.functional.normalize(offsets, dim=1).mean(dim=0)
    assert float(torch.linalg.vector_norm(directions - (directions @ layout.up) * layout.up)) < 0.4
    views = random_views(positions, 8, size=100, seed=0)
    assert views.Ks[0, 0, 0].item() == pytest.approx(50.0 / math.tan(math.radians(30.0)))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["object", "courtyard"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_no_view_is_beneath_the_floor(kind, convention):
    scene = turned(kind, CONVENTIONS[convention])
    matrix = parameters.quats_to_matrices(torch.tensor([CONVENTIONS[convention]]))[0]
    up = -(matrix @ DOWN).double()
    heights = scene.means.double() @ up
    floor = float(heights.quantile(0.1))
    positions = find_view_positions(scene)
    assert float(positions.layout.up @ up) > 0.99
    refined = generated_views(scene, config=cvtgs.SimplifyConfig().refine, seed=0)
    for cameras in (
        automatic_views(positions, 8, width=32, height=32),
        random_views(positions, 24, size=32, seed=0),
        random_views(positions, 24, size=32, seed=1, reach=NEAR),
        mixed_views(positions, 16, size=32),
        *refined.heldout,
        *(next(refined.training) for _ in range(4)),
    ):
        assert float((cameras.centers @ up).amin()) > floor
        assert float((-cameras.viewmats[:, 1, :3] @ up).amin()) > 0, "images are upright"


@pytest.mark.slow
def test_a_scene_without_a_floor_has_none_and_is_seen_from_all_sides():
    scene = blobs(sphere(4000), torch.full((4000,), math.log(0.05)))
    positions = find_view_positions(scene)
    assert positions.layout.floor is None
    eyes = random_views(positions, 64, size=32, seed=0).centers
    for axis in range(3):
        assert float(eyes[:, axis].amin()) < -1
        assert float(eyes[:, axis].amax()) > 1


@pytest.mark.slow
def test_no_view_is_inside_a_closed_surface():
    scene = blobs(sphere(4000), torch.full((4000,), math.log(0.05)))
    positions = find_view_positions(scene)
    near = random_views(positions, 64, size=32, seed=0, reach=NEAR)
    assert float(torch.linalg.vector_norm(near.centers, dim=1).amin()) > 1
    assert not bool(positions.admit(torch.zeros(1, 3, dtype=torch.float64)).any())


@pytest.mark.slow
def test_views_of_a_room_are_inside_of_it():
    scene = turned("room", CONVENTIONS["y-down"])
    layout = find_layout(scene)
    low, high = scene.means.double().quantile(torch.tensor([0.02, 0.98]).double(), dim=0)
    assert layout.room is not None
    for cameras in (
        mixed_views(scene, 16, size=32),
        random_views(scene, 24, size=32, seed=3),
        automatic_views(scene, 4, width=32, height=32),
    ):
        assert bool(((cameras.centers > low) & (cameras.centers < high)).all())


def cut_room(*, convention: str = "y-down", wall: bool = False) -> cvtgs.GaussianScene:
    """Return a room without its ceiling and, unless ``wall``, without the wall at the largest x."""
    room = turned("room", CONVENTIONS[convention], 20_000)
    means = turned("room", CONVENTIONS["y-down"], 20_000).means
    low, high = means.quantile(0.01, dim=0), means.quantile(0.99, dim=0)
    across, down, _ = ((means - low) / (high - low)).unbind(1)
    return room[(down > 0.1) & ((across < 0.9) | wall)]


@pytest.mark.long
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_room_open_to_a_side_is_viewed_from_there_or_from_inside(convention, monkeypatch):
    scene = cut_room(convention=convention)
    layout = find_layout(scene)
    assert layout.room is None
    assert layout.cutaway is not None
    matrix = parameters.quats_to_matrices(torch.tensor([CONVENTIONS[convention]]))[0].double()
    middle = layout.cutaway @ matrix
    low, high = (scene.means.double() @ matrix).quantile(torch.tensor([0.02, 0.98]).double(), 0)

    def is_behind(cameras: Cameras) -> Tensor:
        """Return which level lines from the middle leave the walls elsewhere than at the side."""
        steps = (cameras.centers @ matrix - middle)[:, [0, 2]]
        room = torch.where(steps > 0, (high - middle)[[0, 2]], (middle - low)[[0, 2]])
        leaves = steps.abs() / room
        return (leaves.amax(dim=1) > 1.1) & ~((steps[:, 0] > 0) & (leaves[:, 0] > leaves[:, 1]))

    def views() -> list[Cameras]:
        return [automatic_views(scene, 8, width=32, height=32), mixed_views(scene, 24, size=32)]

    assert all(not bool(is_behind(cameras).any()) for cameras in views())
    monkeypatch.setattr("cvtgs.views.layout._WALLED", (2.0, 0.0))
    assert all(bool(is_behind(cameras).any()) for cameras in views())


@pytest.mark.long
@pytest.mark.parametrize("kind", ["object", "courtyard", "landscape", "haze", "thin", "room"])
def test_other_scenes_are_no_rooms_that_are_open_to_a_side(kind):
    for seed in range(2):
        scene = cvtgs.synthetic.scene(kind, 4000, sh_degree=0, seed=seed)
        assert find_layout(scene).cutaway is None
    assert find_layout(cut_room()).cutaway is not None
    assert find_layout(cut_room(wall=True)).cutaway is None  # as a box or a bowl without a lid


@pytest.mark.slow
def test_a_wall_captured_from_one_side_is_viewed_from_that_side():
    """Gaussians are larger behind the wall, where no image was taken."""
    generator = torch.Generator().manual_seed(0)
    means = 2 * torch.rand(6000, 3, generator=generator) - 1
    means[:, 2] = 0.4 * means[:, 2].abs()
    scene = blobs(means, math.log(0.02) + 5.0 * means[:, 2])
    eyes = random_views(scene, 48, size=32, seed=0).centers
    assert float((eyes[:, 2] < 0).double().mean()) > 0.9


def from_two_away(*, focal: float, side: int) -> Cameras:
    """Return a camera at z = -2 that looks at the origin."""
    eye, half = torch.tensor([[0.0, 0, -2]]).double(), side / 2
    return Cameras(
        viewmats=look_at(eye, torch.zeros(1, 3).double(), DOWN.double()),
        Ks=torch.tensor([[[focal, 0, half], [0, focal, half], [0, 0, 1]]]).double(),
        width=side,
        height=side,
    )


def test_splat_sizes_are_those_in_the_image():
    """Near ones are 0.1 wide at a distance of 2, and hide the far one."""
    means = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0, 0, 2]])
    layout = find_layout(blobs(means, torch.tensor([0.1, 0.1, 0.1]).log()))
    cameras = from_two_away(focal=50.0, side=100)
    sizes = splat_sizes(layout, cameras)
    assert sizes.in_image.tolist() == pytest.approx([0.5 * 0.1 / 2], rel=1e-5)
    assert sizes.in_scene.tolist() == pytest.approx([0.1 / layout.frame.radius], rel=1e-5)


@pytest.mark.parametrize(("small", "finest"), [(1, 0.1), (3, 0.04)])
def test_the_finest_splats_are_the_lower_decile_of_what_is_seen(small, finest):
    """Each small splat paints some 6 % of what the large one does: one is less than a tenth."""
    means = torch.tensor([[0.0, 0, 0], [0.6, 0, 0], [0.9, 0, 0], [1.2, 0, 0]])[: 1 + small]
    widths = torch.tensor([0.1] + [0.04] * small).double()
    camera = from_two_away(focal=200.0, side=200)
    scene = blobs(means, torch.tensor([0.1] + [0.025] * small).log())
    sizes = measure_splats(scene, widths, 2.0, camera)
    assert sizes.finest.tolist() == pytest.approx([finest / 2.0])
    assert sizes.in_scene.tolist() == pytest.approx([0.1 / 2.0])


def test_an_image_that_shows_nothing_counts_all_splats():
    """The camera looks along +z from -2, and everything is behind it."""
    means = torch.tensor([[0.0, 0, -5], [0.1, 0, -5], [0, 0.1, -5]])
    widths = torch.tensor([0.1, 0.2, 0.3]).double()
    camera = from_two_away(focal=50.0, side=32)
    sizes = measure_splats(blobs(means, widths.float().log()), widths, 2.0, camera)
    assert bool(torch.stack(sizes).isfinite().all())


def test_splats_are_measured_without_autocast(monkeypatch):
    """Projections of the torch backend would have 8 bits."""
    cameras = from_two_away(focal=50.0, side=32)
    layout = find_layout(blobs(sphere(50), torch.full((50,), -3.0)))

    def found(scene, cameras):
        assert not torch.is_autocast_enabled("cpu")
        return contributions_to_each(scene, cameras, backend="torch")

    monkeypatch.setattr("cvtgs.views.scoring.contributions_to_each", found)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert bool(splat_sizes(layout, cameras).in_image.isfinite().all())


@pytest.mark.slow
def test_every_fourth_gaussian_shows_nearly_the_same_sizes(monkeypatch):
    scene = cvtgs.synthetic.scene("object", 24_000, sh_degree=0, seed=1)
    layout, cameras = find_layout(scene), automatic_views(scene, 6, width=64, height=64)
    thinned = splat_sizes(layout, cameras)
    monkeypatch.setattr("cvtgs.views.scoring._SPARSE", 1)
    whole = splat_sizes(layout, cameras)
    assert not torch.equal(thinned.in_scene, whole.in_scene)
    torch.testing.assert_close(thinned.in_scene, whole.in_scene, rtol=0.25, atol=0)
    torch.testing.assert_close(thinned.in_image, whole.in_image, rtol=0.25, atol=0)


@pytest.mark.slow
def test_few_views_are_placed_where_splats_are_large():
    """Half of a ball mixes large and tiny Gaussians; their mean log size is that of the rest."""
    means = sphere(4000)
    large = torch.rand(4000, generator=torch.Generator().manual_seed(1)) < 0.5
    factors = torch.where(large, 6.0, 1 / 6).where(means[:, 0] > 0, 1.0)
    positions = find_view_positions(blobs(means, (0.05 * factors).log()))

    def share(cameras):
        return float((cameras.centers[:, 0] > 0).double().mean())

    assert share(random_views(positions, 64, size=32, seed=0)) > 0.5
    assert share(mixed_views(positions, 32, size=32)) < 0.2


@pytest.mark.slow
def test_the_smooth_back_of_an_object_is_viewed():
    """Its Gaussians are almost twice as large as those in front, but they are not fog."""
    front, back = sphere(6000), sphere(1200, 0.97)
    front, back = front[front[:, 2] < 0], back[back[:, 2] >= 0]
    sizes = torch.cat([torch.full((len(front),), 0.012), torch.full((len(back),), 0.021)])
    positions = find_view_positions(blobs(torch.cat([front, back]), sizes.log()))
    assert int(positions.sharp_sides.sum()) >= 8
    for cameras, least in (
        (mixed_views(positions, 32, size=32), 0.1),
        (automatic_views(positions, 8), 0.3),
    ):
        directions = torch.nn.functional.normalize(cameras.centers, dim=1)
        assert float((directions[:, 2] > 0.3).double().mean()) >= least


@pytest.mark.parametrize("count", [12, 32])
@pytest.mark.slow
def test_automatic_views_among_mixed_ones_are_all_around(count):
    cameras = mixed_views(blobs(sphere(4000), torch.full((4000,), 0.03).log()), count, size=32)
    x, _, z = cameras.centers[: count // 4].unbind(1)
    angles = torch.atan2(z, x).sort().values
    gaps = torch.cat([angles.diff(), angles[:1] + math.tau - angles[-1:]])
    assert float(gaps.amax()) < 1.2 * math.tau / (count // 4)


@pytest.mark.long
def test_the_same_scene_gives_the_same_positions():
    scene = turned("courtyard", CONVENTIONS["y-down"])
    one, two = (find_view_positions(scene) for _ in range(2))
    assert torch.equal(one.eyes, two.eyes)
    views = mixed_views(one, 6, size=32, seed=2).viewmats
    assert torch.equal(views, mixed_views(scene, 6, size=32, seed=2).viewmats)


@pytest.mark.slow
def test_views_do_not_cut_off_the_top():
    """A thin rod on a ball: 1 % of all voxels, and as tall as the ball."""
    rod = torch.stack([torch.zeros(60), -torch.linspace(1, 3, 60), torch.zeros(60)], dim=1)
    means = torch.cat([sphere(4000), rod])
    scene = blobs(means, torch.full((4060,), math.log(0.05)))
    cameras = automatic_views(scene, 6, width=100, height=100)
    tip = torch.tensor([0.0, -2.9, 0.0, 1.0], dtype=torch.float64)
    x, y, z = (cameras.Ks @ (cameras.viewmats @ tip)[:, :3, None])[:, :, 0].unbind(1)
    assert bool((z > 0).all())
    assert bool(((x / z > 0) & (x / z < 100) & (y / z > 0) & (y / z < 100)).all())


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_ground_across_x_gives_a_unit_vector(sense):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(500, 3, generator=generator, dtype=torch.float64) - 0.5
    points[:, 0] = 0.01 * points[:, 0]
    normals = torch.tensor([[sense, 0.0, 0.0]], dtype=torch.float64).repeat(500, 1)
    sizes = -points[:, 0]  # smaller above
    up = find_up(Voxels(points=points, normals=normals, log_sizes=sizes), points[:0])
    assert up.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("seed", [0, 1, 3])
@pytest.mark.slow
def test_a_hollow_object_is_not_a_room(seed: int) -> None:
    vase = cvtgs.synthetic.scene("object", 6000, sh_degree=0, seed=seed)
    positions = find_view_positions(vase)
    assert positions.layout.room is None
    layout = positions.layout
    away = torch.linalg.vector_norm(automatic_views(positions, 3).centers - layout.center, dim=1)
    assert float(away.min()) > 2 * layout.radius


def test_the_share_hidden_behind_walls_by_hand() -> None:
    angles = torch.linspace(0, 2 * math.pi, 200, dtype=torch.float64)[:-1]
    ring = torch.stack([angles.cos(), 0 * angles, angles.sin()], dim=1)
    eye = torch.zeros(3, dtype=torch.float64)
    assert hidden_share(eye, ring) == 0.0
    assert math.isclose(hidden_share(eye, torch.cat([ring, 1.8 * ring])), 0.5)


@pytest.mark.parametrize("radius", [1.0, 2.0])
def test_cameras_in_a_room_stand_back_by_a_share_of_the_way_to_the_wall_behind(radius) -> None:
    """Walls are 0.5 radii from the eye on one side, 1.4 on the other, and 1 between."""
    right, up = torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.0, 0, 1]).double()
    walls = torch.tensor([[1.4, 0, 0], [-0.5, 0, 0], [0, 1, 0], [0, -1, 0]]).double()
    layout = replace(
        find_layout(blobs(sphere(100), torch.full((100,), -3.0))),
        frame=RobustFrame(center=torch.zeros(3).double(), radius=radius),
        voxels=Voxels(points=walls, normals=walls, log_sizes=walls[:, 0]),
        up=up,
    )
    found = inside_candidates(layout, torch.zeros(3).double(), 4, size=(64, 64), turn=0.0)
    cameras, distances = found[0]
    ahead = cameras.viewmats[:, 2, :3].double() @ right
    for side, wall in ((1.0, 0.5), (-1.0, 1.4)):
        (row,) = (side * ahead > 0.9).nonzero()[:, 0].tolist()
        back = 0.65 * wall * radius
        assert cameras.centers[row].tolist() == pytest.approx([-back * side, 0, 0], abs=1e-6)
        assert float(distances[row]) == pytest.approx(back + 0.5 * radius)


def test_positions_of_any_float_dtype_are_judged_and_others_refused():
    positions = find_view_positions(cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=2))
    eyes = torch.tensor([[0.0, -1.0, 9.0], [0.0, 0.0, 0.0]])
    assert torch.equal(positions.admit(eyes), positions.admit(eyes.double()))
    for wrong in (eyes[0], eyes[:, :2], eyes.long(), eyes.tolist()):
        with pytest.raises(InvalidArgumentError, match=r"^eyes must be a tensor of floats of"):
            positions.admit(wrong)
    for count, seed in ((-1, 0), (1.5, 0), (2, 0.5)):
        with pytest.raises(InvalidArgumentError, match="must be a whole number"):
            positions.near(count, (1, 2), seed)
    assert positions.near(2, (1, 2), 2**70).shape == (2, 3)
