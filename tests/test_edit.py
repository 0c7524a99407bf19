"""Edits of scenes in memory."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import oracles
from cvtgs import GaussianScene
from cvtgs.boxes import Box, Sphere
from cvtgs.edit import Motion, concatenate, crop, drop_faint, drop_large, move
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, InvalidSceneError
from cvtgs.io import change_axes
from cvtgs.math.spherical_harmonics import rotated_rest
from cvtgs.scene import FLAT_LOG_SCALE, NORMALS
from format_cases import angles
from scenes import moved, random_scene, same_bits


def labelled(count: int, *, seed: int = 0, degree: int = 2) -> GaussianScene:
    scene = random_scene(count, seed=seed, degree=degree)
    labels = torch.arange(count, dtype=torch.int32)
    return replace(scene.with_tensors({}, {"label": labels}), comments=("kept",))


def test_crop_keeps_the_rows_inside_unchanged() -> None:
    scene = labelled(200)
    box, ball = Box(min=(-1, -1, -1), max=(0, 1, 1)), Sphere(center=(1.0, 0.0, 0.0), radius=0.7)
    found = crop(scene, [box, ball])
    wanted = [
        row
        for row, (x, y, z) in enumerate(scene.means.tolist())
        if (-1 <= x <= 0 and abs(y) <= 1 and abs(z) <= 1) or math.dist((x, y, z), (1, 0, 0)) <= 0.7
    ]
    assert 20 < len(wanted) < 180
    assert same_bits(found, scene.select(torch.tensor(wanted)))
    assert found.comments == ("kept",)
    assert crop(scene, [Sphere(center=(0.0, 0.0, 0.0), radius=100.0)]) is scene
    with pytest.raises(InvalidArgumentError, match="needs at least one box or sphere, found none"):
        crop(scene, [])
    assert same_bits(crop(scene, ball), crop(scene, [ball]))
    assert same_bits(crop(scene, iter([box, ball])), found)  # type: ignore[arg-type]
    for wrong in (["x"], [((-1, -1, -1), (0, 1, 1))], "x"):
        with pytest.raises(InvalidArgumentError, match="regions must be boxes or spheres, found"):
            crop(scene, wrong)


def test_points_on_its_surface_belong_to_a_sphere() -> None:
    scene = random_scene(2).with_tensors({"means": torch.tensor([[3.0, 4, 0], [3.001, 4, 0]])}, {})
    assert len(crop(scene, [Sphere(center=(0.0, 0.0, 0.0), radius=5.0)])) == 1
    far = torch.tensor([[6e6, 0, 0], [6e6 + 0.5, 0, 0]])  # the centre is between float32 numbers
    scene = scene.with_tensors({"means": far}, {})
    assert len(crop(scene, [Sphere(center=(6000000.25, 0.0, 0.0), radius=0.3)])) == 2


def test_faint_and_large_gaussians_are_dropped() -> None:
    scene = labelled(200)
    logits, sizes = scene.logit_opacities.tolist(), scene.log_scales.tolist()
    faint = [row for row, logit in enumerate(logits) if 1 / (1 + math.exp(-logit)) >= 0.3]
    small = [row for row, three in enumerate(sizes) if max(map(math.exp, three)) <= 0.15]
    assert 20 < len(faint) < 180
    assert 20 < len(small) < 180
    assert same_bits(drop_faint(scene, 0.3), scene.select(torch.tensor(faint)))
    assert same_bits(drop_large(scene, 0.15), scene.select(torch.tensor(small)))
    assert drop_faint(scene, 0.0) is scene
    assert drop_large(scene, math.inf) is scene


def test_full_opacity_is_not_dropped() -> None:
    scene = random_scene(2).with_tensors({"logit_opacities": torch.tensor([math.inf, 3.0])}, {})
    assert len(drop_faint(scene, 1.0)) == 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_motion_equals_that_of_the_oracle(degree: int) -> None:
    scene = labelled(20, degree=degree)
    quat, shift = (0.3, -0.8, 0.2, 0.5), (1.0, -2.0, 3.0)
    found = move(scene, Motion(quat=quat, scale=0.4, shift=shift))
    wanted = moved(scene, quat=quat, scale=0.4, shift=shift)
    for name in ("means", "log_scales", "shN"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name))
    assert angles(found.quats, wanted.quats).max() < 1e-3
    assert torch.equal(found.extras["label"], scene.extras["label"])
    assert torch.equal(found.sh0, scene.sh0)


@pytest.mark.parametrize(
    ("motion", "touched"),
    [
        (Motion(shift=(1.0, 2.0, 3.0)), {"means"}),
        (Motion(scale=2.0), {"means", "log_scales"}),
        (Motion(quat=(1.0, 1.0, 0.0, 0.0)), {"means", "quats", "shN"}),
        (Motion(), set()),
        (Motion(quat=(-2.0, 0.0, 0.0, 0.0)), set()),
    ],
)
def test_a_motion_leaves_unrelated_tensors_bit_identical(motion: Motion, touched: set[str]) -> None:
    scene = labelled(20)
    found = move(scene, motion)
    changed = {
        name
        for name, tensor in scene.tensors().items()
        if not torch.equal(tensor, found.tensors()[name])
    }
    assert changed == touched


def test_a_motion_and_its_inverse_cancel() -> None:
    scene = random_scene(50, degree=3, dtype=torch.float64)
    there = Motion(quat=(0.3, -0.8, 0.2, 0.5), scale=3.0)
    back = Motion(quat=(0.3, 0.8, -0.2, -0.5), scale=1 / 3)
    again = move(move(scene, there), back)
    for name in ("means", "log_scales", "shN"):
        torch.testing.assert_close(getattr(again, name), getattr(scene, name), rtol=0, atol=1e-12)


def test_angles_are_about_x_then_y_then_z() -> None:
    quat = Motion.of_angles((90, 0, 90)).quat
    point = oracles.rotation(quat) @ [0, 1, 0]
    assert point.round(12).tolist() == [0, 0, 1]  # y turns to z about x, and z stays about z
    assert Motion.of_angles((180, 0, 0)).quat == (0.0, 1.0, 0.0, 0.0)
    assert Motion.of_angles((0, 0, -90)).quat == pytest.approx((0.5**0.5, 0, 0, -(0.5**0.5)))


def test_a_half_turn_is_exact() -> None:
    scene = random_scene(5).with_tensors({"means": torch.eye(3)[[0, 1, 2, 0, 1]]}, {})
    means = move(scene, Motion.of_angles((0, 0, 180))).means
    assert torch.equal(means.abs(), scene.means)


def test_rotation_does_not_mix_sh_bands() -> None:
    turn = torch.tensor(oracles.rotation((0.3, -0.8, 0.2, 0.5)) / 1.0)
    rest = torch.zeros(1, 15, 3, dtype=torch.float64)
    rest[:, 3:8] = 1.0
    found = rotated_rest(rest, turn)
    assert torch.equal(found[:, :3], rest[:, :3])
    assert torch.equal(found[:, 8:], rest[:, 8:])
    torch.testing.assert_close(found.square().sum(), rest.square().sum())


def test_concatenation_keeps_all_rows() -> None:
    first, second = labelled(4, degree=2), labelled(3, seed=1, degree=2)
    both = concatenate([first, second], fill=True)
    assert same_bits(both[:4], first)
    assert same_bits(both[4:], second)
    assert both.comments == ("kept",)
    assert same_bits(concatenate([first], fill=True), first)


def test_unlike_scenes_are_filled_with_a_warning() -> None:
    first = replace(labelled(4, degree=0), comments=("SplatRenderMode: mip",))
    second = random_scene(3, degree=3, dtype=torch.float64)
    with pytest.warns(UserWarning, match="of the scenes") as said:
        both = concatenate([first, second], fill=True)
    assert [one.category for one in said] == [DroppedDataWarning, UserWarning]
    assert [str(one.message) for one in said] == [
        "left out column 'label', which not all of the scenes have.",
        "some of the scenes to concatenate are tagged SplatRenderMode: mip and others are not; "
        "viewers will show one of the two kinds too soft or too sharp.",
    ]
    assert {one.filename for one in said} == {__file__}
    assert (both.sh_degree, both.dtype, dict(both.extras)) == (3, torch.float64, {})
    assert torch.equal(both.means[:4].float(), first.means)
    assert not both.shN[:4].any()
    assert torch.equal(both.shN[4:], second.shN)
    with pytest.raises(InvalidSceneError, match=r"needs at least one scene, found \[\]"):
        concatenate([], fill=True)
    with pytest.raises(InvalidSceneError, match=r"at least one scene, found \['a.ply'\]"):
        concatenate(["a.ply"], fill=True)
    with pytest.raises(InvalidSceneError, match="at least one scene, found None"):
        concatenate(None, fill=True)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (
            lambda: Motion(scale=0.0),
            r"a scale above 0, and 3 of a shift, found \(1.0, 0.0, 0.0, 0.0\), 0.0, ",
        ),
        (lambda: Motion(quat=(0.0,) * 4), "a quaternion of length 1e-100 to 1e100, a scale"),
        (lambda: Motion(quat=(1e-200,) * 4), "a quaternion of length 1e-100 to 1e100"),
        (lambda: Motion(quat=(1e200,) * 4), "a quaternion of length 1e-100 to 1e100"),
        (lambda: Motion(shift=(math.nan, 0, 0)), "must consist of finite numbers"),
        (lambda: Motion.of_angles((math.inf, 0, 0)), "angles must be 3 finite numbers in degrees"),
        (lambda: Motion.of_angles((90, 0)), "angles must be 3 finite numbers in degrees"),
        (lambda: Motion(quat=(1, 0, 0), shift=(0,) * 4), "must consist of finite numbers"),
        (lambda: Sphere(center=None, radius=1.0), "a centre of 3 finite numbers"),
        (lambda: Sphere(center="123", radius=1.0), "a centre of 3 finite numbers"),
        (lambda: Motion(scale="2"), "must consist of finite numbers"),
        (lambda: Motion(scale=10**400), "must consist of finite numbers"),
        (lambda: Sphere(center=(0.0, 0.0, 0.0), radius=-1), "a radius of at least 0"),
        (lambda: drop_faint(random_scene(2), 1.5), "from 0 to 1, found 1.5"),
        (lambda: drop_large(random_scene(2), 0.0), "above 0, found 0.0"),
        (lambda: drop_faint(random_scene(2), "a"), "from 0 to 1, found 'a'"),
        (lambda: drop_large(random_scene(2), None), "above 0, found None"),
        (lambda: crop(random_scene(2), None), "regions must be boxes or spheres, found None"),
        (lambda: move(random_scene(2), None), "motion must be of type Motion, found NoneType"),
        *(
            (lambda edit=edit: edit(None, 1), "scene must be of type GaussianScene, found NoneType")
            for edit in (crop, drop_faint, drop_large, move)
        ),
    ],
)
def test_invalid_arguments_are_refused(make, text: str) -> None:
    with pytest.raises(InvalidArgumentError, match=text):
        make()


def with_normals(scene: GaussianScene, normals: torch.Tensor) -> GaussianScene:
    return scene.with_tensors({}, dict(zip(NORMALS, normals.unbind(1), strict=True)))


def test_normals_turn_with_the_scene() -> None:
    normals = torch.tensor([[1.0, 0, 0], [0, 2, 0]])
    scene = with_normals(random_scene(2), normals)
    turned = move(scene, Motion.of_angles((0.0, 0.0, 90.0), scale=3.0, shift=(1.0, 0.0, 0.0)))
    found = torch.stack([turned.extras[name] for name in NORMALS], dim=1)
    assert torch.allclose(found, torch.tensor([[0.0, 1, 0], [-2, 0, 0]]), atol=1e-15)
    there = change_axes(scene, "rdf", "rub")
    assert torch.equal(there.extras["ny"], -normals[:, 1])
    assert same_bits(change_axes(there, "rub", "rdf"), scene)
    quarter = change_axes(scene, "rdf", "rfu")
    assert quarter.extras["nz"].tolist() == [0.0, -2.0]


def test_missing_normals_are_filled_with_zeros() -> None:
    first = with_normals(random_scene(2), torch.ones(2, 3))
    both = concatenate([first, random_scene(3)], fill=True)
    assert [both.extras[name].tolist() for name in NORMALS] == [[1.0, 1, 0, 0, 0]] * 3
    assert not concatenate([random_scene(2), random_scene(3)], fill=True).extras


def test_the_third_of_two_scales_marks_flat_gaussians_at_every_size() -> None:
    scene = random_scene(3).with_tensors({"log_scales": torch.full((3, 3), FLAT_LOG_SCALE)}, {})
    flat = replace(scene, layout=(("x", "float"),))
    assert move(flat, Motion(scale=2.0)).log_scales[:, 2].tolist() == [FLAT_LOG_SCALE] * 3
    assert (move(scene, Motion(scale=2.0)).log_scales > FLAT_LOG_SCALE).all()


def test_coordinates_stay_within_their_type() -> None:
    scene = random_scene(3)
    with pytest.raises(
        InvalidArgumentError, match=r"within 3\.4e\+38, the range of float32, found"
    ):
        move(scene, Motion(scale=1e39))
    with pytest.raises(InvalidArgumentError, match=r"shrink all .* below 1\.18e-38, .* of 1e-60"):
        move(scene, Motion(scale=1e-60))
    at_origin = scene.with_tensors(means=torch.zeros(3, 3))
    assert torch.equal(move(at_origin, Motion(scale=1e-60)).means, at_origin.means)
    infinite = scene.with_tensors({"means": torch.full((3, 3), torch.inf)}, {})
    assert move(infinite, Motion(scale=2.0)).means.isinf().all()


def test_numbers_of_any_type_make_a_motion():
    scene, wanted = random_scene(5, degree=1), Motion(quat=(1, 2, 3, 4), shift=(1, 2, 3))
    motion = Motion(quat=torch.tensor([1.0, 2, 3, 4]), shift=np.array([1.0, 2, 3]))
    assert motion == wanted
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert same_bits(move(scene, motion), move(scene, wanted))
    assert len(crop(scene, Sphere(center=torch.zeros(3), radius=1e6))) == 5


def test_scenes_to_concatenate_may_come_from_an_iterator():
    scenes = [random_scene(2), random_scene(3)]
    assert same_bits(concatenate(iter(scenes), fill=True), concatenate(scenes, fill=True))


def test_filled_scenes_keep_their_sh_bands_and_get_zeros_above() -> None:
    first, second = random_scene(3, degree=1), random_scene(2, degree=2)
    both = concatenate([first, second], fill=True)
    assert torch.equal(both.shN[:3, :3], first.shN)
    assert not both.shN[:3, 3:].any()
    assert torch.equal(both.shN[3:], second.shN)


@pytest.mark.parametrize("fill", [False, True])
def test_joined_columns_of_floats_and_integers_keep_large_integers(fill) -> None:
    """float32, to which torch would promote them, has no odd numbers above 2 ** 24."""
    ids = torch.tensor([2**24 + 1, 7])
    first = replace(random_scene(2), extras={"id": ids, "kind": ids.to(torch.uint8)})
    second = replace(random_scene(1), extras={"id": torch.tensor([0.1]), "kind": ids[:1]})
    joined = concatenate([first, second], fill=fill).extras
    assert joined["id"].tolist() == [2**24 + 1, 7, torch.tensor(0.1).item()]
    assert joined["kind"].dtype == torch.int64


def test_scenes_of_several_layouts_become_one_of_none() -> None:
    """Else a layout without a third scale would drop those of the other scene."""
    flat = replace(random_scene(3), layout=(("scale_0", "float"), ("scale_1", "float")))
    thick = replace(random_scene(2), layout=(*flat.layout, ("scale_2", "float")))
    for scenes in ([flat, thick], [thick, flat]):
        both = concatenate(scenes, fill=True)
        assert (both.layout, both.has_two_scales) == ((), False)
    assert concatenate([flat, flat], fill=True).layout == flat.layout


def test_filled_columns_are_in_the_usual_order() -> None:
    first = with_normals(random_scene(2), torch.ones(2, 3))
    assert list(concatenate([random_scene(3), first], fill=True).extras) == list(NORMALS)


def test_the_comments_of_all_scenes_are_kept() -> None:
    texts = (("mine", "both"), ("both", "yours"))
    scenes = [replace(random_scene(2), comments=lines) for lines in texts]
    for fill in (False, True):
        assert concatenate(scenes, fill=fill).comments == ("mine", "both", "yours")


def test_a_single_scene_needs_no_list() -> None:
    scene = random_scene(2)
    assert concatenate(scene) is scene
