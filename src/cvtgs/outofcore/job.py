"""The job of an out-of-core run: all that a process needs, and where the files of blocks lie."""

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import pydantic
import torch

import cvtgs
from cvtgs.boxes import Box
from cvtgs.config import SimplifyConfig
from cvtgs.io import atomic_output
from cvtgs.io.ply import PlyRows
from cvtgs.mergenet import Checkpoint, load_checkpoint, save_checkpoint
from cvtgs.outofcore.scan import RowRange, SceneScan, read_scan, write_scan


class Manifest(pydantic.BaseModel):
    """What is written once all rows are sorted into blocks; from then on a job can be resumed.

    Attributes:
        key: Digest of all that the result depends on.
        source: Path of the source.
        targets: Number of Gaussians that each block keeps.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    key: str
    source: str
    targets: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What is to be done, small enough to be sent to every process.

    Attributes:
        folder: Folder of the files that blocks exchange; every process must see it.
        source: The file.
        target: Number of Gaussians to keep, those in boxes among them.
        blocks: Number of blocks.
        boxes: Protected regions.
        config: Every choice.
        has_network: Whether the folder holds a checkpoint.
        range_rows: Rows of the file that one process reads in one call.
    """

    folder: str
    source: PlyRows
    target: int
    blocks: int
    boxes: tuple[Box, ...]
    config: SimplifyConfig
    has_network: bool
    range_rows: int

    def path(self, name: str) -> Path:
        """Return the path of a file of the job."""
        return Path(self.folder) / name

    def rows_path(self, block: int, number: int) -> Path:
        """Return the file with the rows of a block that come from one range of the source."""
        return self.path(f"rows_{block:05d}_{number:05d}")

    def kept_path(self, number: int) -> Path:
        """Return the file with the protected rows of one range of the source."""
        return self.path(f"kept_{number:05d}")

    def sample_path(self, block: int) -> Path:
        """Return the file with the curve order of a block, and the points that Lloyd samples."""
        return self.path(f"sample_{block:05d}")

    def sites_path(self, iteration: int, block: int) -> Path:
        """Return the file with the sites of a block after some iterations of Lloyd."""
        return self.path(f"sites_{iteration:02d}_{block:05d}")

    def sums_path(self, iteration: int, block: int) -> Path:
        """Return the file with the sums of the points of a block by site, own and remote."""
        return self.path(f"sums_{iteration:02d}_{block:05d}")

    def labels_path(self, block: int) -> Path:
        """Return the file with the own cell of every row, and how many rows go to other blocks."""
        return self.path(f"labels_{block:05d}")

    def sent_path(self, block: int) -> Path:
        """Return the file with the rows of a block that belong to remote cells."""
        return self.path(f"sent_{block:05d}")

    def merged_path(self, block: int) -> Path:
        """Return the file with the merged Gaussians of a block."""
        return self.path(f"merged_{block:05d}")

    def inflated_path(self, block: int) -> Path:
        """Return the file with the same Gaussians inflated, and with the neighbours of each."""
        return self.path(f"inflated_{block:05d}")

    def small_path(self, block: int) -> Path:
        """Return the file of a finished block."""
        return self.path(f"small_{block:05d}.ply")

    def report_path(self, block: int) -> Path:
        """Return the file with the report of a finished block."""
        return self.path(f"small_{block:05d}.json")

    def ranges(self) -> list[RowRange]:
        """Return the ranges of the source."""
        total, step = self.source.count, self.range_rows
        starts = range(0, total, step)
        return [RowRange(k, start, min(start + step, total)) for k, start in enumerate(starts)]

    @property
    def targets(self) -> tuple[int, ...]:
        """Number of Gaussians that each block keeps."""
        return self._manifest().targets

    def blocks_with_cells(self) -> list[int]:
        """Return the blocks that keep at least one Gaussian."""
        return [block for block, target in enumerate(self.targets) if target]

    def blocks_with_rows(self) -> list[int]:
        """Return the blocks that have rows; some may weigh too little to have cells."""
        numbers = [rows.number for rows in self.ranges()]
        return [
            block
            for block, target in enumerate(self.targets)
            if target or any(self.rows_path(block, number).exists() for number in numbers)
        ]

    def read_network(self) -> Checkpoint | None:
        """Read the checkpoint of the job."""
        return load_checkpoint(self.path("network.safetensors")) if self.has_network else None

    def write_network(self, checkpoint: Checkpoint) -> None:
        """Write the checkpoint where every process finds it."""
        with atomic_output(self.path("network.safetensors"), overwrite=True) as file:
            file.write(save_checkpoint(checkpoint.net, checkpoint.info))

    def read_scan(self) -> SceneScan:
        """Read what all blocks need of the whole scene."""
        return read_scan(self.path("scan.safetensors"))

    def write_scan(self, scan: SceneScan) -> None:
        """Write the scan where every process finds it."""
        write_scan(scan, self.path("scan.safetensors"))

    def key(self, checkpoint: Checkpoint | None) -> str:
        """Return a digest of all that the result depends on: file, choices, network, version."""
        path = Path(self.source.path)
        stat = path.stat()
        with path.open("rb") as file:
            header = file.read(self.source.offset)
        inputs = {
            "file": [str(path.resolve()), stat.st_size, stat.st_mtime_ns],
            "header": hashlib.sha256(header).hexdigest(),
            "target": self.target,
            "blocks": self.blocks,
            "ranges": self.range_rows,
            "boxes": [box.model_dump() for box in self.boxes],
            "config": self.config.model_dump(),
            "network": checkpoint and checkpoint.digest,
            "versions": [cvtgs.__version__, torch.__version__],
        }
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()

    def can_resume(self, key: str) -> bool:
        """Return whether the folder holds all rows of just this job, sorted into blocks."""
        try:
            self.read_scan()
            return self._manifest().key == key
        except (OSError, ValueError, KeyError):
            return False

    def start_over(self) -> None:
        """Make an empty folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        Path(self.folder).mkdir()

    def write_manifest(self, key: str, targets: list[int]) -> None:
        """Write that all rows are sorted, and how many Gaussians each block keeps."""
        manifest = Manifest(key=key, source=self.source.path, targets=tuple(targets))
        with atomic_output(self.path("manifest.json"), overwrite=True) as file:
            file.write(manifest.model_dump_json(indent=2).encode())

    def _manifest(self) -> Manifest:
        return Manifest.model_validate_json(self.path("manifest.json").read_bytes())


def job_folder(output: str | os.PathLike[str]) -> str:
    """Return the folder of the job of an output: hidden, beside it."""
    target = Path(os.path.realpath(output))
    return str(target.with_name(f".{target.name}.blocks"))
