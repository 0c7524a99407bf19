"""Small files with huge claimed or unpacked sizes: at most 1 GB of memory, one sentence."""

import gzip
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
import zstandard
from PIL import Image

import cvtgs
from cvtgs.cli.main import build_parser, main
from cvtgs.errors import FileFormatError
from cvtgs.io.files import FREE_BYTES, MOST_EXPANSION
from cvtgs.io.gltf.document import SPLATS, SPZ
from cvtgs.io.gltf.write import write_chunks
from format_cases import DATA, refusal
from gltf_cases import parts
from scenes import random_scene

linux = pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux does")
FULLEST = FREE_BYTES // 56
"""Most Gaussians without view-dependent colour that a file of any size may claim."""

MEASURE = """
import os, sys, torch, cvtgs, cvtgs.io.sog, cvtgs.io.spz, cvtgs.io.dicts
for path in sys.argv[1:]:
    child = os.fork()
    if child == 0:
        try:
            cvtgs.load(path)
        except cvtgs.CvtgsError as error:
            os._exit(1)
        except BaseException as error:
            print(path, repr(error), file=sys.stderr)
            os._exit(2)
        os._exit(0)
    _, status, used = os.wait4(child, 0)
    print(os.waitstatus_to_exitcode(status), used.ru_maxrss * 1024)
"""


def spz_header(count: int, *, version: int = 3, degree: int = 0, streams: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, streams)


def fourth_spz(count: int) -> bytes:
    sizes = [count * size for size in (9, 1, 3, 3, 4)]
    packed = [zstandard.compress(bytes(min(size, 1 << 26))) for size in sizes]
    table = b"".join(struct.pack("<QQ", len(p), s) for p, s in zip(packed, sizes, strict=True))
    head = spz_header(count, version=4, streams=5) + struct.pack("<IIII", 32, 0, 0, 0)[:16]
    return head + table + b"".join(packed)


def sog(path: Path, count: int, *, method: int = zipfile.ZIP_DEFLATED, junk: int = 0) -> None:
    """Write a SOG of equal Gaussians, in images of just enough pixels."""
    height = -(-min(count, 1 << 24) // 4096)
    image = io.BytesIO()
    Image.new("RGBA", (4096, height), (128, 128, 128, 252)).save(image, "webp", lossless=True)
    names = ["means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp"]
    codes = {"codebook": [0.0]}
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": names[:2]},
        "scales": codes | {"files": [names[2]]},
        "quats": {"files": [names[3]]},
        "sh0": codes | {"files": [names[4]]},
    }
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("meta.json", json.dumps(meta) + " " * junk)
        for name in names:
            archive.writestr(name, image.getvalue())


def expanded(rows: int) -> dict[str, torch.Tensor]:
    """Return a scene whose rows all share the same memory."""
    tensors = cvtgs.to_dict(random_scene(1, degree=0))
    return {name: values.expand(rows, *values.shape[1:]) for name, values in tensors.items()}


class Filler:
    def __reduce__(self) -> tuple[Any, ...]:
        return bytearray, (8 << 30,)


def make(folder: Path) -> dict[str, Path]:
    """Write the files, named after the fault of each."""
    paths = {}

    def at(name: str, suffix: str) -> Path:
        paths[name] = folder / f"{name}{suffix}"
        return paths[name]

    at("zeros of spz", ".spz").write_bytes(gzip.compress(bytes(100_000_000)))
    lie = gzip.compress(spz_header(4_000_000) + bytes(4_000_000 * 20), 9)
    at("zeros behind a header of spz", ".spz").write_bytes(lie)
    at("count of spz 4", ".spz").write_bytes(fourth_spz(4_000_000_000))
    sog(at("count of sog", ".sog"), 169_000_000)
    sog(at("bzip2 of sog", ".sog"), 100, method=zipfile.ZIP_BZIP2, junk=1 << 26)
    sog(at("lzma of sog", ".sog"), 100, method=zipfile.ZIP_LZMA, junk=1 << 26)
    sog(at("long meta of sog", ".sog"), 100, junk=1 << 26)
    torch.save({"splats": expanded(10**12)}, at("strides of a checkpoint", ".pt"))
    torch.save({"more": Filler(), "splats": expanded(1)}, at("filler of a checkpoint", ".pt"))
    with zipfile.ZipFile(at("packed checkpoint", ".pt"), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", bytes(1 << 27))
    return paths


def make_full(folder: Path) -> dict[str, Path]:
    """Write the largest scenes that fit into small files."""
    paths = {"spz": folder / "full.spz", "spz 4": folder / "4.spz", "sog": folder / "full.sog"}
    rows = bytes(FULLEST * 20)
    paths["spz"].write_bytes(gzip.compress(spz_header(FULLEST) + rows, 9))
    paths["spz 4"].write_bytes(fourth_spz(FULLEST))
    sog(paths["sog"], FULLEST)
    return paths


@pytest.mark.long
@linux
def test_small_files_take_less_than_a_gigabyte(tmp_path: Path) -> None:
    refused, read = make(tmp_path), make_full(tmp_path)
    paths = [*refused.values(), *read.values()]
    assert max(path.stat().st_size for path in paths) < 1 << 20
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, paths)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert done.stderr == ""
    ends = [[int(word) for word in line.split()] for line in done.stdout.splitlines()]
    wanted = dict.fromkeys(refused, 1) | dict.fromkeys(read, 0)
    assert {name: code for name, (code, _) in zip(wanted, ends, strict=True)} == wanted
    peaks = {name: peak for name, (_, peak) in zip(wanted, ends, strict=True)}
    assert {name: peak for name, peak in peaks.items() if peak >= 10**9} == {}


