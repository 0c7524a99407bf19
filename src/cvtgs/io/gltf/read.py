"""Read the Gaussians of all nodes of a glTF scene, transformed by their nodes."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field

from cvtgs.edit import Motion, concatenate, move
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, warn
from cvtgs.io.arrays import Arrays, log_scales_of, logits_of, unit_quats
from cvtgs.io.axes import SCENE_AXES, change_axes
from cvtgs.io.files import (
    Document,
    FourNumbers,
    Items,
    Number,
    Size,
    Text,
    Vector,
    Whole,
    check_expansion,
    validated,
)
from cvtgs.io.gltf import document as gltf
from cvtgs.io.gltf.document import GltfFile
from cvtgs.io.spz import decode_spz, peek_spz
from cvtgs.math.parameters import matrices_to_quats, quats_to_matrices
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED
from cvtgs.text import counted, printable, shown

_KNOWN = (gltf.SPLATS, gltf.SPZ, gltf.QUANTIZATION)
# A file may show this many primitives, and one more for so many bytes, fewer than a node takes.
_MOST_PLACED, _NODE_BYTES = 1000, 40
_EVENNESS = 1e-4  # tolerance for the scale of a node to count as uniform, relative to it

Matrix = Float[np.ndarray, "4 4"]


class _Scene(Document):
    nodes: gltf.Indices


class _Node(Document):
    mesh: Size | None = None
    children: gltf.Indices
    matrix: Annotated[list[Number], Field(min_length=16, max_length=16)] | None = Field(
        None, description="16 finite numbers"
    )
    translation: Vector = (0, 0, 0)
    rotation: FourNumbers = (0, 0, 0, 1)
    scale: Vector = (1, 1, 1)


class _Mesh(Document):
    primitives: Items


class _Primitive(Document):
    attributes: Annotated[
        dict[str, Size],
        Field(default_factory=dict, description="a JSON object with numbers of accessors"),
    ]
    extensions: gltf.Entry
    mode: Whole = 4
    extras: Any = None


class _Splatting(Document):
    kernel: Text = gltf.KERNEL
    colorSpace: Text = gltf.COLOR_SPACE  # noqa: N815 (the name of glTF)
    extensions: gltf.Entry


class _Compression(Document):
    bufferView: Size  # noqa: N815


class _Splats(NamedTuple):
    """A primitive of splats with its extension."""

    primitive: _Primitive
    splatting: _Splatting
    where: str  # its place in errors


def read_gltf(path: Path, *, axes: str | None = None, trust_sizes: bool = False) -> GaussianScene:
    """Read the Gaussians of a ``.glb`` or ``.gltf``."""
    file = gltf.open_gltf(path)
    strange = [name for name in file.root.extensionsRequired if name not in _KNOWN]
    if strange:
        raise file.error(f"must require only {', '.join(_KNOWN)}, found {shown(strange[0])}")
    placed = _splats(file, math.inf if trust_sizes else file.stored // _NODE_BYTES + _MOST_PLACED)
    if not placed:
        raise file.error(f"must have a mesh primitive with {gltf.SPLATS}, found none")
    splats = {one.where: one for one, _ in placed}  # each once, though nodes may repeat its mesh
    if not trust_sizes:
        _check_sizes(file, splats, [one.where for one, _ in placed])
    read, scenes = dict[str, GaussianScene](), []
    for where, one in splats.items():  # a comprehension adds a stack level in Python 3.11 only
        read[where] = _read_primitive(file, one, trust_sizes=trust_sizes)
    for one, matrix in placed:
        scenes.append(_moved(file, read[one.where], matrix))
    scene = concatenate(scenes, fill=True)
    return change_axes(scene, gltf.AXES if axes is None else axes, SCENE_AXES)


def _splats(file: GltfFile, most: float) -> list[tuple[_Splats, Matrix]]:
    """Return the splats of all nodes with their matrices; warn about other primitives."""
    meshes, placed, others = dict[int, list[_Splats]](), list[tuple[_Splats, Matrix]](), 0
    for index, matrix in _placed_meshes(file):
        if index not in meshes:
            primitives = file.entry(_Mesh, "meshes", index).primitives
            meshes[index] = list(_splats_of(file, index, primitives))
            others += len(primitives) - len(meshes[index])
        placed += [(one, matrix) for one in meshes[index]]
        if len(placed) > most:
            raise file.error(
                f"nodes must show at most {most:,} mesh primitives in a file of {file.stored:,} "
                f"bytes, found more; if you trust the file, pass trust_sizes=True (--trust-sizes)"
            )
    if others:
        left_out = counted(others, "mesh primitive")
        warn(f"{file.path}: left out {left_out} without Gaussians.", DroppedDataWarning)
    return placed


def _splats_of(file: GltfFile, index: int, primitives: list[Any]) -> Iterator[_Splats]:
    for number, value in enumerate(primitives):
        where = f"{file.path}: meshes[{index}].primitives[{number}]"
        primitive = validated(_Primitive, value, where)
        if gltf.SPLATS in primitive.extensions:
            found = primitive.extensions[gltf.SPLATS]
            splatting = validated(_Splatting, found, f"{where}: {gltf.SPLATS!r}")
            yield _Splats(primitive, splatting, where)


def _placed_meshes(file: GltfFile) -> Iterator[tuple[int, Matrix]]:
    """Yield the meshes of the scene's nodes with matrices; all meshes if there is no scene."""
    if not file.root.scenes:
        yield from ((index, np.eye(4)) for index in range(len(file.root.meshes)))
        return
    scene = file.entry(_Scene, "scenes", file.root.scene or 0)
    waiting = [(index, np.eye(4)) for index in reversed(scene.nodes)]
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop()
        if index in seen:
            raise file.error(f"each node must occur once in the hierarchy, found {index} again")
        seen.add(index)
        node = file.entry(_Node, "nodes", index)
        with np.errstate(all="ignore"):  # numbers beyond float64 are refused where they are used
            matrix = above @ _local_matrix(node)
        if node.mesh is not None:
            yield node.mesh, matrix
        waiting += [(child, matrix) for child in reversed(node.children)]


