"""GaussianScene: the only data that is passed between stages."""

import copy
import dataclasses
import math
import pickle
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs import GaussianScene
from cvtgs.errors import DeviceError, InvalidArgumentError, InvalidSceneError, OutputExistsError
from cvtgs.math.parameters import mean_projected_area
from render_cases import one_camera
from scenes import random_scene, same_bits

INF = float("inf")


def tensors_of(count: int = 4, rest: int = 3) -> dict[str, torch.Tensor]:
    return {
        "means": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "log_scales": torch.zeros(count, 3),
        "logit_opacities": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 3),
        "shN": torch.zeros(count, rest, 3),
    }


def error_of(**changes: object) -> str:
    with pytest.raises(InvalidSceneError) as caught:
        GaussianScene(**{**tensors_of(), **changes})
    return str(caught.value)


def test_activated_properties():
    scene = GaussianScene(**tensors_of(2))
    assert scene.scales.tolist() == [[1.0] * 3] * 2
    assert scene.opacities.tolist() == [0.5, 0.5]
    assert scene.masses.tolist() == pytest.approx([math.pi / 2] * 2)
    assert scene.masses.dtype == torch.float64


def test_sh_puts_the_constant_band_first():
    scene = random_scene(3, degree=2)
    assert scene.sh.shape == (3, 9, 3)
    assert torch.equal(scene.sh[:, :1], scene.sh0)
    assert torch.equal(scene.sh[:, 1:], scene.shN)


@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_the_sh_degree_follows_from_the_coefficients(rest, degree):
    assert GaussianScene(**tensors_of(rest=rest)).sh_degree == degree


def test_bands_above_a_degree_are_dropped():
    scene = random_scene(5, degree=3)
    for degree, count in ((0, 0), (1, 3), (2, 8)):
        small = scene.with_sh_degree(degree)
        assert (small.sh_degree, small.shN.is_contiguous()) == (degree, True)
        assert torch.equal(small.shN, scene.shN[:, :count])
        assert torch.equal(small.means, scene.means)
    assert scene.with_sh_degree(3) is scene
    assert random_scene(5, degree=1).with_sh_degree(2).sh_degree == 1
    with pytest.raises(InvalidArgumentError, match="the SH degree must be from 0 to 3, found 4"):
        scene.with_sh_degree(4)


def test_scenes_are_indexed_like_tensors():
    scene = random_scene(9, degree=1)
    scene = scene.with_tensors({}, {"label": torch.arange(9)})
    mask = torch.arange(9) % 2 == 0
    taken = [
        (scene[mask], [0, 2, 4, 6, 8]),
        (scene[mask.tolist()], [0, 2, 4, 6, 8]),
        (scene[:3], [0, 1, 2]),
        (scene[::-4], [8, 4, 0]),
        (scene[5:2], []),
        (scene[[7, -1]], [7, 8]),
        (scene[[]], []),
        (scene[mask.numpy()], [0, 2, 4, 6, 8]),
        (scene[np.arange(9)[::-2]], [8, 6, 4, 2, 0]),
        (scene[mask.numpy()[::-1]], [0, 2, 4, 6, 8]),
        (scene[np.array([3, 1], dtype=">i8")], [3, 1]),
    ]
    for small, rows in taken:
        assert small.extras["label"].tolist() == rows
        assert torch.equal(small.means, scene.means[torch.tensor(rows, dtype=torch.int64)])
    with pytest.raises(InvalidArgumentError, match=r"found -2; write \[-2\] for a single one"):
        scene[-2]
    with pytest.raises(InvalidArgumentError, match=r"or row numbers, found 'label'\.$"):
        scene["label"]
    with pytest.raises(InvalidArgumentError, match=r"or row numbers, found 0\.5\.$"):
        scene[0.5]
    with pytest.raises(InvalidArgumentError, match=r"row numbers, found .{57}\.\.\.\.$"):
        scene[[0.5] * 1000]
    with pytest.raises(InvalidArgumentError, match=r"tensor\(\[\[False\], \[False\], "):
        scene[mask[:, None] & False]
    for of_bytes in (mask.byte(), mask.byte().numpy()):
        with pytest.raises(InvalidArgumentError, match="must be bool, and row numbers int32"):
            scene[of_bytes]
    with pytest.raises(InvalidArgumentError, match="for each of 9 Gaussians, found 8"):
        scene[mask[:8]]
    for rows in ([9], [0, -10], torch.tensor([12])):
        with pytest.raises(
            InvalidArgumentError, match="of 9 Gaussians must be from -9 to 8, found"
        ):
            scene[rows]


