"""Conversion from and to the dictionaries of gsplat and nerfstudio."""

import math
import re
from typing import Any

import numpy as np
import pytest
import torch

from cvtgs import synthetic
from cvtgs.errors import InvalidSceneError
from cvtgs.io import from_dict, to_dict

KNOWN = (
    "means, quats, scales, opacities, sh0 (or features_dc) and, above SH degree 0, "
    "shN (or features_rest)"
)


def gsplat(n: int = 2, k: int = 3) -> dict[str, Any]:
    return {
        "means": torch.arange(3.0 * n).reshape(n, 3),
        "quats": torch.ones(n, 4),
        "scales": torch.full((n, 3), -2.0),
        "opacities": torch.full((n,), 0.25),
        "sh0": torch.full((n, 1, 3), 0.5),
        "shN": torch.full((n, k, 3), 0.125),
    }


def splatfacto(prefix: str = "") -> dict[str, Any]:
    d = gsplat()
    d["opacities"] = d["opacities"][:, None]
    d["features_dc"], d["features_rest"] = d.pop("sh0")[:, 0], d.pop("shN")
    return {prefix + name: torch.nn.Parameter(value) for name, value in d.items()}


def test_gsplat_values_are_read_as_stored_values() -> None:
    scene = from_dict(gsplat())
    assert scene.means.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert scene.log_scales.tolist() == [[-2] * 3] * 2
    assert scene.logit_opacities.tolist() == [0.25] * 2
    assert scene.sh_degree == 1


@pytest.mark.parametrize("value", [None, 3, "scene.ply", [torch.zeros(2, 3)]])
def test_anything_but_a_dictionary_is_refused(value: Any) -> None:
    with pytest.raises(InvalidSceneError, match="a scene is made from a dictionary, found "):
        from_dict(value)


def test_an_empty_dictionary_is_an_empty_scene() -> None:
    assert (
        len(from_dict({name: value[:0] for name, value in gsplat().items()}, activated=True)) == 0
    )


def test_activated_values_are_converted() -> None:
    values = {
        **gsplat(),
        "scales": torch.full((2, 3), math.e),
        "opacities": torch.tensor([[0.5], [1]]),
    }
    scene = from_dict(values, activated=True)
    assert scene.log_scales.tolist() == [pytest.approx([1] * 3)] * 2  # log rounds by processor
    assert scene.logit_opacities[0] == 0
    assert scene.logit_opacities.isfinite().all()


@pytest.mark.parametrize("prefix", ["", "gauss_params.", "_model.gauss_params."])
def test_nerfstudio_names_give_the_same_scene(prefix: str) -> None:
    other = {f"{prefix}x.y".replace("gauss_params.", "camera."): torch.zeros(1)} if prefix else {}
    scene = from_dict({**splatfacto(prefix), **other})
    for name, tensor in from_dict(gsplat()).tensors().items():
        assert torch.equal(scene.tensors()[name], tensor)
    assert not any(tensor.requires_grad for tensor in scene.tensors().values())


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f2"])
def test_numpy_arrays_are_copied(kind: str) -> None:
    arrays = {name: value.numpy().astype(kind) for name, value in gsplat().items()}
    arrays["means"].flags.writeable = False
    scene = from_dict(arrays)
    arrays["quats"][:] = 7
    assert scene.dtype == torch.float32
    assert scene.quats.tolist() == [[1] * 4] * 2
    assert scene.means.tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize(
    ("dtype", "wanted"),
    [
        (torch.float16, torch.float32),
        (torch.bfloat16, torch.float32),
        (torch.float64, torch.float64),
    ],
)
def test_half_becomes_float32_and_double_stays(dtype: torch.dtype, wanted: torch.dtype) -> None:
    values = gsplat()
    scene = from_dict({**values, "means": values["means"].to(dtype)})
    assert {tensor.dtype for tensor in scene.tensors().values()} == {wanted}


def test_longer_floats_of_numpy_are_refused() -> None:
    values = gsplat()
    means = values["means"].numpy().astype(np.longdouble)
    if means.dtype.itemsize > 8:  # some systems have none
        with pytest.raises(InvalidSceneError, match="means must be a torch"):
            from_dict({**values, "means": means})


def test_missing_view_dependent_colour_gives_degree_0() -> None:
    values = gsplat()
    del values["shN"]
    assert from_dict(values).sh_degree == 0


def test_to_dict_inverts_from_dict() -> None:
    values = gsplat()
    again = to_dict(from_dict(values))
    assert list(again) == ["means", "quats", "scales", "opacities", "sh0", "shN"]
    assert all(torch.equal(again[name], value) for name, value in values.items())