def _local_matrix(node: _Node) -> Matrix:
    if node.matrix is not None:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    x, y, z, w = node.rotation
    matrix, length = np.eye(4), math.hypot(x, y, z, w)
    quat = torch.tensor([[w, x, y, z]], dtype=torch.float64, device="cpu")
    quat /= length if 0 < length < math.inf else 1.0
    matrix[:3, :3] = quats_to_matrices(quat)[0].numpy() * node.scale
    matrix[:3, 3] = node.translation
    return matrix


def _check_sizes(file: GltfFile, splats: dict[str, _Splats], placed: list[str]) -> None:
    """Refuse nodes that repeat the same bytes too often."""
    counts, degrees = dict[str, int](), []
    for where, one in splats.items():
        packed = _packed(file, one)
        if packed is not None:
            header = peek_spz(*packed)
            counts[where] = header.count
            degrees.append(header.sh_degree)
            continue
        position = file.entry(gltf.Accessor, "accessors", _index(file, one, gltf.POSITION))
        if position.bufferView is not None:
            file.view(position.bufferView)  # so that the bytes of a file beside it count
        counts[where] = position.count
        degrees.append(_degree(file, one))
    count = sum(counts[where] for where in placed)
    check_expansion(file.path, count=count, sh_degree=max(degrees), stored=file.stored)


def _packed(file: GltfFile, one: _Splats) -> tuple[bytes, str] | None:
    """Return the SPZ inside a primitive, and its name for errors; None if it has attributes."""
    if gltf.SPZ not in one.splatting.extensions:
        return None
    value, where = one.splatting.extensions[gltf.SPZ], f"{one.where}: {gltf.SPZ!r}"
    index = validated(_Compression, value, where).bufferView
    content, _ = file.view(index)
    return bytes(content), f"{file.path}: bufferViews[{index}]"


