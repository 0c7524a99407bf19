"""Seeds of the fuzzer: small files of every kind that cvtgs reads, with their readers."""

import io
import json
import struct
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

import cvtgs
from camera_files import colmap_bin, colmap_txt, inria, transforms
from cvtgs import SimplifyConfig
from cvtgs.boxes import read_boxes
from cvtgs.io.sog import encode_sog
from cvtgs.mergenet import Architecture, CheckpointInfo, encode_checkpoint, load_checkpoint
from cvtgs.train import TrainConfig
from mergenet_cases import lively_net
from ply_files import gaussian_properties, gaussian_rows, ply_bytes
from scenes import random_scene

HERE = Path(__file__).parent

Files = dict[str, bytes]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of file.

    Attributes:
        name: The name of a file, or its suffix.
        seeds: Makes undamaged files.
        read: Reads a file.
        beside: Makes the other files of its folder, by name.
    """

    name: str
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    beside: Callable[[], Files] = field(default=dict)


def seeds_of_ply() -> list[bytes]:
    """Return small files of every layout: both byte orders, ASCII, lists, faces, 2DGS."""
    plain = gaussian_properties()
    flat = [(name, kind) for name, kind in gaussian_properties(9) if name != "scale_2"]
    lists = [*plain, ("seen_by", "list uchar uint")]
    listed = [[*row, [1.0, 2.0, 3.0]] for row in gaussian_rows(plain, 4)]
    faces = {"face": ([("corners", "list uint int")], [[[0, 1, 2]], [[2, 1, 0]]])}
    label = [*gaussian_properties(kind="double"), ("label", "ushort")]
    seeds = []
    for encoding in ("binary_little_endian", "binary_big_endian", "ascii"):
        seeds += [
            ply_bytes(plain, gaussian_rows(plain, 5), encoding=encoding, comments=["by hand"]),
            ply_bytes(flat, gaussian_rows(flat, 3), encoding=encoding),
            ply_bytes(lists, listed, encoding=encoding),
            ply_bytes(plain, gaussian_rows(plain, 2), encoding=encoding, before=faces),
            ply_bytes(label, gaussian_rows(label, 2), encoding=encoding, newline="\r\n"),
        ]
    return seeds


def seeds_of_checkpoints() -> list[bytes]:
    """Return one small checkpoint."""
    shape = Architecture(width=2, cell_width=3)
    info = CheckpointInfo(architecture=shape, preset="paper")
    return [encode_checkpoint(lively_net(torch.float32, architecture=shape), info)]


def seeds_of_configs() -> list[bytes]:
    """Return both presets in full, and a short file."""
    full = [SimplifyConfig.from_preset(name).to_toml().encode() for name in ("standard", "paper")]
    return [*full, b'preset = "paper"\nseed = 3\n[cvt]\niterations = 7\n']


def seeds_of_scenes(suffix: str) -> Callable[[], list[bytes]]:
    """Return a function that makes small files of a compact format, of SH degree 0 and 1."""

    def seeds() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # .splat has no degree 1
            path = Path(folder) / f"a{suffix}"
            for degree in (0, 1):
                cvtgs.save(random_scene(9, degree=degree), path, overwrite=True)
                found.append(path.read_bytes())
        return found

    data, found = HERE / "data" / "formats", list[bytes]()
    found += [path.read_bytes() for path in sorted(data.glob(f"*[!d]{suffix}"))]
    return seeds


def seeds_of_states() -> list[bytes]:
    """Return checkpoints as of gsplat and Splatfacto, with a learning rate of numpy."""
    tensors = cvtgs.to_dict(random_scene(3, degree=1))
    older = {f"_model.{name}": values for name, values in tensors.items()}
    seeds = []
    for content in (
        {"step": 1, "splats": tensors},
        {"step": 1, "pipeline": older, "optimizers": [{"lr": np.float64(0.1)}]},
    ):
        file = io.BytesIO()
        torch.save(content, file)
        seeds.append(file.getvalue())
    return seeds


def seeds_of_cameras() -> list[bytes]:
    """Return small camera files: of nerfstudio and instant-ngp, and of INRIA's code."""
    return [json.dumps(found).encode() for found in (transforms(range(3)), inria()[:3])]


def seeds_of_ksplat() -> list[bytes]:
    """Return files of two Gaussians in one section, of each compression level."""
    seeds = []
    for level, degree in ((0, 0), (1, 1), (2, 2)):
        sizes = ((12, 28, 4), (6, 14, 2), (6, 14, 1))[level]
        row = sizes[0] + sizes[1] + 4 + (0, 9, 24)[degree] * sizes[2]
        head = struct.pack("<BBxxIIIIHxx3fff", 0, 1, 1, 1, 2, 2, level, 0, 0, 0, -1.5, 1.5)
        section = struct.pack("<IIIIfHxxIIIIH", 2, 3, 2, 1, 20.0, 12, 32767, 0, 1, 0, degree)
        data = bytes(12) + bytes(number % 97 for number in range(3 * row))
        seeds.append(head.ljust(4096, b"\0") + section.ljust(1024, b"\0") + data)
    return seeds