def test_the_mapping_is_not_changed() -> None:
    values = gsplat()
    before = {name: value.clone() for name, value in values.items()}
    from_dict({**values, "scales": values["scales"].exp()}, activated=True)
    assert all(torch.equal(values[name], value) for name, value in before.items())


@pytest.mark.parametrize(
    ("changes", "activated", "text"),
    [
        (
            {"quats": None, "sh0": None},
            False,
            f"a dictionary must hold {KNOWN}, found no quats, sh0.",
        ),
        (
            {"colors": torch.zeros(2, 3)},
            False,
            f"the names must be {KNOWN}, found 'colors'.",
        ),
        (
            {"step": 7, "splats": {}},
            False,
            f"the names must be {KNOWN}, found 'step'; pass the dictionary at 'splats'.",
        ),
        (
            {"features_dc": torch.zeros(2, 3)},
            False,
            "a dictionary must hold sh0 once, found 'sh0' and 'features_dc'.",
        ),
        (
            {"a.means": torch.zeros(2, 3)},
            False,
            "means must occur once, found 'means' and 'a.means'.",
        ),
        (
            {"means": [[0.0, 0.0, 0.0]] * 2},
            False,
            "means must be a torch.Tensor or numpy array of floats, found list.",
        ),
        (
            {"means": np.zeros((2, 3), dtype=np.int64)},
            False,
            "means must be a torch.Tensor or numpy array of floats, found int64.",
        ),
        (
            {"scales": torch.tensor([[1.0, 1, 1], [1, -1, 1]])},
            True,
            "activated scales must be at least 0, found 1 rows that are not, the first is row 1; "
            "pass activated=False for stored values.",
        ),
        (
            {"scales": torch.ones(2, 3), "opacities": torch.tensor([-3.0, 2.0])},
            True,
            "activated opacities must be from 0 to 1, found 2 rows that are not, the first is row "
            "0; pass activated=False for stored values.",
        ),
        (
            {"quats": torch.zeros(2, 3)},
            False,
            "quats must have shape (2, 4), found (2, 3).",
        ),
        (
            {"means": torch.zeros(3, 2)},
            False,
            "means must have shape (n, 3), found (3, 2).",
        ),
    ],
)
def test_bad_dictionaries_are_refused(changes: dict[str, Any], activated: bool, text: str) -> None:
    values = {name: v for name, v in {**gsplat(), **changes}.items() if v is not None}
    with pytest.raises(InvalidSceneError) as caught:
        from_dict(values, activated=activated)
    assert str(caught.value) == text


def splats(count: int = 200, **changes: torch.Tensor) -> dict[str, torch.Tensor]:
    return to_dict(scene_of_object(count)) | changes


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"opacities": torch.linspace(0.02, 0.99, 200)}, "opacities from 0.02 to 0.99: they are"),
        (
            {"scales": torch.linspace(0.001, 0.8, 600).reshape(200, 3)},
            "scales from 0.001 to 0.8: they are",
        ),
        (
            {
                "opacities": torch.linspace(0, 1, 200),
                "scales": torch.linspace(0.001, 0.8, 600).reshape(200, 3),
            },
            "opacities from 0 to 1 and scales from 0.001 to 0.8: they are read as stored values",
        ),
    ],
)
@pytest.mark.parametrize("first", [None, torch.nan, torch.inf])
def test_values_that_look_activated_are_warned_about(changes, found, first):
    if first is not None:  # a value that is no number hides nothing
        for values in (changes := {name: rows.clone() for name, rows in changes.items()}).values():
            values.view(-1)[len(values) // 2] = first
    with pytest.warns(UserWarning, match=re.escape(found)) as caught:
        from_dict(splats(**changes))
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_stored_values_give_no_warning():
    from_dict(splats())
    from_dict(splats(scales=torch.linspace(0.1, 5, 600).reshape(200, 3)))  # millimetres
    from_dict(splats(opacities=torch.full((200,), 0.5)))
    from_dict({name: rows[:50] for name, rows in splats(opacities=torch.rand(200)).items()})
    activated = {"scales": torch.rand(200, 3), "opacities": torch.rand(200)}
    from_dict(splats(**activated), activated=True)


def test_the_parameter_dict_of_gsplat_is_accepted():
    scene = scene_of_object(20)
    parameters = {name: torch.nn.Parameter(one) for name, one in to_dict(scene).items()}
    made = from_dict(torch.nn.ParameterDict(parameters))
    assert torch.equal(made.means, scene.means)
    assert not made.means.requires_grad


def scene_of_object(count: int):
    return synthetic.scene("object", count, sh_degree=0, seed=0)
