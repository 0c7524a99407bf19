"""How large a scene may be for the bytes that its file has: one bound for all compressed formats.

A few bytes of deflate, zstd, WebP or a tensor without strides can stand for any number of
Gaussians, so a header that claims many is no proof of them.
"""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from cvtgs.errors import FileFormatError

FREE_BYTES = 1 << 26
"""A scene of at most this many bytes in memory is read from a file of any size."""

MOST_EXPANSION = 64
"""Beyond that, a scene may have this many times the bytes of its file; real ones have 4 to 13."""

_FLOATS = 14
"""Numbers of a Gaussian without view-dependent colour."""


def check_expansion(path: Path | str, *, count: int, rest: int, stored: int) -> None:
    """Refuse a file that claims far more Gaussians, of ``rest`` SH coefficients, than it can hold.

    Every reader of a compressed format calls this before it unpacks anything, unless sizes are
    trusted.
    """
    wanted = 4 * count * (_FLOATS + 3 * rest)
    if wanted > FREE_BYTES + MOST_EXPANSION * stored:
        raise FileFormatError(
            f"{path}: a scene must have at most {FREE_BYTES >> 20} MiB and {MOST_EXPANSION} times "
            f"the bytes of its file, found {count:,} Gaussians that take {wanted:,} bytes in a "
            f"file of {stored:,}; if you trust the file, pass trust_sizes=True (--trust-sizes)."
        )


def check_stored(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors of a checkpoint that repeat numbers instead of storing each."""
    for name, tensor in tensors.items():
        wanted, stored = tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes()
        if wanted > stored:
            raise FileFormatError(
                f"{path}: {name!r} must store each of its {wanted:,} bytes, found {stored:,}; if "
                f"you trust the file, pass trust_sizes=True (--trust-sizes)."
            )
