"""glTF with ``KHR_gaussian_splatting``."""

import base64
import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs import GaussianScene, load, save
from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidSceneError
from cvtgs.io import change_axes, losses
from cvtgs.math.parameters import build_covariances, normalize_quats
from format_cases import DATA, assert_as_oracle, assert_within, refusal, storable_scene
from format_oracles import read_glb, read_spz
from scenes import moved, same_bits

NAME = "KHR_gaussian_splatting"
BOUNDS = {"means": 0.0, "log_scales": 1e-6, "opacities": 2e-7, "sh0": 0.0, "shN": 0.0}
Change = Callable[[dict[str, Any]], None]


def parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Split a ``.glb`` into its document and its binary chunk."""
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def joined(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(binary), 0x004E4942) + binary


def changed(path: Path, change: Change) -> Path:
    """Change the document of a ``.glb``."""
    document, binary = parts(path.read_bytes())
    change(document)
    path.write_bytes(joined(document, binary))
    return path


def primitive(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]


def covariances(scene: GaussianScene) -> torch.Tensor:
    return build_covariances(scene.scales, normalize_quats(scene.quats))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "a.glb"
    save(storable_scene(5, degree=1), path)
    return path


def test_written_numbers_by_hand(tmp_path: Path) -> None:
    """At (1, 2, 3) of a PLY, half a turn about x: glTF has y up and x left."""
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


def test_file_of_splat_transform() -> None:
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_inside(tmp_path: Path, degree: int) -> None:
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


def test_axes_can_be_given(tmp_path: Path) -> None:
    scene = storable_scene(9, degree=2)
    save(scene, tmp_path / "a.glb", axes="rdf")
    assert torch.equal(load(tmp_path / "a.glb", axes="rdf").means, scene.means)
    assert torch.equal(load(tmp_path / "a.glb").means, scene.means * torch.tensor([-1, -1, 1]))


def test_nodes_move_gaussians(small: Path) -> None:
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


def test_all_nodes_and_primitives_are_read(small: Path) -> None:
    def repeat(document: dict[str, Any]) -> None:
        points = {"mode": 0, "attributes": {"POSITION": 0}}
        document["meshes"].append({"primitives": [points, primitive(document)]})
        document["nodes"] = [{"mesh": 1, "matrix": [*(1, 0, 0, 0), *(0, 1, 0, 0)] + [0] * 8}]
        document["nodes"][0]["matrix"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]
        document["nodes"].append({"mesh": 0})
        document["scenes"] = [{"nodes": [0, 1]}]

    first = load(small)
    with pytest.warns(DroppedDataWarning, match="left out 1 mesh primitive that is not of Gauss"):
        scene = load(changed(small, repeat))
    assert len(scene) == 10
    torch.testing.assert_close(scene.means[:5], first.means - torch.tensor([5.0, 0, 0]))
    assert torch.equal(scene.means[5:], first.means)


def test_integers_are_normalised(small: Path) -> None:
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


def test_buffers_beside_the_file(small: Path, tmp_path: Path) -> None:
    document, binary = parts(small.read_bytes())
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "some data.bin").write_bytes(binary)
    document["buffers"][0]["uri"] = "in/some%20data.bin"
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(document))
    assert same_bits(load(path), load(small))
    for uri in ("../x.bin", "/etc/passwd", "http://x.org/a.bin", "a\\b.bin", "..%2Fx.bin", ""):
        document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
        assert refusal(path) == (
            f"{path}: buffers[0] must be in the folder of the file, found {uri!r}."
        )
    document["buffers"][0]["uri"] = "dat;base64," + "A" * 1000
    path.write_text(json.dumps(document))
    assert len(str(refusal(path))) < 200
    for text in ("A", "\u00e9", "===="):
        document["buffers"][0]["uri"] = f"data:;base64,{text}"
        path.write_text(json.dumps(document))
        assert "buffers[0] must " in str(refusal(path))


def accessor(document: dict[str, Any], name: str) -> dict[str, Any]:
    return document["accessors"][primitive(document)["attributes"][name]]


def without(document: dict[str, Any], name: str) -> None:
    del primitive(document)["attributes"][f"{NAME}:{name}"]


DAMAGE: dict[str, tuple[Change, str]] = {
    "elements": (
        lambda d: accessor(d, "POSITION").update(count=6),
        "accessors[0] (POSITION) must have one element at least and end in its buffer view of 60 "
        "bytes, found 6 elements that end at byte 72.",
    ),
    "no elements": (
        lambda d: accessor(d, "POSITION").update(count=0),
        "accessors[0] (POSITION) must have one element at least and end in its buffer view of 60 "
        "bytes, found 0 elements that end at byte 0.",
    ),
    "fewer elements": (
        lambda d: accessor(d, f"{NAME}:SCALE").update(count=4),
        f"all attributes must have the 5 elements of POSITION, found 4 in {NAME}:SCALE.",
    ),
    "view": (
        lambda d: d["bufferViews"][0].update(byteLength=10**9),
        "bufferViews[0] must end in buffer 0 of 480 bytes, found byte 1,000,000,000.",
    ),
    "buffer": (
        lambda d: d["buffers"][0].update(byteLength=10**9),
        "buffers[0] must have 1,000,000,000 bytes, found 480.",
    ),
    "type": (
        lambda d: accessor(d, "POSITION").update(type="VEC4"),
        "accessors[0] (POSITION) must be VEC3 of bytes, shorts or floats, found 'VEC4' of "
        "component type 5126.",
    ),
    "component": (
        lambda d: accessor(d, f"{NAME}:OPACITY").update(componentType=5125),
        f"accessors[4] ({NAME}:OPACITY) must be SCALAR of bytes, shorts or floats, found 'SCALAR' "
        f"of component type 5125.",
    ),
    "count": (
        lambda d: accessor(d, "POSITION").update(count="five"),
        "accessors[0]: 'count' must be a whole number of at least 0, found 'five'.",
    ),
    "sparse": (
        lambda d: accessor(d, "POSITION").update(sparse={}),
        "accessors[0] (POSITION) must lie in a buffer view, found a sparse one.",
    ),
    "reference": (
        lambda d: primitive(d)["attributes"].update(POSITION=99),
        "accessors has 9 entries, found a reference to 99.",
    ),
    "opacity": (
        lambda d: without(d, "OPACITY"),
        f"Gaussians must have an accessor for {NAME}:OPACITY, found none.",
    ),
    "coefficient": (
        lambda d: without(d, "SH_DEGREE_1_COEF_2"),
        f"Gaussians must have all SH coefficients up to degree 1, found no "
        f"{NAME}:SH_DEGREE_1_COEF_2.",
    ),
    "kernel": (
        lambda d: primitive(d)["extensions"][NAME].update(kernel="ellipse2d"),
        "Gaussians must be points (mode 0) of the kernel 'ellipse', found mode 0 and 'ellipse2d'.",
    ),
    "mesh": (
        lambda d: primitive(d).update(extensions={}),
        f"must have a mesh primitive with {NAME}, found none.",
    ),
    "required": (
        lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]),
        f"must require no other extensions than {NAME}, {NAME}_compression_spz_2, "
        f"KHR_mesh_quantization, found 'EXT_meshopt_compression'.",
    ),
    "circle": (
        lambda d: d.update(nodes=[{"children": [0]}]),
        "each node must hang in one place, found 0 again.",
    ),
    "skewed": (
        lambda d: d.update(nodes=[{"mesh": 0, "scale": [1, 2, 1]}]),
        "nodes must turn, shift and evenly scale Gaussians, found one that stretches, skews or "
        "mirrors them.",
    ),
    "stride": (
        lambda d: d["bufferViews"][0].update(byteStride=4),
        "bufferViews[0] must have a stride of 12 to 252 bytes, found 4.",
    ),
}


@pytest.mark.filterwarnings("ignore:left out 1 mesh", "ignore:.*left out 1 mesh")
@pytest.mark.parametrize("name", DAMAGE)
def test_damage(small: Path, name: str) -> None:
    change, said = DAMAGE[name]
    assert refusal(changed(small, change)) == f"{small}: {said}"


def test_damaged_containers(small: Path) -> None:
    content = small.read_bytes()
    small.write_bytes(content[:-9])
    assert refusal(small) == (
        f"{small}: must be version 2 of glTF and have the {len(content):,} bytes that its header "
        f"promises, found version 2 and {len(content) - 9:,} bytes."
    )
    small.write_bytes(content[:16] + bytes(4) + content[20:])
    assert refusal(small) == f"{small}: a .glb must have a chunk of JSON, found none."
    small.write_bytes(content[:12] + b"\xff\xff\xff\x00" + content[16:])
    assert "a chunk must end in the" in str(refusal(small))
    small.write_bytes(b"ply" + content)
    assert refusal(small) == f"{small}: a .glb must start with b'glTF', found b'plyg'."
    small.write_bytes(content[:8])
    assert "must start with 12 bytes of header, found 8." in str(refusal(small))
    spz = joined({"meshes": [{"primitives": []}]}, b"")
    small.write_bytes(spz)
    assert refusal(small) == f"{small}: must have a mesh primitive with {NAME}, found none."


def test_negative_scales(small: Path) -> None:
    document, binary = parts(small.read_bytes())
    start = document["bufferViews"][accessor(document, f"{NAME}:SCALE")["bufferView"]]["byteOffset"]
    value = struct.pack("<f", -0.5)
    small.write_bytes(joined(document, binary[: start + 12] + value + binary[start + 16 :]))
    assert refusal(small) == (
        f"{small}: {NAME}:SCALE must not be negative, found -0.5 in element 1."
    )


def test_nodes_that_repeat_a_mesh(tmp_path: Path) -> None:
    def repeat(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0}] * 1500
        document["scenes"] = [{"nodes": list(range(1500))}]

    path = tmp_path / "a.glb"
    save(storable_scene(3000, degree=0), path)
    size = changed(path, repeat).stat().st_size
    with pytest.raises(FileFormatError, match=f"in a file of {size:,}; if you trust the file"):
        load(path)


def test_linear_colours_are_warned_about(small: Path) -> None:
    def linear(document: dict[str, Any]) -> None:
        primitive(document)["extensions"][NAME]["colorSpace"] = "lin_rec709_display"

    with pytest.warns(DroppedDataWarning, match="space 'lin_rec709_display' for those of") as said:
        load(changed(small, linear))
    assert said[0].filename == __file__


def test_spz_inside_may_not_lie(tmp_path: Path) -> None:
    path = tmp_path / "a.spz.glb"
    save(storable_scene(9), path)
    document, binary = parts(path.read_bytes())
    path.write_bytes(joined(document, bytes(4) + binary[4:]))
    assert refusal(path) == (
        f"{path}: bufferViews[0]: an .spz file must start with gzip's or its own magic number, "
        f"found b'\\x00\\x00\\x00\\x00'."
    )


def test_more_than_a_glb_can_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cvtgs.io.gltf.write._MOST_BYTES", 1000)
    with pytest.raises(InvalidSceneError, match="must have less than 4 GiB, found a scene that"):
        save(storable_scene(9), tmp_path / "a.glb")
    assert list(tmp_path.iterdir()) == []
