"""Memory: how much is free, how much a simplification takes, and how many blocks that makes."""

import math
import re
import sys
from pathlib import Path
from typing import NamedTuple

from cvtgs.errors import InvalidArgumentError
from cvtgs.io.ply import PlyRows
from cvtgs.outofcore.scan import SAMPLE_ROWS

BASE_BYTES = 450_000_000
"""Interpreter, torch and scipy (280 MB), network, sample, grid of depths, and a chunk of rows."""

SMALL_BASE_BYTES = 350_000_000
"""The same with a sample of a quarter, for those who have less than ``ROOMY_BYTES``."""

ROOMY_BYTES = 500_000_000
"""With less than this, the sample is small."""

LEAST_BYTES = 400_000_000
"""The small base and a small block: no run in blocks takes less."""

IMAGE_BYTES = 400_000_000
"""Set aside for images of the scene and what they are made of."""

CELL_BYTES = 1500
"""What a cell of the tessellation takes while pairs of cells merge; some 1,030 were measured."""

CELL_ROOM = 1_000_000
"""Cells that merge together if no memory is stated."""

SHARED_BY = 4
"""The number of blocks is a multiple of this, so that two or four workers end at the same time."""

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def read_bytes(text: str) -> int:
    """Read an amount of memory.

    Args:
        text: A number with a unit: kB, MB, GB or TB (powers of 1000), KiB, MiB, GiB or TiB.

    Returns:
        Bytes.

    Raises:
        InvalidArgumentError: It is no amount, or too little to work with.

    Example:
        >>> read_bytes("4GB"), read_bytes("1.5 GiB")
        (4000000000, 1610612736)
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(I?)B?\s*", text.upper())
    if not match:
        raise InvalidArgumentError(f"memory must be an amount such as 4GB, found {text!r}.")
    unit = _UNITS[match[2]]
    if match[3]:
        unit = 1024 ** " KMGT".index(match[2] or " ")
    amount = int(float(match[1]) * unit)
    if amount < LEAST_BYTES:
        raise InvalidArgumentError(
            f"memory must be at least {LEAST_BYTES / 1e6:g} MB: torch and scipy take 280 MB of it, "
            f"the sample, grids and a small block the rest; found {text!r}."
        )
    return amount


def available_memory() -> int:
    """Return how much more memory this process may use.

    The least of what the machine has free, of the limits of the control groups (versions 1 and 2)
    that a container or a job runs in, and of the limits of the process (``ulimit -v``).

    Returns:
        Bytes.

    Example:
        >>> available_memory() > 0
        True
    """
    import psutil  # noqa: PLC0415 (loaded when it is used)

    rooms: list[int] = [psutil.virtual_memory().available, *control_group_rooms(Path("/"))]
    if sys.platform != "win32":
        import resource  # noqa: PLC0415 (not on Windows)

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            rooms.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(rooms))


def memory_to_plan(free: int) -> int:
    """Return the memory to plan with by default: what is free, but enough for a small block.

    The estimates are twice what is used, so less than that would only make more blocks.
    """
    return max(free, LEAST_BYTES)


def control_group_rooms(root: Path) -> list[int]:
    """Return the bytes left in each control group with a limit that this process is in."""
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    rooms = []
    for line in lines:
        _, controllers, path = line.split(":", 2) if line.count(":") > 1 else ("", "-", "")
        if controllers == "":
            names, top = _VERSION_2, root / "sys/fs/cgroup"
        elif "memory" in controllers.split(","):
            names, top = _VERSION_1, root / "sys/fs/cgroup/memory"
        else:
            continue
        # Limits of parents hold too; in a container, the path may be that outside of it.
        parts = [part for part in path.split("/") if part not in ("", "..")]
        folders = {top.joinpath(*parts[:depth]) for depth in range(len(parts) + 1)}
        rooms += [room for folder in folders if (room := _room(folder, names)) is not None]
    return rooms


class _GroupFiles(NamedTuple):
    """Names of the files of a control group."""

    limit: str
    usage: str
    cache: str
    """Key in ``memory.stat`` of file pages that the system takes back first."""


_VERSION_1 = _GroupFiles("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = _GroupFiles("memory.max", "memory.current", "inactive_file")


def _room(folder: Path, names: _GroupFiles) -> int | None:
    """Return the bytes left in a group; None if it has no limit (version 2 writes ``max``)."""
    try:
        limit = int((folder / names.limit).read_text(encoding="ascii"))
        used = int((folder / names.usage).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
    try:
        text = (folder / "memory.stat").read_text(encoding="ascii")
        used -= int(dict(line.split(maxsplit=1) for line in text.splitlines())[names.cache])
    except (OSError, ValueError, KeyError):
        pass
    return limit - max(0, used)


def base_bytes(memory: int | None) -> int:
    """Return what a run takes beside its blocks, which have as much with little memory."""
    if memory is None or memory >= ROOMY_BYTES:
        return BASE_BYTES
    return max(SMALL_BASE_BYTES, memory - (LEAST_BYTES - SMALL_BASE_BYTES))


def sample_rows(memory: int) -> int:
    """Return how many Gaussians stand for all where blocks are laid out."""
    return SAMPLE_ROWS if memory >= ROOMY_BYTES else SAMPLE_ROWS // 4


def needed_memory(source: PlyRows, rows: int) -> int:
    """Estimate what it takes to simplify some rows at once.

    Measured at rho 0.01: 290 bytes per Gaussian without view-dependent colour, 630 with degree 3.

    Args:
        source: The file.
        rows: How many of its rows.

    Returns:
        Bytes.
    """
    return BASE_BYTES + rows * (250 + 2 * source.dtype.itemsize)


def cell_room(memory: int | None) -> int:
    """Return how many cells of the tessellation may merge together."""
    room = CELL_ROOM * CELL_BYTES if memory is None else memory - base_bytes(memory)
    return max(0, room) // CELL_BYTES


def block_count(source: PlyRows, memory: int) -> int:
    """Choose how many blocks fit into memory one after the other.

    A block holds at most twice the mean number of rows (:func:`cvtgs.outofcore.scan.scan_scene`).

    Args:
        source: The file.
        memory: Bytes.

    Returns:
        1 if the whole file fits, else a multiple of ``SHARED_BY``.
    """
    base = min(BASE_BYTES, base_bytes(memory))
    wanted = needed_memory(source, source.count) - BASE_BYTES
    if base + wanted <= memory:
        return 1
    room = (memory if memory > base else LEAST_BYTES) - base
    return SHARED_BY * math.ceil(2 * wanted / room / SHARED_BY)