def test_implausible_sizes_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    sog(path, 3_000_000)
    size = path.stat().st_size
    assert refusal(path) == (
        f"{path}: a scene must take at most 64 MiB plus {MOST_EXPANSION} times the bytes of its "
        f"file, found 3,000,000 Gaussians that take 168,000,000 bytes in a file of {size:,}; if "
        f"you trust the file, pass trust_sizes=True (--trust-sizes)."
    )
    sog(path, 100, method=zipfile.ZIP_BZIP2)
    assert refusal(path) == (
        f"{path}: meta.json must be stored or deflated, found method 12; zip it again."
    )
    path = tmp_path / "a.pt"
    torch.save({"splats": expanded(100)}, path)
    assert refusal(path) == (
        f"{path}: 'means' must store each of its 1,200 bytes, found 12; if you trust the file, "
        f"pass trust_sizes=True (--trust-sizes)."
    )
    torch.save({"more": Filler(), "splats": expanded(1)}, path)
    assert refusal(path) == (
        f"{path}: must be an intact checkpoint of tensors and plain numbers, "
        f"found '__builtin__.bytearray'; save the dictionary of tensors without other objects."
    )


def test_trust_sizes_reads_files_with_implausible_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"splats": expanded(100)}, path)
    assert len(cvtgs.load(path, trust_sizes=True)) == 100
    path, count = tmp_path / "a.spz", 2 * FULLEST
    path.write_bytes(gzip.compress(spz_header(count) + bytes(count * 20), 9))
    with pytest.raises(FileFormatError, match="if you trust the file"):
        cvtgs.load(path)
    assert len(cvtgs.load(path, trust_sizes=True)) == count
    path = tmp_path / "a.splat"  # its size is always the true one
    path.write_bytes(bytes(32))
    assert len(cvtgs.load(path, trust_sizes=True)) == 1


def test_commands_accept_trust_sizes(tmp_path: Path) -> None:
    path, small = tmp_path / "a.pt", tmp_path / "small.ply"
    torch.save({"splats": expanded(100)}, path)
    convert = ["convert", str(path), str(tmp_path / "a.ply"), "--quiet"]
    assert [main(convert), main([*convert, "--trust-sizes"])] == [1, 0]
    assert main(["info", str(path), "--trust-sizes"]) == 0
    words = ["simplify", str(path), str(small), "--count", "3", "--quiet", "--preset", "fast"]
    assert main([*words, "--trust-sizes"]) == 0
    words = ["levels", str(path), "-o", str(tmp_path / "levels"), "--rho", "0.1", "--no-scores"]
    assert main([*words, "--quiet", "--trust-sizes"]) == 0


def test_the_images_of_an_unbundled_sog_count_as_stored_bytes(tmp_path: Path) -> None:
    sog(tmp_path / "a.sog", 3_000_000)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path)
    with pytest.raises(FileFormatError, match="that take 168,000,000 bytes in a file of"):
        cvtgs.load(tmp_path / "meta.json")
    assert len(cvtgs.load(DATA / "splat-transform.sog")) > 0