def sog_files() -> Files:
    """Return the files of a SOG in a folder."""
    return dict(encode_sog(random_scene(9, degree=1)).files())


def stream_files() -> Files:
    """Return the files of a SOG, and those of another for the environment."""
    files = sog_files()
    return files | {f"env/{name}": content for name, content in files.items()}


def seeds_of_streams() -> list[bytes]:
    """Return streams of two chunks of one SOG, in two levels, one with an environment."""
    near = {"0": {"file": 0, "offset": 0, "count": 3}, "1": {"file": 0, "offset": 3, "count": 2}}
    far = {"0": {"file": 0, "offset": 5, "count": 4}}
    bound = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    tree = {
        "bound": bound,
        "children": [{"bound": bound, "lods": near}, {"bound": bound, "lods": far}],
    }
    document = {"version": 1, "lodLevels": 2, "counts": [7, 6], "filenames": ["meta.json"]}
    whole = document | {"environment": "env/meta.json", "tree": tree}
    return [json.dumps(found).encode() for found in (document | {"tree": tree}, whole)]


def seeds_of_boxes() -> list[bytes]:
    """Return a box, and a list of two."""
    boxes = [{"min": [0, -1.5, 2], "max": [1, 1e3, 2]}, {"min": [0, 0, 0], "max": [1, 2, 3]}]
    return [json.dumps(found).encode() for found in (boxes[0], boxes)]


def seeds_of_trainings() -> list[bytes]:
    """Return the recipes, which have most settings."""
    return [path.read_bytes() for path in sorted((HERE.parent / "recipes").glob("*.toml"))]


def colmap_files(write: Callable[[Path], object]) -> Files:
    """Return the files of a COLMAP model."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        return {path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def colmap(name: str, write: Callable[[Path], object]) -> Kind:
    """Return the kind of one file of a COLMAP model; the other files are undamaged."""

    def beside() -> Files:
        return {other: data for other, data in colmap_files(write).items() if other != name}

    return Kind(
        name=name,
        seeds=lambda: [colmap_files(write)[name]],
        read=cvtgs.load_cameras,
        beside=beside,
    )


READERS: dict[str, Kind] = {
    "ply": Kind(name=".ply", seeds=seeds_of_ply, read=cvtgs.load),
    "compressed": Kind(
        name=".compressed.ply", seeds=seeds_of_scenes(".compressed.ply"), read=cvtgs.load
    ),
    "spz": Kind(name=".spz", seeds=seeds_of_scenes(".spz"), read=cvtgs.load),
    "splat": Kind(name=".splat", seeds=seeds_of_scenes(".splat"), read=cvtgs.load),
    "sog": Kind(name=".sog", seeds=seeds_of_scenes(".sog"), read=cvtgs.load),
    "glb": Kind(name=".glb", seeds=seeds_of_scenes(".glb"), read=cvtgs.load),
    "spz.glb": Kind(name=".spz.glb", seeds=seeds_of_scenes(".spz.glb"), read=cvtgs.load),
    "gltf": Kind(name=".gltf", seeds=seeds_of_scenes(".gltf"), read=cvtgs.load),
    "state": Kind(name=".pt", seeds=seeds_of_states, read=cvtgs.load),
    "checkpoint": Kind(name=".safetensors", seeds=seeds_of_checkpoints, read=load_checkpoint),
    "transforms": Kind(name=".json", seeds=lambda: seeds_of_cameras()[:1], read=cvtgs.load_cameras),
    "inria": Kind(name=".json", seeds=lambda: seeds_of_cameras()[1:], read=cvtgs.load_cameras),
    "config": Kind(name=".toml", seeds=seeds_of_configs, read=SimplifyConfig.from_toml),
    "boxes": Kind(name=".json", seeds=seeds_of_boxes, read=read_boxes),
    "training": Kind(name=".toml", seeds=seeds_of_trainings, read=TrainConfig.from_toml),
    "ksplat": Kind(name=".ksplat", seeds=seeds_of_ksplat, read=cvtgs.load),
    "meta": Kind(
        name="meta.json",
        seeds=lambda: [sog_files()["meta.json"]],
        read=cvtgs.load,
        beside=sog_files,
    ),
    "stream": Kind(
        name="lod-meta.json", seeds=seeds_of_streams, read=cvtgs.load, beside=stream_files
    ),
    "colmap.cameras": colmap("cameras.bin", colmap_bin),
    "colmap.images": colmap("images.bin", colmap_bin),
    "colmap.txt": colmap("images.txt", colmap_txt),
}


def place(kind: str, folder: Path) -> Path:
    """Write the other files of a kind to a folder; return the path for its own file."""
    home = folder / kind
    home.mkdir(exist_ok=True)
    path = home / (
        f"damaged{READERS[kind].name}" if READERS[kind].name[0] == "." else READERS[kind].name
    )
    for other, data in READERS[kind].beside().items():
        (home / other).parent.mkdir(exist_ok=True)
        (home / other).write_bytes(data)
    return path
