"""Write Gaussians as glTF."""

import base64
import io
import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from cvtgs.errors import InvalidSceneError
from cvtgs.io.arrays import Arrays, to_bytes
from cvtgs.io.gltf import document as gltf
from cvtgs.io.spz import write_spz
from cvtgs.math.spherical_harmonics import degree_of
from cvtgs.scene import GaussianScene

_CHUNK_ROWS = 1 << 18
_MOST_BYTES = 1 << 32
_ARRAY_BUFFER = 34962
_DATA = "data:application/octet-stream;base64,"
_SPZ_VERSION: Final = 3  # the newest version that readers of the draft of the extension accept


class _Attribute(NamedTuple):
    """An attribute of all Gaussians; its values are computed in chunks."""

    name: str
    kind: str
    values: Callable[[Arrays], Shaped[np.ndarray, "n k"]]

    @property
    def component(self) -> int:
        return gltf.UNSIGNED_BYTE if self.name == gltf.COLOR else gltf.FLOAT

    @property
    def row_bytes(self) -> int:
        return gltf.WIDTHS[self.kind] * gltf.COMPONENTS[self.component].itemsize

    def parts(self, arrays: Arrays) -> Iterator[bytes]:
        for part in arrays.chunks(_CHUNK_ROWS):
            values = self.values(part)
            yield np.ascontiguousarray(values, gltf.COMPONENTS[self.component]).tobytes()


def write_glb(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a ``.glb`` with ``KHR_gaussian_splatting``, in the order and the axes of the scene."""
    arrays = Arrays.of(scene)
    attributes, count = _attributes(arrays), len(arrays.means)
    document = _document(scene, arrays, attributes)
    size = count * sum(one.row_bytes for one in attributes)
    write_chunks(file, document, size, (part for one in attributes for part in one.parts(arrays)))


def write_gltf(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a ``.gltf`` like :func:`write_glb`, but as one JSON text with numbers in base64."""
    arrays = Arrays.of(scene)
    attributes, count = _attributes(arrays), len(arrays.means)
    document = _document(scene, arrays, attributes)
    buffer = {"byteLength": count * sum(one.row_bytes for one in attributes), "uri": _DATA}
    # Numbers are encoded as they are written: as one text, they would be in memory several times.
    start, end = json_bytes(document | {"buffers": [buffer]})[:-4], b'"}]}'
    file.write(start)
    rest = b""
    for part in (part for one in attributes for part in one.parts(arrays)):
        rest += part
        whole = len(rest) // 3 * 3  # bytes that need no padding
        file.write(base64.b64encode(rest[:whole]))
        rest = rest[whole:]
    file.write(base64.b64encode(rest) + end)


def write_spz_glb(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a ``.glb`` with ``KHR_gaussian_splatting_compression_spz_2``: an SPZ inside a glTF.

    The SPZ has the axes of the glTF, as CesiumJS reads it. Viewers without the extension show
    nothing.
    """
    arrays = Arrays.of(scene)
    packed = io.BytesIO()
    write_spz(scene, packed, version=_SPZ_VERSION)
    content = packed.getvalue()
    # Keep those that the draft of the extension lists; COLOR_0 has colours and opacities.
    left_out = (gltf.OPACITY, *gltf.coefficients(0))
    attributes = [one for one in _attributes(arrays) if one.name not in left_out]
    document = _document(scene, arrays, attributes, compressed=len(content))
    write_chunks(file, document, len(content), [content])


def _attributes(arrays: Arrays) -> list[_Attribute]:
    def colors(part: Arrays) -> Shaped[np.ndarray, "n 4"]:
        return np.column_stack([to_bytes(255 * part.colors), part.opacity_bytes])

    def rest(number: int) -> Callable[[Arrays], Float[np.ndarray, "n 3"]]:
        return lambda part: part.shN[:, number]

    bands = range(1, 1 + degree_of(arrays.shN.shape[1]))
    names = [name for band in bands for name in gltf.coefficients(band)]
    return [
        _Attribute(gltf.POSITION, "VEC3", lambda part: part.means),
        _Attribute(gltf.COLOR, "VEC4", colors),
        _Attribute(gltf.ROTATION, "VEC4", lambda part: np.roll(part.quats, -1, axis=1)),
        _Attribute(gltf.SCALE, "VEC3", lambda part: part.scales),
        _Attribute(gltf.OPACITY, "SCALAR", lambda part: part.opacities),
        _Attribute(gltf.coefficients(0)[0], "VEC3", lambda part: part.sh0),
        *(_Attribute(name, "VEC3", rest(number)) for number, name in enumerate(names)),
    ]


def _document(
    scene: GaussianScene,
    arrays: Arrays,
    attributes: list[_Attribute],
    *,
    compressed: int | None = None,
) -> dict[str, Any]:
    """Return the document without buffers; accessors of compressed values have no view."""
    views: list[dict[str, Any]] = []
    accessors, offset, count = [], 0, len(arrays.means)
    for number, one in enumerate(attributes):
        accessor = {"componentType": one.component, "count": count, "type": one.kind}
        if one.component == gltf.UNSIGNED_BYTE:
            accessor["normalized"] = True
        if one.name == gltf.POSITION:
            accessor["min"] = arrays.means.min(axis=0).tolist()
            accessor["max"] = arrays.means.max(axis=0).tolist()
        if compressed is None:
            accessor["bufferView"] = number
            size = count * one.row_bytes
            view = {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": _ARRAY_BUFFER}
            views.append(view)
            offset += size
        accessors.append(accessor)
    splatting: dict[str, Any] = {"kernel": gltf.KERNEL, "colorSpace": gltf.COLOR_SPACE}
    used = [gltf.SPLATS]
    if compressed is not None:
        views = [{"buffer": 0, "byteOffset": 0, "byteLength": compressed}]
        splatting["extensions"] = {gltf.SPZ: {"bufferView": 0}}
        used.append(gltf.SPZ)
    primitive: dict[str, Any] = {
        "mode": 0,
        "attributes": {one.name: number for number, one in enumerate(attributes)},
        "extensions": {gltf.SPLATS: splatting},
    }
    if scene.comments:
        lines = [line for comment in scene.comments for line in comment.splitlines()]
        primitive["extras"] = {"comments": lines}
    required = {} if compressed is None else {"extensionsRequired": used}
    return {
        "asset": {"version": "2.0", "generator": "cvtgs"},
        "extensionsUsed": used,
        **required,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
    }


def json_bytes(document: dict[str, Any]) -> bytes:
    """Return a document as JSON without blanks."""
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def write_chunks(
    file: BinaryIO, document: dict[str, Any], size: int, parts: Iterable[bytes]
) -> None:
    """Write a ``.glb`` with one buffer, given its size in bytes and its parts."""
    text = json_bytes({**document, "buffers": [{"byteLength": size}]})
    text += b" " * (-len(text) % 4)
    padded = size + -size % 4
    length = gltf.HEADER.size + 2 * gltf.CHUNK.size + len(text) + padded
    if length >= _MOST_BYTES:
        raise InvalidSceneError(
            f"a .glb must be below 4 GiB, found {length:,} bytes; write .spz.glb, or simplify."
        )
    file.write(gltf.HEADER.pack(gltf.MAGIC, gltf.VERSION, length))
    file.write(gltf.CHUNK.pack(len(text), gltf.JSON_CHUNK) + text)
    file.write(gltf.CHUNK.pack(padded, gltf.BINARY_CHUNK))
    for part in parts:
        file.write(part)
    file.write(bytes(padded - size))
