"""Zstandard, which ``.spz`` files of version 4 use; the only file that knows the package."""

import numpy as np
from jaxtyping import UInt8

from cvtgs.errors import FileFormatError, MissingDependencyError


def decompress(content: bytes, size: int, where: str) -> UInt8[np.ndarray, "b"]:
    """Decompress a block of known size."""
    try:
        import zstandard  # noqa: PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            f"{where}: .spz files of version 4 need the package zstandard: "
            f'pip install "cvtgs[spz]"; or write the file as version 3.'
        ) from error
    try:
        with zstandard.ZstdDecompressor().stream_reader(content) as stream:
            data = stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise FileFormatError(f"{where} must be whole zstd, found damage: {error}.") from error
    if len(data) != size:
        found = f"{len(data):,}" if len(data) < size else "more"
        raise FileFormatError(f"{where} must have {size:,} bytes, found {found}.")
    return np.frombuffer(data, np.uint8)
