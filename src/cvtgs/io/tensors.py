"""Named tensors in safetensors files, which store networks and caches (never pickles)."""

import errno
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cvtgs.errors import FileFormatError, InputNotFoundError
from cvtgs.io.atomic import write_atomically


def pack_tensors(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """Return the bytes of a safetensors file; the same content gives the same bytes."""
    from safetensors.torch import save  # noqa: PLC0415 (loaded when it is used)

    own = {name: values.detach().cpu().contiguous() for name, values in tensors.items()}
    content = save(own)
    length = int.from_bytes(content[:8], "little")
    # safetensors would write the metadata in another order every time.
    header = {"__metadata__": dict(sorted(metadata.items())), **json.loads(content[8 : 8 + length])}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join([len(text).to_bytes(8, "little"), text, memoryview(content)[8 + length :]])


def unpack_tensors(content: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the bytes of a safetensors file."""
    from safetensors import SafetensorError  # noqa: PLC0415
    from safetensors.torch import load  # noqa: PLC0415

    try:
        tensors = load(content)
        length = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + length]).get("__metadata__") or {}
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise FileFormatError("must be the bytes of a safetensors file, found others.") from error
    return tensors, metadata


def save_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Write tensors to a file atomically; an existing file is replaced."""
    write_atomically(path, pack_tensors(tensors, metadata), overwrite=True)


def map_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Map the tensors of a file into memory; pages are read on use."""
    from safetensors import SafetensorError, safe_open  # noqa: PLC0415

    if not Path(path).is_file():
        text = f"{path}: the file to read must exist, found none."
        raise InputNotFoundError(text).about(path, errno.ENOENT)
    try:
        with safe_open(os.fspath(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise FileFormatError(
            f"{path}: must be an intact safetensors file, found damage."
        ) from error


def tensors_digest(tensors: Mapping[str, Tensor], text: str) -> str:
    """Return the SHA-256 hash of tensors and of a text that belongs to them."""
    digest = hashlib.sha256(f"{text}\n".encode())
    for name in sorted(tensors):
        values = tensors[name].detach().cpu()
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}\n".encode())
        digest.update(values.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def add_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Add a prefix to names, to store several groups of tensors in one file."""
    return {prefix + name: values for name, values in tensors.items()}


def under_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the tensors of one group, the inverse of :func:`add_prefix`."""
    return {
        name.removeprefix(prefix): values
        for name, values in tensors.items()
        if name.startswith(prefix)
    }