@pytest.mark.parametrize("attributes", [{}, {"POSITION": 0}])
def test_spz_that_many_nodes_repeat_counts_as_often(
    tmp_path: Path, attributes: dict[str, int]
) -> None:
    """Whether or not an accessor states another number of Gaussians."""
    count, path, file = FULLEST // 8, tmp_path / "a.glb", io.BytesIO()
    spz = gzip.compress(spz_header(count) + bytes(count * 20), 9)
    inside = {SPLATS: {"extensions": {SPZ: {"bufferView": 0}}}}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [*range(40)]}],
        "nodes": [{"mesh": 0}] * 40,
        "meshes": [{"primitives": [{"mode": 0, "attributes": attributes, "extensions": inside}]}],
        "accessors": [{"componentType": 5126, "count": 1, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(spz)}],
    }
    write_chunks(file, document, len(spz), [spz])
    path.write_bytes(file.getvalue())
    size = path.stat().st_size
    assert refusal(path) == (
        f"{path}: a scene must take at most 64 MiB plus {MOST_EXPANSION} times the bytes of its "
        f"file, found {40 * count:,} Gaussians that take {40 * count * 56:,} bytes in a file of "
        f"{size:,}; if you trust the file, pass trust_sizes=True (--trust-sizes)."
    )


def test_a_buffer_beside_a_gltf_counts_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the bytes of the scene, also in its size on the disk; not again under other numbers."""
    monkeypatch.setattr("cvtgs.io.files.FREE_BYTES", 0)
    path, scene = tmp_path / "a.gltf", random_scene(4000, degree=3)
    cvtgs.save(scene, tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    document, binary = parts(content)
    (tmp_path / "a.bin").write_bytes(binary)
    document["buffers"][0]["uri"] = "a.bin"
    path.write_text(json.dumps(document))
    assert len(cvtgs.load(path)) == 4000
    assert cvtgs.io.scene_size(path) == path.stat().st_size + len(binary)
    spz = gzip.compress(spz_header(100_000) + bytes(2_000_000), 9)
    (tmp_path / "a.bin").write_bytes(spz)
    places = range(30)
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"mode": 0, "extensions": {SPLATS: {"extensions": {SPZ: {"bufferView": k}}}}}
                    for k in places
                ]
            }
        ],
        "bufferViews": [{"buffer": k, "byteLength": len(spz)} for k in places],
        "buffers": [
            {"uri": "./a.bin" if k % 2 else "a.bin", "byteLength": len(spz)} for k in places
        ],
    }
    path.write_text(json.dumps(document))
    stored = path.stat().st_size + len(spz)
    assert cvtgs.io.scene_size(path) == stored
    assert f"found 3,000,000 Gaussians that take 168,000,000 bytes in a file of {stored:,};" in str(
        refusal(path)
    )


@pytest.mark.parametrize("uri", ["missing.bin", "../a.bin", 3, None])
def test_the_size_of_a_damaged_gltf_is_that_of_its_file(tmp_path: Path, uri: object) -> None:
    path = tmp_path / "a.gltf"
    for text in (json.dumps({"buffers": [{"uri": uri}]}), "[]", "{", '{"buffers": [1]}'):
        path.write_text(text)
        assert cvtgs.io.scene_size(path) == len(text)


def test_files_of_a_stream_are_read_up_to_the_one_that_is_too_much(tmp_path: Path) -> None:
    count, path = FULLEST // 2, tmp_path / "lod-meta.json"
    for number in range(9):
        sog(tmp_path / f"{number}.sog", count)
    leaves = [{"lods": {"0": {"file": file, "offset": 0, "count": count}}} for file in range(9)]
    files = [f"{number}.sog" for number in range(9)]
    names = {"filenames": files, "lodLevels": 1, "tree": {"children": leaves}}
    path.write_text(json.dumps(names))
    size = sum((tmp_path / name).stat().st_size for name in files)
    assert refusal(path) == (
        f"{path}: a scene must take at most 64 MiB plus {MOST_EXPANSION} times the bytes of its "
        f"file, found {3 * count:,} Gaussians that take {3 * count * 56:,} bytes in a file of "
        f"{size:,}; if you trust the file, pass trust_sizes=True (--trust-sizes)."
    )
    names |= {"filenames": files[:2], "tree": {"children": leaves[:2]}}
    path.write_text(json.dumps(names))
    assert len(cvtgs.load(path)) == 2 * count


@pytest.mark.parametrize("command", ["render", "evaluate", "compare", "tradeoff", "info"])
def test_every_reading_command_has_the_option_trust_sizes(command):
    parser = build_parser()
    words = {
        "render": ["render", "a.sog", "-o", "b"],
        "evaluate": ["evaluate", "a.sog", "b.sog"],
        "compare": ["compare", "a.sog", "b.sog", "-o", "c"],
        "tradeoff": ["tradeoff", "a.sog", "-o", "c"],
        "info": ["info", "a.sog"],
    }[command]
    assert not parser.parse_args(words).trust_sizes
    assert parser.parse_args([*words, "--trust-sizes"]).trust_sizes