def _read_primitive(file: GltfFile, one: _Splats, *, trust_sizes: bool) -> GaussianScene:
    primitive, splatting = one.primitive, one.splatting
    if primitive.mode != 0 or splatting.kernel != gltf.KERNEL:
        raise file.error(
            f"Gaussians must be points (mode 0) with the kernel {gltf.KERNEL!r}, found mode "
            f"{primitive.mode} and {shown(splatting.kernel)}"
        )
    if splatting.colorSpace != gltf.COLOR_SPACE:
        found = f"{file.path}: read colours of the colour space {shown(splatting.colorSpace)}"
        warn(f"{found} as {gltf.COLOR_SPACE!r}.", DroppedDataWarning)
    packed = _packed(file, one)
    if packed is None:
        scene = _read_attributes(file, one)
    else:
        scene = decode_spz(*packed, axes=SCENE_AXES, trust_sizes=trust_sizes)
    lines = primitive.extras.get("comments") if isinstance(primitive.extras, dict) else None
    comments = [
        printable(line)
        for line in (lines if isinstance(lines, list) else ())
        if isinstance(line, str) and "\n" not in line
    ]
    own = () if ANTIALIASED.is_in(comments) else scene.comments
    return replace(scene, comments=(*own, *comments))


def _read_attributes(file: GltfFile, one: _Splats) -> GaussianScene:
    means = file.values(_index(file, one, gltf.POSITION), "VEC3", gltf.POSITION)

    def rows(name: str, kind: str) -> Float[np.ndarray, "n k"]:
        values = file.values(_index(file, one, name), kind, name)
        if len(values) != len(means):
            raise file.error(
                f"{name} must have {len(means):,} elements like {gltf.POSITION}, found "
                f"{len(values):,}"
            )
        return values

    quats = rows(gltf.ROTATION, "VEC4")
    scales = rows(gltf.SCALE, "VEC3")
    if bool((scales < 0).any()):
        row = int((scales < 0).any(axis=1).argmax())
        raise file.error(
            f"{gltf.SCALE} must not be negative, found {scales[row].min():.4g} in element {row:,} "
            f"(a draft of the extension, which splat-transform 2.3 wrote, stored logarithms)"
        )
    opacities = rows(gltf.OPACITY, "SCALAR")[:, 0]
    if any(name in one.primitive.attributes for name in gltf.coefficients(len(REST_COUNTS))):
        warn(f"{file.path}: left out SH coefficients above degree 3.", DroppedDataWarning)
    bands = range(1, 1 + _degree(file, one))
    rest = [rows(name, "VEC3") for band in bands for name in gltf.coefficients(band)]
    return Arrays(
        means=means,
        quats=unit_quats(np.roll(quats, 1, axis=1)),
        log_scales=log_scales_of(scales),
        logit_opacities=logits_of(opacities),
        sh0=rows(gltf.coefficients(0)[0], "VEC3"),
        shN=np.stack(rest, axis=1) if rest else np.empty((len(means), 0, 3), np.float32),
    ).scene()


def _index(file: GltfFile, one: _Splats, name: str) -> int:
    if name not in one.primitive.attributes:
        raise file.error(f"Gaussians must have an accessor for {name}, found none")
    return one.primitive.attributes[name]


def _degree(file: GltfFile, one: _Splats) -> int:
    """Return the SH degree; check that all coefficients up to this degree are present."""
    names = one.primitive.attributes
    degree = 0
    for band in range(1, len(REST_COUNTS)):
        wanted = gltf.coefficients(band)
        missing = [name for name in wanted if name not in names]
        if len(missing) == len(wanted):
            continue
        if missing or degree != band - 1:
            lacking = missing[0] if missing else gltf.coefficients(band - 1)[0]
            raise file.error(f"Gaussians must have all SH up to degree {band}, found no {lacking}")
        degree = band
    return degree


def _moved(file: GltfFile, scene: GaussianScene, matrix: Matrix) -> GaussianScene:
    if np.array_equal(matrix, np.eye(4)):
        return scene
    with np.errstate(all="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation = matrix[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
        even = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_EVENNESS)
    affine = np.array_equal(matrix[3], [0, 0, 0, 1]) and bool(np.isfinite(matrix).all())
    if not even or not affine:
        raise file.error(
            "nodes must only rotate, move and uniformly scale Gaussians, found one that stretches, "
            "skews or mirrors them"
        )
    w, a, b, c = matrices_to_quats(torch.from_numpy(rotation)[None])[0].tolist()
    x, y, z = matrix[:3, 3].tolist()
    motion = Motion(quat=(w, a, b, c), scale=scale, shift=(x, y, z))
    try:
        return move(scene, motion)
    except InvalidArgumentError as error:
        raise file.error(f"a node moves Gaussians too far: {str(error).rstrip('.')}") from error
