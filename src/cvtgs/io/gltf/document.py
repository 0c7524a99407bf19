"""The parts of a glTF document that splats need: chunks, buffers, accessors and their checks."""

import base64
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cvtgs.errors import FileFormatError
from cvtgs.io.files import (
    LONGEST_NAME,
    AnyDocument,
    Document,
    Flag,
    Size,
    Text,
    Whole,
    is_within,
    open_input,
    parse_json,
    validated,
)
from cvtgs.text import shown

SPLATS = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
QUANTIZATION = "KHR_mesh_quantization"
KERNEL = "ellipse"
COLOR_SPACE = "srgb_rec709_display"
AXES = "luf"  # axes of every glTF: y up, z forward, hence x left (section 3.4 of glTF 2.0)
POSITION, COLOR = "POSITION", "COLOR_0"
ROTATION, SCALE, OPACITY = f"{SPLATS}:ROTATION", f"{SPLATS}:SCALE", f"{SPLATS}:OPACITY"
MAGIC, VERSION = b"glTF", 2
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
BYTE, UNSIGNED_BYTE, SHORT, UNSIGNED_SHORT, FLOAT = 5120, 5121, 5122, 5123, 5126
COMPONENTS: dict[int, np.dtype[Any]] = {
    BYTE: np.dtype("i1"),
    UNSIGNED_BYTE: np.dtype("u1"),
    SHORT: np.dtype("<i2"),
    UNSIGNED_SHORT: np.dtype("<u2"),
    FLOAT: np.dtype("<f4"),
}
_LARGEST = {BYTE: 127, UNSIGNED_BYTE: 255, SHORT: 32767, UNSIGNED_SHORT: 65535}
# Integer encodings of attributes (component type, whether normalized) and the text for errors. All
# attributes may be floats; those that are not listed must be.
_INTEGERS = frozenset((kind, scaled) for kind in _LARGEST for scaled in (False, True))
_ENCODINGS = {
    ROTATION: (
        frozenset({(BYTE, True), (SHORT, True)}),
        "floats, or of normalized signed bytes or shorts",
    ),
    SCALE: (_INTEGERS, "floats, bytes or shorts"),
    OPACITY: (
        frozenset({(UNSIGNED_BYTE, True), (UNSIGNED_SHORT, True)}),
        "floats, or of normalized unsigned bytes or shorts",
    ),
    POSITION: (_INTEGERS, f"floats, or of bytes or shorts with {QUANTIZATION}"),
}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MOST_STRIDE = 252


def coefficients(degree: int) -> list[str]:
    """Return the names of the attributes of the SH coefficients of one degree."""
    return [f"{SPLATS}:SH_DEGREE_{degree}_COEF_{number}" for number in range(2 * degree + 1)]


Entry = Annotated[dict[str, Any], Field(default_factory=dict, description="a JSON object")]
Entries = Annotated[list[Any], Field(default_factory=list, description="a list")]
Indices = Annotated[
    list[Size], Field(default_factory=list, description="a list of whole numbers of at least 0")
]


class GltfRoot(Document):
    """The root of a glTF document."""

    asset: Entry
    extensionsUsed: Entries  # noqa: N815 (the names of glTF, here and below)
    extensionsRequired: Entries  # noqa: N815
    scene: Size | None = None
    scenes: Entries
    nodes: Entries
    meshes: Entries
    accessors: Entries
    bufferViews: Entries  # noqa: N815
    buffers: Entries


class _Buffer(Document):
    byteLength: Size  # noqa: N815
    uri: Text | None = None


class _View(Document):
    buffer: Size
    byteOffset: Size = 0  # noqa: N815
    byteLength: Size  # noqa: N815
    byteStride: Size | None = None  # noqa: N815


class Accessor(Document):
    """Where the numbers of an attribute are, and their types."""

    bufferView: Size | None = None  # noqa: N815
    byteOffset: Size = 0  # noqa: N815
    componentType: Whole  # noqa: N815
    normalized: Flag = False
    count: Size
    type: Text
    sparse: Any = None


