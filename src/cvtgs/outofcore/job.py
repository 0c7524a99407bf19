"""The job of an out-of-core run: all data that a process needs, and the files of its blocks."""

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self, get_args

import torch
from torch import Tensor

import cvtgs
from cvtgs.boxes import Box
from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.errors import CvtgsError
from cvtgs.io.atomic import write_atomically
from cvtgs.io.axes import SCENE_AXES
from cvtgs.io.ply import PlyRows, open_rows
from cvtgs.io.tensors import map_tensors, save_tensors
from cvtgs.mergenet import Checkpoint, Net, load_checkpoint
from cvtgs.outofcore.memory import CELL_ROOM, joint_cells, step_bytes
from cvtgs.outofcore.scan import SAMPLE_ROWS, SceneScan, read_scan, write_scan

SENT_BYTES = "sent_bytes"  # entry of the label file of a block: bytes of the file of its sent rows


FILES_VERSION = 12
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
    "errors",  # the error of images by the Gaussians of a simplified block, and their pixels
    "factors",  # by which these errors scale the masses of the cells of a block
]
"""First word of the name of a tensor file, which one step writes and later ones read."""

REPEATED = ("parts", "groups", "targets", "labels", "sent", "merged", "inflated", "small")
"""First words of the names of files that exist twice if cells are allocated again."""


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
    is_again: bool = False  # whether cells are allocated the second time, by errors of images

    def path(self, name: str, *numbers: int | None, suffix: str = "") -> Path:
        """Return the path of a file of the job, by its name and numbers such as that of a block."""
        again = ["again"] if self.is_again and name in REPEATED else []
        digits = [f"{number:05d}" for number in numbers if number is not None]
        parts = [name, *again, *digits]
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
        return step_bytes(
            self.source,
            cells=cells,
            kept=self.target,
            blocks=self.blocks,
            with_images=self.config.uses_images,
            views=self.config.visibility.views if self.allocates_again else 0,
        )

    @property
    def targets_path(self) -> Path:
        """The file of the number of Gaussians that each block keeps."""
        return self.path("targets", suffix=".json")

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
    def allocates_again(self) -> bool:
        """Whether cells are allocated a second time, by the errors of images of given cameras."""
        is_given = self.config.uses_renders and self.cameras is not None
        return is_given and self.config.match.error_power > 0.0

    @property
    def first(self) -> Self:
        """The job as its cells are allocated the first time."""
        return replace(self, is_again=False)

    @property
    def last(self) -> Self:
        """The job as its cells are allocated the last time."""
        return replace(self, is_again=self.allocates_again)

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
        return tuple(json.loads(self.targets_path.read_bytes()))

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
                        sent = path.with_name(path.name.replace("labels", "sent"))
                        whole = sent.stat().st_size == int(facts[SENT_BYTES])
                except (CvtgsError, OSError):
                    whole = False
                if not whole:
                    path.unlink(missing_ok=True)
        for job in [self.first, self.last] if self.allocates_again else [self]:
            job._remove_damaged_blocks()

    def _remove_damaged_blocks(self) -> None:
        try:
            blocks = self.blocks_with_cells()
        except (OSError, ValueError, TypeError):  # blocks cannot be checked without it
            paths = [self.targets_path]
            paths += [self.small_path(block) for block in range(self.blocks)]
            paths += [self.finished_path(block) for block in range(self.blocks)]
            for path in paths:
                path.unlink(missing_ok=True)
            return
        is_last = self.is_again == self.allocates_again
        for block in blocks:
            whole = True
            # The report of a small block that is made again would lack what its images changed.
            for name in (self.small_path(block), *([self.finished_path(block)] if is_last else [])):
                try:
                    json.loads(self.report_path(block).read_bytes())
                    whole = whole and open_rows(name).count == self.targets[block]
                except (CvtgsError, OSError, ValueError):
                    whole = False
                if not whole:
                    name.unlink(missing_ok=True)
