"""Functions that take glTF files apart and change them, for tests."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

NAME = "KHR_gaussian_splatting"
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
    """Change the JSON document of a ``.glb`` in place."""
    document, binary = parts(path.read_bytes())
    change(document)
    path.write_bytes(joined(document, binary))
    return path


def primitive(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]


def accessor(document: dict[str, Any], name: str) -> dict[str, Any]:
    return document["accessors"][primitive(document)["attributes"][name]]


def without(document: dict[str, Any], name: str) -> None:
    del primitive(document)["attributes"][f"{NAME}:{name}"]
