"""Writing PLY files: their bytes and layouts, and round trips without loss."""

import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidSceneError
from cvtgs.io import load, losses, save
from cvtgs.io.ply import write
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene
from cvtgs.text import shown
from format_cases import WRITABLE
from ply_files import gaussian_properties, gaussian_rows, parse_header, write_ply_file
from scenes import random_scene


def make_scene(
    n: int = 5, k: int = 0, dtype: torch.dtype = torch.float32, **rest: Any
) -> GaussianScene:
    generator = torch.Generator().manual_seed(n + k)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=dtype)

    return GaussianScene(
        means=draw(n, 3),
        quats=draw(n, 4),
        log_scales=draw(n, 3),
        logit_opacities=draw(n),
        sh0=draw(n, 1, 3),
        shN=draw(n, k, 3),
        **rest,
    )


def assert_same(a: GaussianScene, b: GaussianScene) -> None:
    ours, theirs = {**a.tensors(), **a.extras}, {**b.tensors(), **b.extras}
    assert list(ours) == list(theirs)
    for name, tensor in ours.items():
        assert tensor.dtype == theirs[name].dtype, name
        assert tensor.numpy().tobytes() == theirs[name].numpy().tobytes(), name
    assert a.comments == b.comments


def properties_of(path: Path) -> list[tuple[str, str]]:
    lines, _ = parse_header(path.read_bytes())
    return [(line.split()[2], line.split()[1]) for line in lines if line.startswith("property")]


def test_the_bytes_of_one_gaussian_are_as_expected(tmp_path: Path) -> None:
    scene = GaussianScene(
        means=torch.tensor([[1.0, 2, 3]]),
        quats=torch.tensor([[13.0, 14, 15, 16]]),
        log_scales=torch.tensor([[10.0, 11, 12]]),
        logit_opacities=torch.tensor([9.0]),
        sh0=torch.tensor([[[4.0, 5, 6]]]),
        shN=torch.arange(20.0, 29).reshape(1, 3, 3),
        comments=("SplatRenderMode: mip", ""),
    )
    save(scene, tmp_path / "one.ply")
    lines, start = parse_header((tmp_path / "one.ply").read_bytes())
    assert lines == [
        "ply",
        "format binary_little_endian 1.0",
        "comment SplatRenderMode: mip",
        "comment",
        "element vertex 1",
        *(f"property float {name}" for name, _ in gaussian_properties(9)),
        "end_header",
    ]
    rest = [20, 23, 26, 21, 24, 27, 22, 25, 28]
    expected = [1, 2, 3, 0, 0, 0, 4, 5, 6, *rest, *range(9, 17)]
    assert (tmp_path / "one.ply").read_bytes()[start:] == struct.pack("<26f", *expected)


