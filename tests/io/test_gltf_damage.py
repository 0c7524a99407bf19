"""Error messages about damaged or inconsistent glTF files."""

import struct
from pathlib import Path
from typing import Any

import pytest

from cvtgs import load, save
from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidSceneError
from cvtgs.io.files import validated
from format_cases import refusal, storable_scene
from gltf_cases import NAME, Change, accessor, changed, joined, parts, primitive, without


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "a.glb"
    save(storable_scene(5, degree=1), path)
    return path


DAMAGE: dict[str, tuple[Change, str]] = {
    "elements": (
        lambda d: accessor(d, "POSITION").update(count=6),
        "accessors[0] (POSITION) must have at least one element and end within 60 bytes, found 6 "
        "elements that end at byte 72.",
    ),
    "no elements": (
        lambda d: accessor(d, "POSITION").update(count=0),
        "accessors[0] (POSITION) must have at least one element and end within 60 bytes, found 0 "
        "elements that end at byte 0.",
    ),
    "fewer elements": (
        lambda d: accessor(d, f"{NAME}:SCALE").update(count=4),
        f"{NAME}:SCALE must have 5 elements like POSITION, found 4.",
    ),
    "view": (
        lambda d: d["bufferViews"][0].update(byteLength=10**9),
        "bufferViews[0] must end within 480 bytes, found byte 1,000,000,000.",
    ),
    "buffer": (
        lambda d: d["buffers"][0].update(byteLength=10**9),
        "buffers[0] must have 1,000,000,000 bytes, found 480.",
    ),
    "type": (
        lambda d: accessor(d, "POSITION").update(type="VEC4"),
        "accessors[0] (POSITION) must be VEC3 of floats, or of bytes or shorts with "
        "KHR_mesh_quantization, found 'VEC4' of component type 5126.",
    ),
    "component": (
        lambda d: accessor(d, f"{NAME}:OPACITY").update(componentType=5125),
        f"accessors[4] ({NAME}:OPACITY) must be SCALAR of floats, or of normalized unsigned "
        f"bytes or shorts, found 'SCALAR' of component type 5125.",
    ),
    "bytes of opacities": (
        lambda d: accessor(d, f"{NAME}:OPACITY").update(componentType=5121),
        f"accessors[4] ({NAME}:OPACITY) must be SCALAR of floats, or of normalized unsigned "
        f"bytes or shorts, found 'SCALAR' of component type 5121, not normalized.",
    ),
    "unsigned rotations": (
        lambda d: accessor(d, f"{NAME}:ROTATION").update(componentType=5123, normalized=True),
        f"accessors[2] ({NAME}:ROTATION) must be VEC4 of floats, or of normalized signed bytes "
        f"or shorts, found 'VEC4' of component type 5123, normalized.",
    ),
    "shorts of SH": (
        lambda d: accessor(d, f"{NAME}:SH_DEGREE_0_COEF_0").update(componentType=5122),
        f"accessors[5] ({NAME}:SH_DEGREE_0_COEF_0) must be VEC3 of floats, found 'VEC3' of "
        f"component type 5122, not normalized.",
    ),
    "shorts without the extension": (
        lambda d: accessor(d, "POSITION").update(componentType=5122),
        "accessors[0] (POSITION) must be VEC3 of floats, or of bytes or shorts with "
        "KHR_mesh_quantization, found 'VEC3' of component type 5122, not normalized.",
    ),
    "count": (
        lambda d: accessor(d, "POSITION").update(count="five"),
        "accessors[0]: 'count' must be a whole number of at least 0, found 'five'.",
    ),
    "sparse": (
        lambda d: accessor(d, "POSITION").update(sparse={}),
        "accessors[0] (POSITION) must be in a buffer view, found a sparse one.",
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
        f"Gaussians must have all SH up to degree 1, found no {NAME}:SH_DEGREE_1_COEF_2.",
    ),
    "kernel": (
        lambda d: primitive(d)["extensions"][NAME].update(kernel="ellipse2d"),
        "Gaussians must be points (mode 0) with the kernel 'ellipse', found mode 0 "
        "and 'ellipse2d'.",
    ),
    "mesh": (
        lambda d: primitive(d).update(extensions={}),
        f"must have a mesh primitive with {NAME}, found none.",
    ),
    "required": (
        lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]),
        f"must require only {NAME}, {NAME}_compression_spz_2, "
        f"KHR_mesh_quantization, found 'EXT_meshopt_compression'.",
    ),
    "circle": (
        lambda d: d.update(nodes=[{"children": [0]}]),
        "each node must occur once in the hierarchy, found 0 again.",
    ),
    "node by name": (
        lambda d: d.update(nodes=[{"children": ["base"]}]),
        "nodes[0]: 'children' must be a list of whole numbers of at least 0, found ['base'].",
    ),
    "skewed": (
        lambda d: d.update(nodes=[{"mesh": 0, "scale": [1, 2, 1]}]),
        "nodes must only rotate, move and uniformly scale Gaussians, found one that stretches, "
        "skews or mirrors them.",
    ),
    "stride": (
        lambda d: d["bufferViews"][0].update(byteStride=4),
        "accessors[0] (POSITION) must have a stride of 12 to 252 bytes, found 4.",
    ),
    "bracket": (
        lambda d: d["buffers"][0].update(uri="//[x"),
        "buffers[0] must be in the file's folder, found '//[x'.",
    ),
}


