"""glTF with ``KHR_gaussian_splatting``."""

import base64
import io
import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import torch

from cvtgs import GaussianScene, load, save
from cvtgs.errors import DroppedDataWarning
from cvtgs.io import change_axes, losses
from cvtgs.io.gltf.write import write_glb
from cvtgs.math.parameters import build_covariances, normalize_quats
from format_cases import DATA, assert_as_oracle, assert_within, refusal, storable_scene
from format_oracles import read_glb, read_spz
from gltf_cases import NAME, accessor, changed, parts, primitive
from scenes import moved, same_bits

BOUNDS = {"means": 0.0, "log_scales": 1e-6, "opacities": 2e-7, "sh0": 0.0, "shN": 0.0}


def covariances(scene: GaussianScene) -> torch.Tensor:
    return build_covariances(scene.scales, normalize_quats(scene.quats))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "a.glb"
    save(storable_scene(5, degree=1), path)
    return path


def test_written_numbers_are_as_computed_by_hand(tmp_path: Path) -> None:
    """A Gaussian at (1, 2, 3) of a PLY, turned by pi about x; glTF has y up and x left."""
    scene = GaussianScene(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=torch.tensor([[0.0, 5.0, 0.0, 0.0]]),
        log_scales=torch.tensor([[0.0, math.log(2), math.log(3)]]),
        logit_opacities=torch.tensor([0.0]),
        sh0=torch.tensor([[[0.0, 1.0, 9.0]]]),
        shN=torch.arange(9.0).reshape(1, 3, 3),
        comments=("by hand",),
    )
    path = tmp_path / "a.glb"
    save(scene, path)
    document, binary = parts(path.read_bytes())
    found = primitive(document)
    assert (found["mode"], found["extras"]) == (0, {"comments": ["by hand"]})
    assert found["extensions"] == {NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    assert document["extensionsUsed"] == [NAME]
    values = {}
    for name, index in found["attributes"].items():
        view = document["bufferViews"][document["accessors"][index]["bufferView"]]
        values[name.removeprefix(f"{NAME}:")] = binary[view["byteOffset"] :][: view["byteLength"]]
    assert values.pop("COLOR_0") == bytes([128, round(255 * 0.78209479), 255, 128])
    assert {name: struct.unpack(f"<{len(v) // 4}f", v) for name, v in values.items()} == {
        "POSITION": (-1, -2, 3),
        "ROTATION": (-1, 0, 0, 0),
        "SCALE": (1, 2, 3),
        "OPACITY": (0.5,),
        "SH_DEGREE_0_COEF_0": (0, 1, 9),
        "SH_DEGREE_1_COEF_0": (0, -1, -2),
        "SH_DEGREE_1_COEF_1": (3, 4, 5),
        "SH_DEGREE_1_COEF_2": (-6, -7, -8),
    }
    position = document["accessors"][found["attributes"]["POSITION"]]
    assert position["min"] == position["max"] == [-1, -2, 3]


def test_a_file_of_splat_transform_is_read() -> None:
    path = DATA / "splat-transform.glb"
    scene, source = load(path), load(DATA / "source.ply")
    assert_as_oracle(change_axes(scene, "rdf", "luf"), read_glb(path.read_bytes()))
    assert_within(source, scene, BOUNDS)
    torch.testing.assert_close(covariances(scene), covariances(source))


@pytest.mark.parametrize("end", ["glb", "gltf"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path: Path, degree: int, end: str) -> None:
    path = tmp_path / f"a.{end}"
    scene = storable_scene(30, degree=degree)
    save(scene, path)
    again = load(path)
    assert again.comments == scene.comments
    assert_within(scene, again, BOUNDS | {"angle": 1e-3})
    if end == "glb":
        assert_as_oracle(change_axes(again, "rdf", "luf"), read_glb(path.read_bytes()))
    assert losses(scene, path).dropped == ()


def test_comments_of_several_lines_are_kept_line_by_line(tmp_path: Path) -> None:
    scene = replace(storable_scene(3), comments=("one\ntwo", "three"))
    save(scene, tmp_path / "a.glb")
    assert load(tmp_path / "a.glb").comments == ("one", "two", "three")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_data_inside_a_glb_is_written_and_read(tmp_path: Path, degree: int) -> None:
    path, scene = tmp_path / "a.spz.glb", storable_scene(30, degree=degree)
    save(scene, path)
    save(scene, tmp_path / "a.spz", axes="luf", spz_version=3)
    again = load(path)
    assert same_bits(again, load(tmp_path / "a.spz", axes="luf"))
    assert again.comments == scene.comments
    document, binary = parts(path.read_bytes())
    extension = primitive(document)["extensions"][NAME]["extensions"]
    assert extension == {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    length = document["bufferViews"][0]["byteLength"]
    splats = read_spz(binary[:length])
    assert_as_oracle(change_axes(again, "rdf", "luf"), splats)
    assert not any("bufferView" in accessor for accessor in document["accessors"])
    assert path.stat().st_size < 2500 + 70 * len(scene)


def test_axes_are_followed_in_both_directions(tmp_path: Path) -> None:
    scene = storable_scene(9, degree=2)
    save(scene, tmp_path / "a.glb", axes="rdf")
    assert torch.equal(load(tmp_path / "a.glb", axes="rdf").means, scene.means)
    assert torch.equal(load(tmp_path / "a.glb").means, scene.means * torch.tensor([-1, -1, 1]))


def test_the_transforms_of_nodes_move_gaussians(small: Path) -> None:
    quat, shift, scale = (0.5, 0.1, -0.7, 0.5), (1.0, 2.0, -3.0), 2.5
    wanted = moved(load(small, axes="rdf"), quat=quat, shift=shift, scale=scale)
    length = math.hypot(*quat)
    w, x, y, z = (part / length for part in quat)

    def put(document: dict[str, Any]) -> None:
        above = {"translation": shift, "children": [1]}
        turned = {"rotation": [x, y, z, w], "scale": [scale] * 3, "mesh": 0}
        document["nodes"] = [above, turned]

    found = load(changed(small, put), axes="rdf")
    assert_within(wanted, found, {"means": 3e-6, "log_scales": 1e-6, "shN": 1e-6, "angle": 1e-3})


@pytest.mark.parametrize("factor", [0.9998, 2.0, 1e200])
def test_rotations_of_nodes_need_not_have_unit_length(small: Path, factor: float) -> None:
    half = math.sqrt(0.5)
    quat = [0.0, half, 0.0, half]
    changed(small, lambda d: d["nodes"][0].update(rotation=quat))
    wanted = load(small)
    changed(small, lambda d: d["nodes"][0].update(rotation=[factor * part for part in quat]))
    found = load(small)
    assert torch.equal(found.log_scales, wanted.log_scales)
    torch.testing.assert_close(found.means, wanted.means)


def test_coefficients_above_degree_3_are_warned_about(small: Path) -> None:
    save(storable_scene(5, degree=3), small, overwrite=True)

    def extend(document: dict[str, Any]) -> None:
        attributes = primitive(document)["attributes"]
        attributes[f"{NAME}:SH_DEGREE_4_COEF_0"] = attributes[f"{NAME}:SH_DEGREE_3_COEF_0"]

    changed(small, extend)
    with pytest.warns(DroppedDataWarning, match="left out SH coefficients above degree 3"):
        assert load(small).sh_degree == 3


def test_all_nodes_and_primitives_are_read(small: Path) -> None:
    def repeat(document: dict[str, Any]) -> None:
        points = {"mode": 0, "attributes": {"POSITION": 0}}
        document["meshes"].append({"primitives": [points, primitive(document)]})
        document["nodes"] = [{"mesh": 1, "matrix": [*(1, 0, 0, 0), *(0, 1, 0, 0)] + [0] * 8}]
        document["nodes"][0]["matrix"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]
        document["nodes"].append({"mesh": 0})
        document["scenes"] = [{"nodes": [0, 1]}]

    first = load(small)
    with pytest.warns(DroppedDataWarning, match="left out 1 mesh primitive without Gauss"):
        scene = load(changed(small, repeat))
    assert len(scene) == 10
    torch.testing.assert_close(scene.means[:5], first.means - torch.tensor([5.0, 0, 0]))
    assert torch.equal(scene.means[5:], first.means)


def test_normalized_integers_are_read(small: Path) -> None:
    """Rotations as signed bytes, opacities as shorts, with a stride."""

    def pack(document: dict[str, Any]) -> None:
        rows = b"".join(struct.pack("<4bH2x", 0, 127, 0, 0, 13107 * row) for row in range(5))
        uri = "data:application/octet-stream;base64," + base64.b64encode(rows).decode()
        document["buffers"].append({"byteLength": len(rows), "uri": uri})
        view = {"buffer": 1, "byteLength": len(rows), "byteStride": 8}
        document["bufferViews"].append(view)
        common = {"bufferView": len(document["bufferViews"]) - 1, "count": 5, "normalized": True}
        attributes = primitive(document)["attributes"]
        attributes[f"{NAME}:ROTATION"] = len(document["accessors"])
        document["accessors"].append(common | {"componentType": 5120, "type": "VEC4"})
        attributes[f"{NAME}:OPACITY"] = len(document["accessors"])
        short = common | {"componentType": 5123, "type": "SCALAR", "byteOffset": 4}
        document["accessors"].append(short)

    scene = load(changed(small, pack), axes="rdf")
    assert scene.quats.tolist() == [[0, 0, 1, 0]] * 5
    wanted = torch.tensor([1e-6, 0.2, 0.4, 0.6, 0.8])
    torch.testing.assert_close(scene.opacities, wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("normalized", [False, True])
def test_quantized_positions_are_placed_by_their_node(small: Path, normalized: bool) -> None:
    """Positions are shorts, as KHR_mesh_quantization allows; sizes are unsigned bytes."""
    added = b"".join(struct.pack("<3hxx3Bx", row, -2 * row, 300, 1, 2, 4) for row in range(5))

    def quantize(document: dict[str, Any]) -> None:
        document["extensionsUsed"].append("KHR_mesh_quantization")
        uri = "data:application/octet-stream;base64," + base64.b64encode(added).decode()
        document["buffers"].append({"byteLength": len(added), "uri": uri})
        view = {"buffer": 1, "byteLength": len(added), "byteStride": 12}
        document["bufferViews"].append(view)
        number = len(document["bufferViews"]) - 1
        common = {"bufferView": number, "count": 5, "type": "VEC3"}
        accessor(document, "POSITION").clear()
        accessor(document, "POSITION").update(common, componentType=5122, normalized=normalized)
        sizes = accessor(document, f"{NAME}:SCALE")
        sizes.clear()
        sizes.update(common, componentType=5121, byteOffset=8)
        document["nodes"][0]["scale"] = [2.0, 2.0, 2.0]

    scene = load(changed(small, quantize), axes="rdf")
    unit = 2 / 32767 if normalized else 2
    wanted = [[unit * row, -2.0 * unit * row, 300.0 * unit] for row in range(5)]
    torch.testing.assert_close(scene.means, torch.tensor(wanted))
    torch.testing.assert_close(scene.scales, torch.tensor([[2.0, 4.0, 8.0]] * 5))


def test_buffers_are_read_from_the_folder_of_the_file_only(small: Path, tmp_path: Path) -> None:
    document, binary = parts(small.read_bytes())
    (tmp_path / "in").mkdir()
    path = tmp_path / "a.gltf"
    for name in ("some data.bin", "\u6587" * 40 + ".bin"):  # nine characters each in a URI
        (tmp_path / "in" / name).write_bytes(binary)
        document["buffers"][0]["uri"] = quote(f"in/{name}")
        path.write_text(json.dumps(document))
        assert same_bits(load(path), load(small))
    outside = ("../x.bin", "/etc/passwd", "http://x.org/a.bin", "a\\b.bin", "..%2Fx.bin", "")
    for uri in (*outside, "C%3A/x.bin"):  # on Windows, a file on another drive
        document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
        assert refusal(path) == (f"{path}: buffers[0] must be in the file's folder, found {uri!r}.")
    document["buffers"][0]["uri"] = "dat;base64," + "A" * 1000
    path.write_text(json.dumps(document))
    assert len(str(refusal(path))) < 120 + len(str(path))
    for text in ("A", "\u00e9", "===="):
        document["buffers"][0]["uri"] = f"data:;base64,{text}"
        path.write_text(json.dumps(document))
        assert "buffers[0] must " in str(refusal(path))


def test_a_linear_colour_space_is_warned_about(small: Path) -> None:
    def linear(document: dict[str, Any]) -> None:
        primitive(document)["extensions"][NAME]["colorSpace"] = "lin_rec709_display"

    with pytest.warns(DroppedDataWarning, match="colour space 'lin_rec709_display' as") as said:
        load(changed(small, linear))
    assert said[0].filename == __file__


def test_colors_of_points_are_normalized_bytes() -> None:
    file = io.BytesIO()
    write_glb(storable_scene(3), file)
    content = file.getvalue()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    place = document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    color = document["accessors"][place]
    assert (color["componentType"], color["type"], color["normalized"]) == (5121, "VEC4", True)