@pytest.mark.parametrize("k", [0, 3, 8, 15])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_writing_and_reading_keeps_every_bit(
    tmp_path: Path, k: int, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(write, "CHUNK_BYTES", 1000)
    n = 37
    extras = {
        "label": torch.arange(n, dtype=torch.int32) - 5,
        "wide": torch.arange(n, dtype=torch.int64) + 2**31,
        "byte": torch.arange(n, dtype=torch.uint8),
        "signed": torch.arange(n, dtype=torch.int8) - 9,
        "short": torch.arange(n, dtype=torch.int16) - 999,
        "filter_3D": torch.linspace(0, 1, n),
        "precise": torch.linspace(0, 1, n, dtype=torch.float64),
        "nz": torch.ones(n),
    }
    scene = make_scene(n, k, dtype, extras=extras, comments=("a", "b  c"))
    scene.means[3, 1] = float("nan")
    scene.logit_opacities[4] = float("inf")
    save(scene, tmp_path / "s.ply")
    again = load(tmp_path / "s.ply")
    assert set(again.extras) == {*extras, "nx", "ny"}
    assert_same(replace(again, extras={name: again.extras[name] for name in extras}), scene)
    save(again, tmp_path / "t.ply")
    assert (tmp_path / "s.ply").read_bytes() == (tmp_path / "t.ply").read_bytes()


def test_reading_and_writing_a_file_keeps_its_bytes(tmp_path: Path) -> None:
    properties = [
        ("rot_3", "float"), ("label", "ushort"), ("x", "double"), ("y", "double"),
        ("z", "double"), ("ny", "uchar"), ("opacity", "double"), ("rot_0", "float"),
        ("rot_1", "float"), ("rot_2", "float"), ("scale_1", "float"), ("scale_0", "float"),
        ("f_dc_2", "float"), ("f_dc_0", "float"), ("f_dc_1", "float"), ("seen", "uint"),
    ]  # fmt: skip
    path = write_ply_file(
        tmp_path / "s.ply", properties, gaussian_rows(properties, 4), comments=["kept"]
    )
    save(load(path), tmp_path / "t.ply")
    assert (tmp_path / "t.ply").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_other_encodings_are_written_as_little_endian(tmp_path: Path, encoding: str) -> None:
    properties = gaussian_properties(9)
    rows = gaussian_rows(properties, 4)
    save(
        load(write_ply_file(tmp_path / "s.ply", properties, rows, encoding=encoding)),
        tmp_path / "t.ply",
    )
    plain = write_ply_file(tmp_path / "plain.ply", properties, rows)
    assert (tmp_path / "t.ply").read_bytes() == plain.read_bytes()


def loaded(tmp_path: Path, properties: Any) -> GaussianScene:
    return load(write_ply_file(tmp_path / "in.ply", properties, gaussian_rows(properties, 3)))


def test_layout_follows_the_sh_degree(tmp_path: Path) -> None:
    scene = loaded(tmp_path, [("label", "int"), *gaussian_properties(9)])
    lower = replace(scene, shN=torch.zeros(3, 0, 3))
    higher = replace(scene, shN=torch.zeros(3, 8, 3))
    for name, changed, rest in (("lower", lower, 0), ("higher", higher, 24)):
        path = tmp_path / f"{name}.ply"
        save(changed, path)
        assert properties_of(path) == [("label", "int"), *gaussian_properties(rest)]
        assert_same(load(path), changed)


def test_layout_follows_the_extras(tmp_path: Path) -> None:
    scene = loaded(tmp_path, [("old", "int"), *gaussian_properties(), ("kept", "ushort")])
    extras = {"new": torch.ones(3), "kept": scene.extras["kept"]}
    save(replace(scene, extras=extras), tmp_path / "s.ply")
    assert properties_of(tmp_path / "s.ply") == [
        *gaussian_properties(),
        ("kept", "ushort"),
        ("new", "float"),
    ]


def test_layout_follows_the_dtype(tmp_path: Path) -> None:
    scene = loaded(tmp_path, gaussian_properties(3 * 3))
    doubled = scene.with_tensors({k: v.double() for k, v in scene.tensors().items()}, {})
    save(doubled, tmp_path / "s.ply")
    assert_same(load(tmp_path / "s.ply"), doubled)


def test_an_extra_too_large_for_its_type_gets_a_wider_type(tmp_path: Path) -> None:
    scene = loaded(tmp_path, [*gaussian_properties(), ("label", "ushort")])
    label = torch.tensor([0, -1, 70000], dtype=torch.int32)
    changed = replace(scene, extras={"label": label})
    save(changed, tmp_path / "s.ply")
    assert properties_of(tmp_path / "s.ply")[-1] == ("label", "int")
    assert load(tmp_path / "s.ply").extras["label"].tolist() == label.tolist()


@pytest.mark.parametrize(
    ("column", "kind"),
    [
        (torch.tensor([True, False]), "uchar"),
        (torch.tensor([0.5, 1.5], dtype=torch.float16), "float"),
        (torch.tensor([0.5, 1.5], dtype=torch.bfloat16), "float"),
        (torch.tensor([0, 2**32 - 1]), "uint"),
        (torch.tensor([-1, 2**31 - 1]), "int"),
    ],
)
def test_extras_are_written_with_fitting_types(tmp_path: Path, column: Tensor, kind: str) -> None:
    save(make_scene(2, extras={"q": column}), tmp_path / "s.ply")
    assert properties_of(tmp_path / "s.ply")[-1] == ("q", kind)
    assert load(tmp_path / "s.ply").extras["q"].tolist() == column.tolist()


def test_scenes_of_2dgs_are_written_without_a_third_scale(tmp_path: Path) -> None:
    properties = [p for p in gaussian_properties() if p[0] != "scale_2"]
    scene = loaded(tmp_path, properties)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save(scene, tmp_path / "s.ply")
    assert (tmp_path / "s.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    thick = scene.log_scales.clone()
    thick[1:, 2] = FLAT_LOG_SCALE / 2
    with pytest.warns(DroppedDataWarning) as caught:
        save(replace(scene, log_scales=thick), tmp_path / "t.ply")
    assert str(caught[0].message) == (
        f"{tmp_path / 't.ply'}: left out the third scale of 2 Gaussians, since the file that the "
        f"scene came from has no scale_2 (2DGS)."
    )
    assert losses(replace(scene, log_scales=thick), "t.ply").dropped == (
        "the third scale of 2 Gaussians, since the file that the scene came from has no scale_2 "
        "(2DGS)",
    )
    assert caught[0].filename == __file__


def test_an_extra_column_named_like_packed_data_is_read_back(tmp_path: Path) -> None:
    path, column = tmp_path / "scene.ply", torch.arange(3.0)
    save(random_scene(3).with_tensors({}, {"packed_position": column}), path)
    assert torch.equal(load(path).extras["packed_position"], column)


def test_parameters_with_gradients_can_be_saved(tmp_path: Path) -> None:
    scene = make_scene()
    trained = replace(scene, means=torch.nn.Parameter(scene.means))
    save(trained, tmp_path / "s.ply")
    assert_same(load(tmp_path / "s.ply"), scene)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"extras": {"opacity": torch.ones(2)}},
            "extra column 'opacity' must not be named like a property of the scene itself.",
        ),
        (
            {"extras": {"f_rest_7": torch.ones(2)}},
            "extra column 'f_rest_7' must not be named like a property of the scene itself.",
        ),
        (
            {"extras": {"a b": torch.ones(2)}},
            "column 'a b' must have a name of at most 200 letters without blanks.",
        ),
        (
            {"extras": {"a" * 201: torch.ones(2)}},
            f"column {shown('a' * 201)} must have a name of at most 200 letters without blanks.",
        ),
        (
            {"extras": {"q": torch.tensor([-1, 2**31])}},
            "extra column 'q' must fit into 32 bits, found -1 to 2147483648.",
        ),
        (
            {"extras": {"q": torch.ones(2, dtype=torch.complex64)}},
            "extra column 'q' must be real for a PLY, found torch.complex64.",
        ),
        (
            {"comments": ("fine", "end\nend_header")},
            "a PLY comment must be one line, found 'end\\nend_header'.",
        ),
        (
            {"comments": ("\ud800",)},
            "comments and columns must be Unicode text, found '\\ud800'.",
        ),
        (
            {"comments": ("x" * (1 << 20),)},
            "a PLY header must take at most 1,048,576 bytes, found 1,048,996.",
        ),
        (
            {"layout": (("x", "half"), ("scale_2", "float"))},
            "the layout must give 'x' a type of char, uchar, short, ushort, int, uint, float, "
            "double, found 'half'.",
        ),
    ],
)
def test_unwritable_data_is_refused(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidSceneError) as caught:
        save(make_scene(2, **changes), tmp_path / "s.ply")
    assert str(caught.value) == text
    assert list(tmp_path.iterdir()) == []


def test_an_empty_scene_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidSceneError) as caught:
        save(make_scene(0), tmp_path / "s.ply")
    assert str(caught.value) == ("a scene must hold at least one Gaussian to be written, found 0.")


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError) as caught:
        save(make_scene(), tmp_path / "s.ckpt")
    assert str(caught.value) == (
        f"{tmp_path}/s.ckpt: the name must end in {WRITABLE}, found the suffix '.ckpt'."
    )