@pytest.mark.filterwarnings("ignore:left out 1 mesh", "ignore:.*left out 1 mesh")
@pytest.mark.parametrize("name", DAMAGE)
def test_each_damage_has_its_own_message(small: Path, name: str) -> None:
    change, said = DAMAGE[name]
    assert refusal(changed(small, change)) == f"{small}: {said}"


def test_damaged_containers_are_refused(small: Path) -> None:
    content = small.read_bytes()
    small.write_bytes(content[:-9])
    assert refusal(small) == (
        f"{small}: must be glTF version 2 with the {len(content):,} bytes that its header "
        f"promises, found version 2 and {len(content) - 9:,} bytes."
    )
    small.write_bytes(content[:16] + bytes(4) + content[20:])
    assert refusal(small) == f"{small}: a .glb must have a JSON chunk, found none."
    small.write_bytes(content[:12] + b"\xff\xff\xff\x00" + content[16:])
    text = f"chunks must end within {len(content):,} bytes, found one that ends at byte 16,777,235."
    assert str(refusal(small)) == f"{small}: {text}"
    small.write_bytes(b"ply" + content)
    assert refusal(small) == f"{small}: a .glb must start with b'glTF', found b'plyg'."
    small.write_bytes(content[:8])
    assert "must start with a header of 12 bytes, found 8." in str(refusal(small))
    spz = joined({"meshes": [{"primitives": []}]}, b"")
    small.write_bytes(spz)
    assert refusal(small) == f"{small}: must have a mesh primitive with {NAME}, found none."


def test_negative_scales_are_refused(small: Path) -> None:
    document, binary = parts(small.read_bytes())
    start = document["bufferViews"][accessor(document, f"{NAME}:SCALE")["bufferView"]]["byteOffset"]
    value = struct.pack("<f", -0.5)
    small.write_bytes(joined(document, binary[: start + 12] + value + binary[start + 16 :]))
    assert refusal(small) == (
        f"{small}: {NAME}:SCALE must not be negative, found -0.5 in element 1 (a draft of the "
        f"extension, which splat-transform 2.3 wrote, stored logarithms)."
    )


def test_nodes_that_repeat_a_mesh_too_often_are_refused(tmp_path: Path) -> None:
    def repeat(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0}] * 1500
        document["scenes"] = [{"nodes": list(range(1500))}]

    path = tmp_path / "a.glb"
    save(storable_scene(3000, degree=0), path)
    size = changed(path, repeat).stat().st_size
    with pytest.raises(FileFormatError, match=f"in a file of {size:,}; if you trust the file"):
        load(path)


@pytest.mark.parametrize("is_splat", [True, False])
def test_meshes_of_many_primitives_are_not_multiplied_by_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_splat: bool
) -> None:
    def repeat(document: dict[str, Any]) -> None:
        extensions = {NAME: {}} if is_splat else {}
        document["meshes"].append({"primitives": [{"extensions": extensions}] * 500})
        document["nodes"] = [{"mesh": 1}] * 400 + [{"mesh": 0}]
        document["scenes"] = [{"nodes": list(range(401))}]

    def counting(model: Any, value: object, where: str) -> Any:
        nonlocal calls
        calls += 1
        return validated(model, value, where)

    path, calls = tmp_path / "a.glb", 0
    save(storable_scene(3, degree=0), path)
    size = changed(path, repeat).stat().st_size
    monkeypatch.setattr("cvtgs.io.gltf.read.validated", counting)
    if is_splat:
        assert refusal(path) == (
            f"{path}: nodes must show at most {1000 + size // 40:,} mesh primitives in a file of "
            f"{size:,} bytes, found more; if you trust the file, pass trust_sizes=True "
            f"(--trust-sizes)."
        )
        with pytest.raises(FileFormatError, match="Gaussians must be points"):
            load(path, trust_sizes=True)
    else:
        with pytest.warns(DroppedDataWarning, match="left out 500 mesh primitives without"):
            assert len(load(path)) == 3
    assert calls <= 2 * (1 + is_splat) * 501


@pytest.mark.parametrize(
    "change",
    [{"translation": [1e39, 0, 0]}, {"scale": [1e39] * 3}, {"scale": [1e-39] * 3}],
    ids=["far", "large", "small"],
)
def test_nodes_that_move_gaussians_too_far_are_named(small: Path, change: dict[str, Any]) -> None:
    changed(small, lambda d: d["nodes"][0].update(change))
    text = str(refusal(small))
    assert text.startswith(f"{small}: a node moves Gaussians too far: a motion must ")
    assert text.count(".") == text.removesuffix(".").count(".") + 1


def test_damaged_spz_data_inside_a_glb_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.spz.glb"
    save(storable_scene(9), path)
    document, binary = parts(path.read_bytes())
    path.write_bytes(joined(document, bytes(4) + binary[4:]))
    assert refusal(path) == (
        f"{path}: bufferViews[0]: an .spz file must start with a header of 16 bytes that begin "
        f"with b'NGSP', in gzip or not, found 16 that begin with b'\\x00\\x00\\x00\\x00'."
    )


def test_a_scene_that_is_too_large_for_a_glb_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cvtgs.io.gltf.write._MOST_BYTES", 1000)
    with pytest.raises(InvalidSceneError, match="must be below 4 GiB, found"):
        save(storable_scene(9), tmp_path / "a.glb")
    assert list(tmp_path.iterdir()) == []