def test_a_scene_can_be_saved(tmp_path):
    scene = random_scene(9)
    scene.save(tmp_path / "a.ply")
    assert same_bits(cvtgs.load(tmp_path / "a.ply"), scene)
    with pytest.raises(OutputExistsError):
        scene.save(tmp_path / "a.ply")
    scene.save(tmp_path / "a.ply", overwrite=True, axes="rub")
    assert same_bits(cvtgs.load(tmp_path / "a.ply", axes="rub"), scene)


def test_an_empty_scene_is_valid():
    scene = GaussianScene(**tensors_of(0, 0))
    assert len(scene) == 0
    assert scene.masses.shape == (0,)


def test_masses_do_not_depend_on_chunks(monkeypatch):
    scene = random_scene(50)
    whole = scene.masses
    monkeypatch.setattr("cvtgs.scene._CHUNK", 7)
    assert torch.equal(scene.masses, whole)


def test_areas_and_masses_are_differentiable(monkeypatch):
    scenes = [
        GaussianScene(**{name: rows.clone().requires_grad_() for name, rows in tensors.items()})
        for tensors in [random_scene(50).tensors()] * 2
    ]
    monkeypatch.setattr("cvtgs.scene._CHUNK", 7)
    scenes[0].masses.sum().backward()
    scales, opacities = scenes[1].log_scales.double().exp(), scenes[1].opacities
    (mean_projected_area(scales) * opacities).sum().backward()
    for name in ("log_scales", "logit_opacities"):
        torch.testing.assert_close(*(getattr(scene, name).grad for scene in scenes))
    with torch.no_grad():
        assert not scenes[0].masses.requires_grad


def test_select_by_rows_and_by_mask():
    scene = random_scene(5).with_tensors({}, {"label": torch.arange(5)})
    rows = scene.select(torch.tensor([4, 0, 0]))
    assert rows.extras["label"].tolist() == [4, 0, 0]
    assert torch.equal(rows.means, scene.means[[4, 0, 0]])
    mask = torch.tensor([True, False, False, True, False])
    assert same_bits(scene.select(mask), scene.select(torch.tensor([0, 3])))
    for wrong in (mask[:3], torch.cat([mask, mask])):
        with pytest.raises(InvalidArgumentError, match="an entry for each of 5 Gaussians, found"):
            scene.select(wrong)
    with pytest.raises(InvalidArgumentError, match="must be from -5 to 4, found 5"):
        scene.select(torch.tensor([0, 5]))


def test_select_copies():
    scene = random_scene(3)
    copy = scene.select(torch.arange(3))
    copy.means.zero_()
    assert bool(scene.means.any())


def test_with_tensors_keeps_comments_and_layout():
    scene = GaussianScene(**tensors_of(), comments=["a"], layout=[["x", "float"]])
    changed = scene.with_tensors({"means": torch.ones(4, 3)}, {"b": torch.zeros(4)})
    assert changed.comments == ("a",)
    assert changed.layout == (("x", "float"),)
    assert changed.means.tolist() == [[1.0] * 3] * 4
    assert changed.quats is scene.quats
    assert set(changed.extras) == {"b"}


def test_to_the_same_device_is_the_same_scene():
    scene = random_scene(3)
    assert scene.to("cpu") is scene


def test_to_a_device_that_does_not_exist():
    with pytest.raises(DeviceError, match="device 'bogus' cannot be used here: torch has no such"):
        random_scene(3).to("bogus")


@pytest.mark.cuda
def test_to_another_device_and_back():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    scene = random_scene(3).with_tensors({}, {"label": torch.arange(3)})
    there = scene.to("cuda")
    assert there.extras["label"].device.type == "cuda"
    assert same_bits(there.to("cpu"), scene)