@dataclass(slots=True, kw_only=True)
class GltfFile:
    """A glTF document and its bytes; entries and buffers are checked and read lazily."""

    path: Path
    root: GltfRoot
    binary: bytes | None = None  # the chunk of a ``.glb``
    stored: int  # bytes of the file, plus those read so far from files beside it, each once
    _buffers: dict[int, memoryview] = field(default_factory=dict)
    _beside: dict[Path, bytes] = field(default_factory=dict)

    def entry(self, model: type[AnyDocument], name: str, index: int) -> AnyDocument:
        """Return a checked entry of a list of the document."""
        entries = getattr(self.root, name)
        if index >= len(entries):
            raise self.error(f"{name} has {len(entries):,} entries, found a reference to {index}")
        return validated(model, entries[index], f"{self.path}: {name}[{index}]")

    def error(self, text: str) -> FileFormatError:
        """Return an error about this file."""
        return FileFormatError(f"{self.path}: {text}.")

    def view(self, index: int) -> tuple[memoryview, int | None]:
        """Return the bytes of a buffer view, and its stride if it states one."""
        view = self.entry(_View, "bufferViews", index)
        content = self._buffer(view.buffer)
        end = view.byteOffset + view.byteLength
        if end > len(content):
            raise self.error(
                f"bufferViews[{index}] must end within {len(content):,} bytes, found byte {end:,}"
            )
        return content[view.byteOffset : end], view.byteStride

    def values(self, index: int, kind: str, name: str) -> NDArray[np.float32]:
        """Return the numbers of an accessor as float32, one row per element."""
        accessor = self.entry(Accessor, "accessors", index)
        where = f"accessors[{index}] ({name})"
        component = accessor.componentType
        integers, encodings = _ENCODINGS.get(name, (frozenset(), "floats"))
        if name == POSITION and QUANTIZATION not in self.root.extensionsUsed:
            integers = frozenset()
        dtype = COMPONENTS.get(component)
        fits = component == FLOAT or (component, accessor.normalized) in integers
        if accessor.type != kind or dtype is None or not fits:
            scaled = ", normalized" if accessor.normalized else ", not normalized"
            raise self.error(
                f"{where} must be {kind} of {encodings}, found {shown(accessor.type)} of component "
                f"type {component}{scaled if component in _LARGEST else ''}"
            )
        if accessor.sparse is not None or accessor.bufferView is None:
            found = "a sparse one" if accessor.sparse is not None else "none"
            raise self.error(f"{where} must be in a buffer view, found {found}")
        content, stated = self.view(accessor.bufferView)
        width = WIDTHS[kind] * dtype.itemsize
        stride = stated or width
        if not width <= stride <= _MOST_STRIDE:
            raise self.error(
                f"{where} must have a stride of {width} to {_MOST_STRIDE} bytes, found {stride:,}"
            )
        end = accessor.byteOffset + stride * (accessor.count - 1) + width
        if accessor.count == 0 or end > len(content):
            raise self.error(
                f"{where} must have at least one element and end within {len(content):,} bytes, "
                f"found {accessor.count:,} elements that end at byte {end:,}"
            )
        shape, strides = (accessor.count, WIDTHS[kind]), (stride, dtype.itemsize)
        rows: NDArray[Any] = np.ndarray(shape, dtype, content, accessor.byteOffset, strides)
        numbers = rows.astype(np.float32)
        if accessor.normalized and component in _LARGEST:
            numbers /= np.float32(_LARGEST[component])
            np.maximum(numbers, -1, out=numbers)
        return numbers

    def _buffer(self, index: int) -> memoryview:
        if index in self._buffers:
            return self._buffers[index]
        buffer = self.entry(_Buffer, "buffers", index)
        content: bytes | None
        if buffer.uri is None:
            content = self.binary if index == 0 else None
            if content is None:
                raise self.error(f"buffers[{index}] must have a uri, found none")
        elif buffer.uri.startswith("data:"):
            head, _, text = buffer.uri.partition(",")
            if not head.endswith(";base64"):
                raise self.error(f"buffers[{index}] must have data in base64, found {shown(head)}")
            try:
                content = base64.b64decode(text, validate=True)
            except ValueError as error:  # also binascii.Error
                raise self.error(f"buffers[{index}] must be base64, found: {error}") from error
        else:
            content = self._read_beside(buffer.uri, index)
        if len(content) < buffer.byteLength:
            raise self.error(
                f"buffers[{index}] must have {buffer.byteLength:,} bytes, found {len(content):,}"
            )
        self._buffers[index] = memoryview(content)[: buffer.byteLength]
        return self._buffers[index]

    def _read_beside(self, uri: str, index: int) -> bytes:
        """Read a file once, however many buffers it is."""
        name = unquote(uri)
        if not is_within(name) or len(name) > LONGEST_NAME:  # such as a damaged data URI
            raise self.error(f"buffers[{index}] must be in the file's folder, found {shown(uri)}")
        path = self.path.parent / PurePosixPath(name)
        with open_input(path) as file:
            place = path.resolve()
            if place not in self._beside:
                self._beside[place] = file.read()
                self.stored += len(self._beside[place])
        return self._beside[place]


def open_gltf(path: Path) -> GltfFile:
    """Read the JSON and the binary chunk of a ``.glb`` or ``.gltf``."""
    with open_input(path) as file:
        content = file.read()
    binary, text = None, content
    if content[: len(MAGIC)] == MAGIC:
        text, binary = _chunks(content, path)
    elif path.suffix.lower() == ".glb":
        raise FileFormatError(f"{path}: a .glb must start with b'glTF', found {content[:4]!r}.")
    root = validated(GltfRoot, parse_json(text, path), str(path))
    return GltfFile(path=path, root=root, binary=binary, stored=len(content))


def _chunks(content: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """Split a ``.glb`` into its JSON chunk and its binary chunk."""
    if len(content) < HEADER.size:
        text = f"{path}: must start with a header of 12 bytes, found {len(content)}."
        raise FileFormatError(text)
    _, version, length = HEADER.unpack_from(content)
    if version != VERSION or length > len(content):
        raise FileFormatError(
            f"{path}: must be glTF version {VERSION} with the {length:,} bytes that its "
            f"header promises, found version {version} and {len(content):,} bytes."
        )
    found: dict[int, bytes] = {}
    at = HEADER.size
    while at + CHUNK.size <= length:
        size, kind = CHUNK.unpack_from(content, at)
        at += CHUNK.size
        if at + size > length:
            raise FileFormatError(
                f"{path}: chunks must end within {length:,} bytes, found one that ends at byte "
                f"{at + size:,}."
            )
        found.setdefault(kind, content[at : at + size])
        at += size
    if JSON_CHUNK not in found:
        raise FileFormatError(f"{path}: a .glb must have a JSON chunk, found none.")
    return found[JSON_CHUNK], found.get(BINARY_CHUNK)
