"""The job of an out-of-core run: all data that a process needs, and its folder of block files."""

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import torch
from torch import Tensor

import cvtgs
from cvtgs.boxes import Box
from cvtgs.cameras import Cameras
from cvtgs.clock import StageClock
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.errors import CvtgsError, InputError, OutputError, reason_of
from cvtgs.io.atomic import write_atomically
from cvtgs.io.axes import SCENE_AXES
from cvtgs.io.files import is_file, is_folder
from cvtgs.io.locks import hidden_path, lock_path, output_lock
from cvtgs.io.ply import PlyRows, open_rows
from cvtgs.io.tensors import map_tensors, save_tensors
from cvtgs.mergenet import Checkpoint, Net, encode_checkpoint, load_checkpoint
from cvtgs.outofcore.memory import CELL_ROOM, joint_cells, step_bytes, warn_of_full_disk
from cvtgs.outofcore.scan import SAMPLE_ROWS, SceneScan, read_scan, write_scan
from cvtgs.processes import Workers

SENT_BYTES = "sent_bytes"  # entry of the label file of a block: bytes of the file of its sent rows


FILES_VERSION = 11
"""Number of the layout of these files: raise it with every change, so that no run continues with
files of another layout."""

Step = Literal[
    "contributions",  # the contributions of the rows of a block to images of the scene
    "sample",  # the curve order of a block, and the points that Lloyd samples
    "sites",  # the sites of a block after some iterations of Lloyd
    "sums",  # the sums of the points of a block per own and remote site
    "parts",  # the cell of every row, and the moments of the parts of cells
    "groups",  # the group of every cell of a block, and the block's groups
    "labels",  # the own group of every row, and the row counts sent to blocks
    "merged",  # the merged Gaussians of a block
    "inflated",  # the merged Gaussians after inflation, and the neighbours of each
]
"""First word of the name of a tensor file, which one step writes and later ones read."""