def test_scenes_are_frozen():
    scene = random_scene(3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.means = torch.zeros(3, 3)
    with pytest.raises(TypeError):
        scene.extras["a"] = torch.zeros(3)


def test_extras_are_not_shared_with_the_caller():
    extras = {"a": torch.zeros(4)}
    scene = GaussianScene(**tensors_of(), extras=extras)
    extras["b"] = torch.zeros(7)
    assert set(scene.extras) == {"a"}


@pytest.mark.parametrize(
    ("comment", "tagged"),
    [
        ("SplatRenderMode: mip", True),
        ("splatrendermode: MIP", True),
        ("SplatRenderMode: rgb", False),
        ("antialiased 1", True),  # of Postshot
        ("Antialiased  1 ", True),
        ("antialiased 0", False),
        ("antialiased 10", False),
        ("not antialiased 1", False),
    ],
)
def test_antialiased_tag(comment, tagged):
    assert GaussianScene(**tensors_of(), comments=("x", comment)).antialiased is tagged


def test_values_are_not_checked():
    tensors = tensors_of()
    tensors["means"][0, 0], tensors["logit_opacities"][0] = float("nan"), INF
    assert len(GaussianScene(**tensors)) == 4


def test_repr_shows_no_values():
    scene = random_scene(1234, degree=3)
    assert repr(scene) == "GaussianScene(1,234 Gaussians, SH degree 3, float32, cpu)"
    assert repr(scene.select(slice(1))) == "GaussianScene(1 Gaussian, SH degree 3, float32, cpu)"


@pytest.mark.parametrize(
    ("name", "shape", "wanted"),
    [
        ("means", (4, 2), "(n, 3)"),
        ("means", (4,), "(n, 3)"),
        ("quats", (4, 3), "(4, 4)"),
        ("quats", (3, 4), "(4, 4)"),
        ("log_scales", (4, 1), "(4, 3)"),
        ("logit_opacities", (4, 1), "(4,)"),
        ("sh0", (4, 3), "(4, 1, 3)"),
        ("shN", (4, 9), "(4, k, 3)"),
    ],
)
def test_wrong_shapes_are_errors(name, shape, wanted):
    message = error_of(**{name: torch.zeros(*shape)})
    assert message == f"{name} must have shape {wanted}, found {shape}."


def test_a_coefficient_count_that_fits_no_degree_is_an_error():
    assert error_of(shN=torch.zeros(4, 5, 3)) == (
        "shN must hold 0, 3, 8 or 15 coefficients per channel, found 5."
    )


def test_other_dtypes_are_errors():
    assert error_of(means=torch.zeros(4, 3, dtype=torch.float16)) == (
        "means must be float32 or float64, found torch.float16."
    )
    assert error_of(sh0=torch.zeros(4, 1, 3).double()) == (
        "sh0 must be torch.float32 on cpu like means, found torch.float64 on cpu."
    )
    assert error_of(quats=torch.zeros(4, 4, device="meta")) == (
        "quats must be torch.float32 on cpu like means, found torch.float32 on meta."
    )


def test_an_array_instead_of_a_tensor_is_an_error():
    assert error_of(quats=torch.zeros(4, 4).numpy()) == (
        "quats must be a torch.Tensor, found ndarray; use cvtgs.from_dict for numpy arrays."
    )


def test_extra_columns_of_the_wrong_shape_are_errors():
    assert error_of(extras={"heat": torch.zeros(4, 1)}) == (
        "extra column 'heat' must have shape (4,) on cpu, found (4, 1) on cpu."
    )


def test_extra_columns_that_cannot_be_selected_from_are_errors():
    text = "extra column 'id' must be a tensor of floats, bool, uint8 or signed integers, found "
    assert error_of(extras={"id": torch.zeros(4, dtype=torch.uint16)}) == f"{text}torch.uint16."
    assert error_of(extras={"id": [1, 2, 3, 4]}) == f"{text}list."


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"comments": "SplatRenderMode: mip"}, "comments must be a tuple of texts, found 'Splat"),
        ({"comments": (5,)}, "comments must be a tuple of texts, found (5,)."),
        ({"extras": {5: torch.zeros(4)}}, "names of extra columns must be a tuple of texts, found"),
        ({"extras": None}, "names of extra columns must be a tuple of texts, found None."),
    ],
)
def test_comments_and_names_are_texts(changes, text):
    assert error_of(**changes).startswith(text)


