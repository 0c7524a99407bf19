"""Reading PLY files: values, layouts, encodings, and agreement of both readers."""

import io
import random
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings, strategies as st

from cvtgs.errors import (
    DeviceError,
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
)
from cvtgs.io import load, save
from cvtgs.io.ply import join_plys, open_rows, read
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene
from ply_files import CODES, gaussian_properties, gaussian_rows, ply_bytes, write_ply_file
from scenes import random_scene

PROPERTIES = gaussian_properties()
ROWS = gaussian_rows(PROPERTIES, 3)
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")


def same(a: GaussianScene, b: GaussianScene) -> bool:
    """Compare bit for bit, NaN equal to NaN."""
    ours, theirs = {**a.tensors(), **a.extras}, {**b.tensors(), **b.extras}
    return (
        list(ours) == list(theirs)
        and a.layout == b.layout
        and a.comments == b.comments
        and all(
            ours[name].dtype == theirs[name].dtype
            and ours[name].shape == theirs[name].shape
            and ours[name].numpy().tobytes() == theirs[name].numpy().tobytes()
            for name in ours
        )
    )


def load_with_plyfile(path: Path) -> GaussianScene:
    """Load through the reader that the fast one must agree with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(read, "can_map", lambda header: False)
        return load(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_each_property_is_read_to_its_tensor(tmp_path: Path, encoding: str) -> None:
    properties = gaussian_properties(9)
    row = [1, 2, 3, 0, 0, 0, 4, 5, 6, *range(10, 19), 7, -1, -2, -3, 0.5, 0.25, 0.125, 1.5]
    scene = load(write_ply_file(tmp_path / "one.ply", properties, [row], encoding=encoding))
    assert scene.means.tolist() == [[1, 2, 3]]
    assert scene.sh0.tolist() == [[[4, 5, 6]]]
    assert scene.shN.tolist() == [[[10, 13, 16], [11, 14, 17], [12, 15, 18]]]
    assert scene.logit_opacities.tolist() == [7]
    assert scene.log_scales.tolist() == [[-1, -2, -3]]
    assert scene.quats.tolist() == [[0.5, 0.25, 0.125, 1.5]]
    assert scene.layout == tuple(properties)
    assert dict(scene.extras) == {}


@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (9, 1), (24, 2), (45, 3)])
def test_every_sh_degree_is_read(tmp_path: Path, rest: int, degree: int) -> None:
    properties = gaussian_properties(rest)
    rows = gaussian_rows(properties, 3)
    scene = load(write_ply_file(tmp_path / "s.ply", properties, rows))
    assert scene.sh_degree == degree
    assert scene.shN.shape == (3, rest // 3, 3)
    first = 9.0 + 0.25 * torch.arange(3.0)[:, None]
    expected = first + torch.arange(rest)
    torch.testing.assert_close(scene.shN.transpose(1, 2).reshape(3, rest), expected, rtol=0, atol=0)


def test_reading_in_chunks_keeps_every_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(read, "CHUNK_BYTES", 3 * 17 * 4 + 5)
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 10)
    scene = load(write_ply_file(tmp_path / "s.ply", properties, rows))
    assert scene.means[:, 0].tolist() == [0.25 * i for i in range(10)]
    assert scene.quats[:, 3].tolist() == [0.25 * i + 16 for i in range(10)]


def test_normals_and_the_third_scale_may_be_missing(tmp_path: Path) -> None:
    properties = [p for p in gaussian_properties(normals=False) if p[0] != "scale_2"]
    scene = load(write_ply_file(tmp_path / "s.ply", properties, gaussian_rows(properties, 2)))
    assert scene.log_scales[:, 2].tolist() == [FLAT_LOG_SCALE, FLAT_LOG_SCALE] == [-20, -20]
    assert "scale_2" not in dict(scene.layout)


def test_normals_are_extras_only_if_any_is_nonzero(tmp_path: Path) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 5)
    rows[3][5] = 1.0
    scene = load(write_ply_file(tmp_path / "s.ply", properties, rows))
    assert list(scene.extras) == ["nx", "ny", "nz"]
    assert scene.extras["nz"].tolist() == [0, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("kind", "value", "dtype"),
    [
        ("char", -128, torch.int8),
        ("uchar", 255, torch.uint8),
        ("short", -32768, torch.int16),
        ("ushort", 65535, torch.int32),
        ("int", -(2**31), torch.int32),
        ("uint", 2**32 - 1, torch.int64),
        ("float", 0.5, torch.float32),
        ("double", 0.1, torch.float64),
    ],
)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_extra_columns_keep_every_value(
    tmp_path: Path, kind: str, value: float, dtype: torch.dtype, encoding: str
) -> None:
    properties = [("label", kind), *gaussian_properties()]
    row = [value, *gaussian_rows(gaussian_properties(), 1)[0]]
    scene = load(write_ply_file(tmp_path / "s.ply", properties, [row], encoding=encoding))
    assert scene.extras["label"].dtype == dtype
    assert scene.extras["label"].tolist() == [value]
    assert scene.layout[0] == ("label", kind)


@pytest.mark.parametrize("axes", ["xyz", "x"])
def test_double_coordinates_make_a_float64_scene(tmp_path: Path, axes: str) -> None:
    properties = [
        (name, "double" if name in axes else kind) for name, kind in gaussian_properties()
    ]
    rows = gaussian_rows(properties, 1)
    rows[0][0] = 0.1
    scene = load(write_ply_file(tmp_path / "s.ply", properties, rows))
    assert scene.dtype == torch.float64
    assert scene.means[0, 0].item() == 0.1


def test_integers_beside_doubles_are_written_as_doubles(tmp_path: Path) -> None:
    """Positions in metres of a survey; a float would round them."""
    properties = [
        (name, {"x": "double", "y": "int"}.get(name, kind)) for name, kind in gaussian_properties()
    ]
    rows = gaussian_rows(properties, 2)
    rows[0][1], rows[1][1] = 35_000_007, 5
    write_ply_file(tmp_path / "in.ply", properties, rows)
    scene = load(tmp_path / "in.ply")
    assert dict(scene.layout)["y"] == "double"
    save(scene, tmp_path / "out.ply")
    assert load(tmp_path / "out.ply").means[:, 1].tolist() == [35_000_007.0, 5.0]


def test_standard_properties_may_be_integers(tmp_path: Path) -> None:
    properties = [
        (name, "uchar" if name == "opacity" else kind) for name, kind in gaussian_properties()
    ]
    scene = load(write_ply_file(tmp_path / "s.ply", properties, gaussian_rows(properties, 1)))
    assert scene.logit_opacities.tolist() == [9.0]
    assert dict(scene.layout)["opacity"] == "float"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_nan_and_infinity_are_returned_as_they_are(tmp_path: Path, encoding: str) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 2)
    rows[0][0], rows[1][9] = float("nan"), float("-inf")
    scene = load(write_ply_file(tmp_path / "s.ply", properties, rows, encoding=encoding))
    assert scene.means[0, 0].isnan()
    assert scene.logit_opacities[1].item() == float("-inf")


def test_comments_are_kept_wherever_they_are_in_the_header(tmp_path: Path) -> None:
    data = ply_bytes(gaussian_properties(), [[0.0] * 17], comments=["SplatRenderMode: mip", ""])
    data = data.replace(b"property float y", b"comment  two  blanks \nobj_info 7\nproperty float y")
    data = data.replace(b"end_header", "comment K\u00e4se\nend_header".encode())
    path = tmp_path / "s.ply"
    path.write_bytes(data)
    scene = load(path)
    assert scene.comments == ("SplatRenderMode: mip", "", " two  blanks", "7", "K\u00e4se")
    assert scene.antialiased
    assert same(scene, load_with_plyfile(path))


def test_a_comment_between_carriage_returns_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "s.ply"
    write_ply_file(path, PROPERTIES, ROWS, comments=["first\nsecond"], newline="\r")
    assert load(path).comments == ("first second",)  # else no PLY could hold it


def test_empty_lists_need_no_room_for_items(tmp_path: Path) -> None:
    faces = {"face": ([("corners", "list uchar double")], [[[]], [[]]])}
    path = write_ply_file(tmp_path / "s.ply", PROPERTIES, ROWS, before=faces)
    plain = write_ply_file(tmp_path / "plain.ply", PROPERTIES, ROWS)
    with pytest.warns(DroppedDataWarning, match=r"element 'face' \(2 rows\)"):
        found = load(path)
    assert same(found, load(plain))


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r", "  \n", " \t\r\n"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_line_ends_and_blanks_are_accepted(tmp_path: Path, newline: str, encoding: str) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 3)
    path = tmp_path / "s.ply"
    write_ply_file(path, properties, rows, encoding=encoding, newline=newline)
    plain = write_ply_file(tmp_path / "plain.ply", properties, rows)
    assert same(load(path), load(plain))


def test_the_first_value_may_look_like_a_line_end(tmp_path: Path) -> None:
    properties = [("flag", "uchar"), *gaussian_properties()]
    rows = [[10, *[0.0] * 17], [13, *[0.0] * 17]]
    for newline in ("\n", "\r\n", "\r"):
        path = write_ply_file(tmp_path / "s.ply", properties, rows, newline=newline)
        assert load(path).extras["flag"].tolist() == [10, 13]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("where", ["before", "after"])
def test_other_elements_give_a_warning(tmp_path: Path, encoding: str, where: str) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 4)
    others = {
        "extrinsic": ([("extrinsic", "float")], [[1.0]] * 16),
        "face": ([("vertex_indices", "list uchar int")], [[[0, 1, 2]], [[]]]),
        "nothing": ([("q", "float")], []),
    }
    path = write_ply_file(
        tmp_path / "s.ply", properties, rows, encoding=encoding, **{where: others}
    )
    with pytest.warns(DroppedDataWarning) as caught:
        scene = load(path)
    assert [str(w.message) for w in caught] == [
        f"{path}: left out element 'extrinsic' (16 rows), element 'face' (2 rows)."
    ]
    assert caught[0].filename == __file__
    assert same(scene, load(write_ply_file(tmp_path / "plain.ply", properties, rows)))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_list_properties_are_left_out_with_a_warning(tmp_path: Path, encoding: str) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 3)
    listed = [*properties[:4], ("seen_by", "list uchar short"), *properties[4:]]
    lists = [[*row[:4], [7] * i, *row[4:]] for i, row in enumerate(rows)]
    path = write_ply_file(tmp_path / "s.ply", listed, lists, encoding=encoding)
    with pytest.warns(DroppedDataWarning, match=r"list property 'seen_by' of 'vertex' \(3 rows\)"):
        scene = load(path)
    assert same(scene, load(write_ply_file(tmp_path / "plain.ply", properties, rows)))


@st.composite
def layouts(draw: st.DrawFn) -> list[tuple[str, str]]:
    """Draw a shuffled layout with random types, some extras and some columns missing."""
    properties = list(gaussian_properties(draw(st.sampled_from([0, 9, 24, 45]))))
    optional = {"nx", "ny", "nz", "scale_2"}
    left_out = draw(st.sets(st.sampled_from(sorted(optional))))
    names = [name for name, _ in properties if name not in left_out]
    names += [f"extra {i}".replace(" ", "_") for i in range(draw(st.integers(0, 3)))]
    random.Random(draw(st.integers(0, 99))).shuffle(names)
    if draw(st.booleans()):
        return [(name, "float") for name in names]
    return [(name, draw(st.sampled_from(sorted(CODES)))) for name in names]


@settings(max_examples=40, deadline=None)
@given(properties=layouts(), count=st.integers(1, 7), seed=st.integers(0, 2**31))
def test_both_readers_and_all_encodings_agree(
    tmp_path_factory: pytest.TempPathFactory,
    properties: list[tuple[str, str]],
    count: int,
    seed: int,
) -> None:
    folder = tmp_path_factory.mktemp("agree")
    draw = random.Random(seed)
    rows = [[float(draw.randrange(100)) for _ in properties] for _ in range(count)]
    paths = [
        write_ply_file(folder / f"{name}.ply", properties, rows, encoding=name)
        for name in ENCODINGS
    ]
    expected = load_with_plyfile(paths[1])
    assert all(same(load(path), expected) for path in paths)
    columns = {name: [row[j] for row in rows] for j, (name, _) in enumerate(properties)}
    assert expected.means.tolist() == [list(p) for p in zip(*map(columns.get, "xyz"), strict=True)]


def test_doubles_too_large_for_float32_become_infinite(tmp_path: Path) -> None:
    properties = [
        (name, "double" if name == "opacity" else kind) for name, kind in gaussian_properties()
    ]
    rows = gaussian_rows(properties, 1)
    rows[0][9] = 1e300
    path = write_ply_file(tmp_path / "s.ply", properties, rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(path).logit_opacities.item() == float("inf")


def test_an_unknown_device_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="device 'tpu9' cannot be used here: "):
        load(tmp_path / "s.ply", device="tpu9")


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_only_binary_little_endian_files_are_read_in_parts(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(PROPERTIES, ROWS, encoding=encoding))
    with pytest.raises(FileFormatError) as caught:
        open_rows(path)
    assert str(caught.value) == (
        f"{path}: only binary little endian PLY files with vertices first can be read in parts; "
        f"write one with cvtgs convert."
    )


def test_missing_files_and_directories_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputNotFoundError, match=r"none\.ply: the file to read must exist"):
        open_rows(tmp_path / "none.ply")
    with pytest.raises(InputError, match="must be a regular file, found a directory"):
        open_rows(tmp_path)


def test_files_with_different_columns_are_not_joined(tmp_path: Path) -> None:
    first, second = tmp_path / "first.ply", tmp_path / "second.ply"
    first.write_bytes(ply_bytes(PROPERTIES, ROWS))
    second.write_bytes(ply_bytes([*PROPERTIES, ("q", "float")], [[*row, 1.0] for row in ROWS]))
    with pytest.raises(FileFormatError) as caught:
        join_plys([first, second], io.BytesIO())
    assert str(caught.value) == f"{second}: must have the same columns as {first}."


def test_the_tag_of_postshot_is_kept_in_other_formats(tmp_path: Path) -> None:
    scene = replace(random_scene(20), comments=("antialiased 1",))
    save(scene, tmp_path / "a.ply")
    for suffix in (".spz", ".sog", ".glb", ".compressed.ply"):
        save(load(tmp_path / "a.ply"), tmp_path / f"b{suffix}")
        assert load(tmp_path / f"b{suffix}").antialiased
