"""Free memory, the memory that a simplification needs, and the resulting number of blocks."""

import math
import os
import re
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch

from cvtgs.cells.moments import MAX_COMPONENTS
from cvtgs.config import AllocationConfig
from cvtgs.counts import checked_whole, whole_number
from cvtgs.devices import core_count
from cvtgs.errors import InvalidArgumentError, warn
from cvtgs.grouping import finer_count
from cvtgs.io.ply import PlyRows
from cvtgs.outofcore.scan import SAMPLE_ROWS
from cvtgs.processes import Workers, pool_size
from cvtgs.text import counted, shown, size_text

LIBRARY_BYTES = 280_000_000 if torch.version.cuda is None else 430_000_000
"""Interpreter, torch and scipy. The CUDA build of torch takes 150 MB more of its own, and maps
370 MB of libraries, which the system can drop."""

BASE_BYTES = LIBRARY_BYTES + 170_000_000  # network, sample, grid of depths, a chunk of rows
SMALL_BASE_BYTES = LIBRARY_BYTES + 70_000_000  # the same with a quarter of the sample
ROOMY_BYTES = LIBRARY_BYTES + 220_000_000  # with less memory than this, the sample is small
PLAIN_ROW = 68  # bytes of a row without view-dependent colour, for which these figures hold
WORKER_BYTES = 2 * ROOMY_BYTES  # of each process that works on blocks: torch, a larger block
LEAST_BYTES = LIBRARY_BYTES + 180_000_000
"""Of a run in blocks: the small base, a small block, and 60 MB for a sample of degree 3."""
SMALL_BLOCK_BYTES = 50_000_000  # of a block with the least memory
IMAGE_BYTES = 400_000_000  # memory reserved for images of the scene and their intermediate data

CELL_BYTES = 1500
"""Bytes per cell while pairs of cells merge; some 1,030 were measured, and 220 more with twelve
components of view-dependent colour."""

MERGING_BYTES = 230  # the same in one piece, beyond what rows take in other stages
ORDER_BYTES = 336  # of each Gaussian, likewise, from the second of several levels on
KEPT_BYTES = 500  # of each Gaussian that is kept, likewise, which counts where these are most
# Bytes of files on disk, measured with 20,000 to a million Gaussians:
SCAN_BYTES = 9_000_000  # the grid of depths
FOLDER_BYTES = 20_000  # of each block: headers and reports
ROW_BYTES = 12  # of each row beyond those of the source
POINT_BYTES = 60  # of each row: its order, its cell, the sample of Lloyd
SENT_SHARE = 1.25  # of the rows leave for a cell of another block, if each block has one cell
SITE_BYTES = 256  # of each cell: sites before and after two iterations, sums of their points
PART_BYTES = 128  # of each cell: moments of its parts
GROUP_BYTES = 288  # of each Gaussian that is kept: moments and neighbours, of groups and of cells
COMPONENT_BYTES = 8  # of each component of view-dependent colour in moments
STREAM_PART = 6  # divides the bytes of a row: about what a Gaussian of a stream takes
RESULTS = 3  # in rows of the source: merged, inflated and corrected
SAMPLE_BYTES = 56  # of each Gaussian of the sample that images show
IMAGE_ROW_BYTES = 16  # of each row: contributions to images, and its cell before the second round
ERROR_BYTES = 12  # of each Gaussian that is kept, by image: most errors count in several blocks

WRITING_ROWS = 5  # in rows of the file: what a format takes that is written from memory
CELL_ROOM = 1 << 20  # number of cells that may merge together if no memory is given
SHARED_BY = 4  # divides the number of blocks, so that two or four workers end at the same time