class Manifest(Record):
    """Record written once all rows are sorted into blocks; from then on the job can be resumed."""

    grouped: int  # Gaussians that the filter leaves to group
    total: int  # Gaussians that all blocks keep together
    cells: tuple[int, ...]  # of the tessellation in each block; their sum is at least ``total``
    left_out_mass: float  # of the Gaussians that the filter leaves out


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Description of the whole job, small enough to be sent to every process."""

    folder: str  # of the files that blocks exchange; every process must have access
    source: PlyRows
    target: int  # Gaussians to keep, including those in boxes
    blocks: int
    boxes: tuple[Box, ...]  # protected regions
    config: SimplifyConfig
    has_network: bool  # whether the folder holds a checkpoint
    range_rows: int  # rows of the file that one process reads in one call
    sample_rows: int = SAMPLE_ROWS  # size of the sample from which the blocks are laid out
    cell_room: int = CELL_ROOM  # cells that may merge together in one process
    axes: str = SCENE_AXES  # directions of x, y and z in the output
    cameras: Cameras | None = None  # for presets that render the scene; None generates views

    def path(self, name: str, *numbers: int | None, suffix: str = "") -> Path:
        """Return the path of a file of the job, by its name and numbers such as that of a block."""
        parts = [name, *(f"{number:05d}" for number in numbers if number is not None)]
        return Path(self.folder) / ("_".join(parts) + suffix)

    def has(self, step: Step, block: int, iteration: int | None = None) -> bool:
        """Return whether a step is done for a block; Lloyd writes a file per iteration."""
        return self.path(step, block, iteration).exists()

    def read(self, step: Step, block: int, iteration: int | None = None) -> dict[str, Tensor]:
        """Map the tensors that a step wrote for a block."""
        return map_tensors(self.path(step, block, iteration))[0]

    def write(
        self,
        step: Step,
        block: int,
        tensors: Mapping[str, Tensor],
        iteration: int | None = None,
        *,
        facts: Mapping[str, str] | None = None,
    ) -> None:
        """Write the tensors of a step for a block."""
        save_tensors(self.path(step, block, iteration), tensors, facts or {})

    def write_file(self, name: str, content: bytes) -> None:
        """Write a file of the job, completely or not at all."""
        write_atomically(self.path(name), content, overwrite=True)

    @property
    def file_bytes(self) -> int:
        """Estimate of the bytes of all files of the job, when they take most, and of the output."""
        cells = joint_cells(self.target, self.source.count, self.cell_room, self.config.allocation)
        return step_bytes(self.source, cells=cells, kept=self.target)

    @property
    def views_path(self) -> Path:
        """The file of the cameras that all blocks share, and of the sample of the scene."""
        return self.path("views.safetensors")

    def small_path(self, block: int) -> Path:
        """Return the file of a simplified block."""
        return self.path("small", block, suffix=".ply")

    def finished_path(self, block: int) -> Path:
        """Return the final file of a block, which images may have improved."""
        return self.path("improved" if self.uses_images else "small", block, suffix=".ply")

    @property
    def uses_images(self) -> bool:
        """Whether blocks are matched to images of the scene, or refined."""
        config = self.config
        return (config.uses_renders and config.match.enabled) or config.refine.enabled

    @property
    def goes_by_steps(self) -> bool:
        """Whether each step runs for all blocks before the next; else there is only one step."""
        return self.blocks > 1 or self.config.uses_images

    def report_path(self, block: int) -> Path:
        """Return the file with the report of a finished block."""
        return self.path("small", block, suffix=".json")

    def ranges(self) -> list[range]:
        """Return the rows of the source that one process reads in one call."""
        rows, step = range(self.source.count), self.range_rows
        return [rows[start : start + step] for start in rows[::step]]

    @property
    def cells(self) -> tuple[int, ...]:
        """Number of cells of the tessellation in each block, before Lloyd moves some to others."""
        return self.read_manifest().cells

    @property
    def targets(self) -> tuple[int, ...]:
        """Number of Gaussians that each block keeps; known once the groups are."""
        if not self.goes_by_steps:
            return (self.read_manifest().total,)
        return tuple(json.loads(self.path("targets.json").read_bytes()))

    def blocks_with_sites(self) -> list[int]:
        """Return the blocks in which the tessellation has sites."""
        return [block for block, count in enumerate(self.cells) if count]

    def blocks_with_cells(self) -> list[int]:
        """Return the blocks that keep at least one Gaussian."""
        return [block for block, target in enumerate(self.targets) if target]

    def blocks_with_rows(self) -> list[int]:
        """Return the blocks with rows; the weight of some may be too small for a cell."""
        starts = [rows.start for rows in self.ranges()]
        return [
            block
            for block, count in enumerate(self.cells)
            if count or any(self.path("rows", block, start).exists() for start in starts)
        ]

    def read_network(self, dtype: torch.dtype) -> Net | None:
        """Read the network of the job, if it has one."""
        if not self.has_network:
            return None
        return load_checkpoint(self.path("network.safetensors")).net.to(dtype)

    def read_scan(self) -> SceneScan:
        """Read the data of the whole scene that all blocks need."""
        return read_scan(self.path("scan.safetensors"))

    def write_scan(self, scan: SceneScan) -> None:
        """Write the scan to the folder of the job."""
        write_scan(scan, self.path("scan.safetensors"))

    def key(self, checkpoint: Checkpoint | None) -> str:
        """Return a digest of everything the result depends on: file, options, network, versions."""
        path, cameras, views = Path(self.source.path), self.cameras, None
        stat = path.stat()
        if cameras is not None:
            views = [cameras.viewmats.tolist(), cameras.Ks.tolist(), cameras.width, cameras.height]
            views += [cameras.strides, cameras.ignores_tag]
        with path.open("rb") as file:
            header = file.read(self.source.offset)
        inputs = {
            "file": [str(path.resolve()), stat.st_size, stat.st_mtime_ns],
            "header": hashlib.sha256(header).hexdigest(),
            "target": self.target,
            "blocks": self.blocks,
            "ranges": self.range_rows,
            "sample": self.sample_rows,
            "cell_room": self.cell_room,
            "axes": [self.source.axes, self.axes],
            "sh_degree": self.source.sh_degree,
            "boxes": [box.model_dump() for box in self.boxes],
            "cameras": views,
            "config": self.config.model_dump(),
            "network": checkpoint and checkpoint.digest,
            "versions": [cvtgs.__version__, torch.__version__, FILES_VERSION],
        }
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()

    def can_resume(self) -> bool:
        """Return whether the folder holds all sorted rows; remove damaged files of later steps."""
        try:
            self.read_scan()
            if self.config.uses_images:
                map_tensors(self.views_path)
            self.read_manifest()
        except (OSError, ValueError, KeyError, TypeError):
            return False
        if not self.has_sorted_rows():
            return False
        self._remove_damaged()
        return True

    def has_sorted_rows(self) -> bool:
        """Return whether the files of sorted rows still exist and are intact."""
        try:
            text = self.path("sorted.json").read_text(encoding="utf-8")
            return all(self._is_whole(name, *facts) for name, facts in json.loads(text).items())
        except (OSError, ValueError, TypeError, AttributeError):
            return False

    def remove(self) -> None:
        """Remove the folder of a finished job; if interrupted, nothing is left to continue with."""
        self.path("sorted.json").unlink(missing_ok=True)
        shutil.rmtree(Path(self.folder).parent, ignore_errors=True)

    def read_manifest(self) -> Manifest:
        """Read the manifest."""
        return Manifest.model_validate_json(self.path("manifest.json").read_bytes())

    def _is_whole(self, name: str, size: int, checksum: int) -> bool:
        """Return whether a file of rows still has its original size and checksum."""
        with self.path(name).open("rb") as file:
            if os.fstat(file.fileno()).st_size != size:
                return False
            found = 0
            while part := file.read(1 << 20):
                found = zlib.crc32(part, found)
        return found == checksum

    def _remove_damaged(self) -> None:
        """Remove damaged files of steps, so that these steps run again."""
        for step in get_args(Step):
            for path in self.path("").glob(f"{step}_*"):
                try:
                    facts = map_tensors(path)[1]  # Windows does not remove mapped files
                    whole = True
                    if SENT_BYTES in facts:
                        block = int(path.name.removeprefix("labels_"))
                        whole = self.path("sent", block).stat().st_size == int(facts[SENT_BYTES])
                except (CvtgsError, OSError):
                    whole = False
                if not whole:
                    path.unlink(missing_ok=True)
        try:
            blocks = self.blocks_with_cells()
        except (OSError, ValueError, TypeError):  # blocks cannot be checked without it
            for pattern in ("targets.json", "small_*", "improved_*"):
                for path in self.path("").glob(pattern):
                    path.unlink()
            return
        for block in blocks:
            whole = True
            # The report of a small block that is made again would lack what its images changed.
            for name in (self.small_path(block), self.finished_path(block)):
                try:
                    json.loads(self.report_path(block).read_bytes())
                    whole = whole and open_rows(name).count == self.targets[block]
                except (CvtgsError, OSError, ValueError):
                    whole = False
                if not whole:
                    name.unlink(missing_ok=True)


AnyJob = TypeVar("AnyJob", bound=Job)

SIZES = ("blocks", "sample_rows", "cell_room")  # attributes of a job that its memory decides


@contextmanager
def started(
    job: Job, workers: Workers, clock: StageClock, checkpoint: Checkpoint | None, *, resumes: bool
) -> Iterator[None]:
    """Make the folder of a job, unless it resumes; check the workers, and write the network.

    The body sorts the rows; if it fails or the source changes meanwhile, the folder is removed.
    """
    before = _stamp(job.source.path)
    try:
        if not resumes:
            _make_empty(Path(job.folder))
            sizes = {name: getattr(job, name) for name in SIZES}
            job.write_file("sizes.json", json.dumps(sizes).encode())
            warn_of_full_disk(job.folder, job.file_bytes)
        check: Callable[[Job], object] | None = getattr(workers, "check", None)
        if check is not None:  # workers on other machines
            with clock.stage("workers"):
                check(job)
        if checkpoint is not None:  # a resumed job may find it damaged
            content = encode_checkpoint(checkpoint.net, checkpoint.info)
            job.write_file("network.safetensors", content)
        yield
        if not resumes and _stamp(job.source.path) != before:
            raise InputError(
                f"{job.source.path}: must stay as it is while it is read, found it changed; start "
                "again."
            )
    except BaseException:
        if not resumes:
            shutil.rmtree(Path(job.folder).parent, ignore_errors=True)
        raise


def _make_empty(folder: Path) -> None:
    """Make an empty folder; remove files that earlier jobs of this output left."""
    shutil.rmtree(folder.parent, ignore_errors=True)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise OutputError(
            f"{folder.parent}: must be replaceable by an empty folder for block files, "
            f"found: {reason_of(error)}."
        ) from error


def _stamp(path: str) -> tuple[int, int] | None:
    """Return size and time of a file; None if it does not exist any more."""
    try:
        stat = Path(path).stat()
    except OSError:
        return None
    return stat.st_size, stat.st_mtime_ns


def in_folder(
    job: AnyJob, output: str | os.PathLike[str], checkpoint: Checkpoint | None, *, adapts: bool
) -> AnyJob:
    """Return a job with its folder, which is named by its key: late workers use that of their job.

    One that adapts gets the sizes of an interrupted run of it, unless that needs more memory.
    """
    parent = hidden_path(output, "blocks")
    for path in parent.glob("*/sizes.json") if adapts else ():
        try:
            found = json.loads(path.read_bytes())
            sizes: dict[str, Any] = {name: int(found[name]) for name in SIZES}
            earlier = replace(job, **sizes)
        except (OSError, ValueError, KeyError, TypeError):
            continue
        fits = earlier.blocks >= job.blocks and earlier.sample_rows <= job.sample_rows
        fits = fits and earlier.cell_room <= job.cell_room
        if fits and earlier.key(checkpoint)[:16] == path.parent.name:
            job = earlier
            break
    return replace(job, folder=str(parent / job.key(checkpoint)[:16]))


def can_continue(output: str | os.PathLike[str]) -> bool:
    """Return whether an interrupted run of an output has rows to continue with."""
    return any(hidden_path(output, "blocks").glob("*/sorted.json"))


def remove_job_files(output: str | os.PathLike[str], *, is_stream: bool = False) -> None:
    """Remove the files that interrupted runs of an output left, unless another run uses them."""
    folder = hidden_path(output, "blocks")
    locked = folder if is_stream else output  # commands lock the output of a stream
    if is_folder(folder) or is_file(lock_path(locked)):
        with suppress(OutputError), output_lock(locked):
            shutil.rmtree(folder, ignore_errors=True)