def test_a_tensor_without_rows_is_an_error():
    assert error_of(means=torch.tensor(1.0)) == "means must have shape (n, 3), found ()."


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda scene: pickle.loads(pickle.dumps(scene))])
def test_scenes_can_be_copied_and_sent_to_other_processes(copied):
    scene = random_scene(3, seed=0).with_tensors({}, {"label": torch.arange(3)})
    other = copied(scene)
    assert all(torch.equal(other.tensors()[name], value) for name, value in scene.tensors().items())
    assert torch.equal(other.extras["label"], scene.extras["label"])
    assert (other.comments, other.layout) == (scene.comments, scene.layout)
    own, theirs = ({x.data_ptr() for x in made.tensors().values()} for made in (scene, other))
    assert not own & theirs


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NamedScene(GaussianScene):
    name: str = ""


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda scene: pickle.loads(pickle.dumps(scene))])
def test_copies_of_a_subclass_keep_its_fields(copied):
    other = copied(NamedScene(**tensors_of(), name="garden"))
    assert type(other) is NamedScene
    assert (other.name, other[1:3].name) == ("garden", "garden")


def test_scenes_are_joined_in_their_order():
    scene = random_scene(7).with_tensors({}, {"label": torch.arange(7)})
    parts = [scene.select(torch.arange(first, last)) for first, last in ((0, 2), (2, 3), (3, 7))]
    assert same_bits(cvtgs.concatenate(parts), scene)
    assert cvtgs.concatenate(parts[:1]) is parts[0]


def test_scenes_that_do_not_match_are_not_joined():
    scene = random_scene(3)
    labelled = scene.with_tensors({}, {"label": torch.arange(3)})
    with pytest.raises(InvalidSceneError, match=r"must be alike.*, scene 1 .*columns .'label"):
        cvtgs.concatenate([scene, labelled])
    with pytest.raises(InvalidSceneError, match=r"has SH degree 0, .*, scene 1 SH degree 1,"):
        cvtgs.concatenate([random_scene(3, degree=0), random_scene(3, degree=1)])
    with pytest.raises(InvalidSceneError, match="at least one scene"):
        cvtgs.concatenate([])


def test_joining_tagged_and_other_scenes_warns():
    scene = random_scene(3)
    tagged = replace(scene, comments=("SplatRenderMode: mip",))
    with pytest.warns(UserWarning, match="some of the scenes to concatenate are tagged"):
        cvtgs.concatenate([scene, tagged])


def test_layouts_hold_pairs_and_tensors_have_names():
    for layout in (5, ("abc",), (1, 2), (("x",),), ((1, 2),)):
        with pytest.raises(InvalidSceneError, match="layout must be a tuple of pairs of texts, fo"):
            replace(random_scene(3), layout=layout)
    with pytest.raises(InvalidSceneError, match="tensors must be a mapping by name, found"):
        random_scene(3).with_tensors(torch.zeros(3))


def test_with_tensors_takes_keywords_and_keeps_extras():
    scene = random_scene(4).with_tensors({}, {"label": torch.arange(4)})
    changed = scene.with_tensors(sh0=torch.ones(4, 1, 3), shN=torch.zeros(4, 3, 3))
    assert (changed.sh_degree, float(changed.sh0.sum())) == (1, 12.0)
    assert changed.extras["label"].tolist() == [0, 1, 2, 3]
    assert torch.equal(changed.means, scene.means)
    with pytest.raises(InvalidSceneError, match=r"tensors of a scene are means, .*found scales;"):
        scene.with_tensors(scales=torch.ones(4, 3))
    with pytest.raises(InvalidSceneError, match=r"extra column 'label' must have shape \(2,\)"):
        scene.with_tensors(scene[:2].tensors())


def test_scenes_on_two_devices_are_not_joined():
    scene = random_scene(3)
    with pytest.raises(InvalidSceneError, match="concatenate needs one device, found cpu, meta"):
        cvtgs.concatenate([scene, scene.to("meta")])


def test_scenes_and_cameras_can_be_keys_of_weak_dictionaries():
    scene = random_scene(3)
    cameras = one_camera(4, 4)
    cache = weakref.WeakKeyDictionary({scene: 1, cameras: 2})
    assert (cache[scene], cache[cameras]) == (1, 2)
    del scene, cameras
    assert not cache