def read_bytes(text: str) -> int:
    """Read an amount of memory in bytes, such as 4GB (powers of 1000) or 1.5 GiB."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(I?)B?\s*", text.upper())
    if not match:
        raise InvalidArgumentError(f"memory must be an amount such as 4GB, found {text!r}.")
    unit = (1024 if match[3] else 1000) ** " KMGT".index(match[2] or " ")
    amount = min(int(min(float(match[1]), 1e30) * unit), sys.maxsize)
    check_memory(amount, with_images=False, written=text)
    return amount


def available_memory() -> int:
    """Return the bytes that machine, control groups and ``ulimit -v`` still leave this process."""
    import psutil  # noqa: PLC0415 (loaded when it is used)

    rooms: list[int] = [psutil.virtual_memory().available, *control_group_rooms(Path("/"))]
    if sys.platform != "win32":
        import resource  # noqa: PLC0415 (not on Windows)

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            rooms.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(rooms))


def check_memory(memory: int | None, *, with_images: bool, written: str | None = None) -> None:
    """Raise if the memory that was given, maybe as a text, is too small for any run in blocks."""
    if memory is None:
        return
    given = whole_number(memory)
    if given < 0:
        raise InvalidArgumentError(
            f"memory must be a whole number of bytes above 0, found {shown(memory)}."
        )
    least = LEAST_BYTES + (IMAGE_BYTES if with_images else 0)
    if given < least:
        images = f" images of the scene {IMAGE_BYTES / 1e6:g} MB," if with_images else ""
        found = f"{given:,} bytes" if written is None else repr(written)
        raise InvalidArgumentError(
            f"memory must be at least {least / 1e6:g} MB: torch and scipy take "
            f"{LIBRARY_BYTES / 1e6:g} MB,{images} and the sample, the grids and a small block need "
            f"the rest; found {found}."
        )


def warn_of_writing(
    output: str | os.PathLike[str], source: PlyRows, *, target: int, memory: int, workers: Workers
) -> None:
    """Warn if an output that is written from memory, after all workers, takes more than they do."""
    memory = min(memory * getattr(workers, "count", 1), max(memory, available_memory()))
    needed = LIBRARY_BYTES + WRITING_ROWS * source.dtype.itemsize * target
    if needed > memory:
        warn(
            f"{os.fspath(output)}: this format is written all at once, which needs about "
            f"{size_text(needed)} for {counted(target, 'Gaussian')}, more than "
            f"{size_text(memory)}; a .ply is written part by part."
        )


def memory_to_plan() -> int:
    """Return the default memory to plan with."""
    # Estimates are above the actual use, that of blocks about twice, so none of it is held back.
    return max(available_memory(), LEAST_BYTES)


def control_group_rooms(root: Path) -> list[int]:
    """Return the bytes left in each control group of this process that has a limit."""
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
        # Limits of parents apply, too; in a container, the path may be the one outside of it.
        parts = [part for part in path.split("/") if part not in ("", "..")]
        folders = {top.joinpath(*parts[:depth]) for depth in range(len(parts) + 1)}
        rooms += [room for folder in folders if (room := _room(folder, names)) is not None]
    return rooms


# Files of limit and use of a control group, and the key in ``memory.stat`` of the file pages that
# the system reclaims first.
_VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = ("memory.max", "memory.current", "inactive_file")


def _room(folder: Path, names: tuple[str, str, str]) -> int | None:
    """Return the bytes left in a group; None if it has no limit (version 2 writes ``max``)."""
    limit_file, usage_file, cache = names
    try:
        limit = int((folder / limit_file).read_text(encoding="ascii"))
        used = int((folder / usage_file).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
    try:
        text = (folder / "memory.stat").read_text(encoding="ascii")
        used -= int(dict(line.split(maxsplit=1) for line in text.splitlines())[cache])
    except (OSError, ValueError, KeyError):
        pass
    return limit - max(0, used)


def base_bytes(memory: int) -> int:
    """Return the bytes of a run without its blocks; with little memory, blocks get a fixed rest."""
    if memory >= ROOMY_BYTES:
        return BASE_BYTES
    return max(SMALL_BASE_BYTES, memory - SMALL_BLOCK_BYTES)


def sample_rows(memory: int, source: PlyRows) -> int:
    """Return the size of the sample from which the blocks are laid out."""
    # Measured with 520,000 rows of degree 3: each byte of a row beyond a plain one takes 1.25.
    longer = 5 * max(0, source.dtype.itemsize - PLAIN_ROW) // 4
    needed = ROOMY_BYTES + min(source.count, 2 * SAMPLE_ROWS) * longer
    return SAMPLE_ROWS if memory >= needed else SAMPLE_ROWS // 4


def needed_memory(source: PlyRows, rows: int, *, merging: int = 0) -> int:
    """Estimate the bytes needed to simplify some rows at once."""
    # Measured without view-dependent colour (python -m benchmarks.memory): 410 bytes per Gaussian
    # at rho 0.01, 630 where pairs merge from single Gaussians; with degree 3, 450 and 860.
    return BASE_BYTES + rows * (290 + 2 * source.dtype.itemsize) + merging * MERGING_BYTES


def merging_rows(target: int, available: int, config: AllocationConfig) -> int:
    """Return how many cells or single Gaussians merge, and more if many Gaussians are kept."""
    kept = math.ceil(target * KEPT_BYTES / MERGING_BYTES)
    return max(finer_count(target, available, config), kept)


def merging_in_levels(targets: Sequence[int], rows: PlyRows, config: AllocationConfig) -> int:
    """Return the rows that take as much memory as merging, for levels one after the other."""
    smaller = [target for target in set(targets) if target < rows.count]  # a whole one merges none
    merging = merging_rows(max(smaller, default=rows.count), rows.count, config)
    if len(smaller) > 1:  # from the second one on, the order and all moments are kept
        return merging + math.ceil(rows.count * ORDER_BYTES / MERGING_BYTES)
    return merging + merging // 4


def cell_room(memory: int | None) -> int:
    """Return how many cells of the tessellation may merge together in this memory."""
    if memory is None:
        return CELL_ROOM
    room = max(0, memory - base_bytes(memory)) // CELL_BYTES
    dropped = max(0, room.bit_length() - 3)  # so that the result does not depend on every byte
    return room >> dropped << dropped


def block_count(source: PlyRows, memory: int, *, merging: int = 0) -> int:
    """Choose the number of blocks, so that any one of them fits: 1, or a multiple of SHARED_BY."""
    base = min(BASE_BYTES, base_bytes(memory))
    if base + needed_memory(source, source.count, merging=merging) - BASE_BYTES <= memory:
        return 1
    wanted = needed_memory(source, source.count) - BASE_BYTES  # blocks have at most twice the mean
    room = (memory if memory > base else LEAST_BYTES) - base
    return SHARED_BY * math.ceil(2 * wanted / room / SHARED_BY)


def joint_cells(kept: int, total: int, room: int, config: AllocationConfig) -> int:
    """Return the number of cells of the tessellation of all blocks, which one process merges."""
    finer = finer_count(kept, total, config)
    if total > room:
        finer = min(finer, max(room, 2 * kept), max(kept, total // 2))
    return finer


def sorted_bytes(source: PlyRows) -> int:
    """Estimate the bytes of the files once all rows are sorted."""
    return SCAN_BYTES + source.count * (source.dtype.itemsize + ROW_BYTES)


def stream_bytes(source: PlyRows, gaussians: int) -> int:
    """Estimate the bytes of the files of a stream of some Gaussians, before it is published."""
    return sorted_bytes(source) + gaussians * source.dtype.itemsize // STREAM_PART


def step_bytes(
    source: PlyRows, *, cells: int, kept: int, blocks: int, with_images: bool, views: int
) -> int:
    """Estimate the bytes of the files of all steps, and of the output.

    With the errors of some ``views``, cells are allocated again, and their files exist twice.
    """
    # Few cells of large blocks cross their borders: as many as surface to volume.
    share = min(1.0, SENT_SHARE * math.pow((blocks - 1) / cells, 1 / 3))
    row, names = source.dtype.itemsize, source.dtype.names or ()
    components = min(MAX_COMPONENTS, sum(name.startswith("f_rest_") for name in names))
    sent = share * source.count * (row + ROW_BYTES)
    parts = (1.0 + share) * cells * (PART_BYTES + COMPONENT_BYTES * components)
    groups = kept * (GROUP_BYTES + COMPONENT_BYTES * components + RESULTS * row)
    files = source.count * POINT_BYTES + cells * SITE_BYTES + blocks * FOLDER_BYTES + kept * row
    if with_images:
        files += source.count * IMAGE_ROW_BYTES + kept * (row + views * ERROR_BYTES)
        files += min(source.count, 2 * SAMPLE_ROWS) * SAMPLE_BYTES
    rounds = 2 if views else 1
    return sorted_bytes(source) + math.ceil(files + rounds * (sent + parts + groups))


def warn_of_full_disk(folder: str, needed: int) -> None:
    """Warn if the files of the blocks will probably not fit on their disk."""
    with suppress(OSError):
        free = shutil.disk_usage(folder).free
        if free < needed:
            warn(
                f"{Path(folder).parent}: the files of the blocks take some {size_text(needed)}, "
                f"but {size_text(free)} of the disk are free; write the output to a larger one."
            )


def chosen_blocks(
    source: PlyRows, memory: int, *, wanted: int | None, most: int, merging: int = 0
) -> int:
    """Return the number of blocks that is wanted, else the one that memory needs; at most some."""
    if wanted is None:
        return min(block_count(source, memory, merging=merging), most)
    return min(checked_whole(wanted, "blocks"), most)


def worker_count(memory: int, wanted: int | None) -> int:
    """Choose the number of processes: as wanted or one per core, if the memory is enough."""
    return pool_size(max(1, min(wanted or core_count(), memory // WORKER_BYTES)))
