"""The job: everything that a process needs to work on a block, in a folder beside the output."""

import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import torch

import cvtgs
from cvtgs.analysis import EffectPlan
from cvtgs.boxes import Box
from cvtgs.config import SimplifyConfig
from cvtgs.errors import FileFormatError, InputNotFoundError
from cvtgs.io import atomic_output
from cvtgs.io.ply import PlyRows
from cvtgs.io.tensors import map_tensors, save_tensors
from cvtgs.math.frames import RobustFrame
from cvtgs.mergenet import Checkpoint, load_checkpoint, save_checkpoint
from cvtgs.outofcore.cuts import Cuts
from cvtgs.outofcore.survey import Survey

_NUMBERS = ("faintest", "lightest", "unit", "floor", "step", "power", "mass", "rows", "kept")


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What is to be done, small enough to be sent to every process.

    Attributes:
        folder: Where blocks lie; every process must see it.
        source: The file.
        target: Number of Gaussians to keep, those in boxes among them.
        blocks: Number of blocks.
        boxes: What is protected.
        config: Every choice.
        has_network: Whether a checkpoint lies in the folder.
        range_rows: Rows of the file that one process looks at in one go.
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

    def rows_path(self, block: int, part: int) -> Path:
        """Return the file with the rows of a block that were found in one part of the source."""
        return self.path(f"rows_{block:05d}_{part:05d}")

    def kept_path(self, part: int) -> Path:
        """Return the file with the protected rows of one part of the source."""
        return self.path(f"kept_{part:05d}")

    def small_path(self, block: int) -> Path:
        """Return the file of a block that is done."""
        return self.path(f"small_{block:05d}.ply")

    def facts_path(self, block: int) -> Path:
        """Return the file that says what was done to a block."""
        return self.path(f"small_{block:05d}.json")

    def sample_path(self, block: int) -> Path:
        """Return the file with the Gaussians of a block that Lloyd looks at."""
        return self.path(f"sample_{block:05d}")

    def sites_path(self, turn: int, block: int) -> Path:
        """Return the file with the sites of a block after some moves."""
        return self.path(f"sites_{turn:02d}_{block:05d}")

    def sums_path(self, turn: int, block: int) -> Path:
        """Return the file with what the Gaussians of a block add to sites, its own and others."""
        return self.path(f"sums_{turn:02d}_{block:05d}")

    def labels_path(self, block: int) -> Path:
        """Return the file with the cell of every Gaussian of a block, and how many went where."""
        return self.path(f"labels_{block:05d}")

    def sent_path(self, block: int) -> Path:
        """Return the file with the rows of a block that went into cells of others."""
        return self.path(f"sent_{block:05d}")

    def merged_path(self, block: int) -> Path:
        """Return the file with the merged Gaussians of a block."""
        return self.path(f"merged_{block:05d}")

    def wide_path(self, block: int) -> Path:
        """Return the file with the same ones widened, and with the neighbours of each."""
        return self.path(f"wide_{block:05d}")

    def busy(self) -> list[int]:
        """Return the blocks that keep something."""
        return [block for block, target in enumerate(self.read_survey()[1]) if target]

    def filled(self) -> list[int]:
        """Return the blocks that have rows; some may be too light to keep anything."""
        numbers = [number for number, _, _ in self.ranges()]
        return [
            block
            for block, target in enumerate(self.read_survey()[1])
            if target or any(self.rows_path(block, number).exists() for number in numbers)
        ]

    def ranges(self) -> list[tuple[int, int, int]]:
        """Return the parts of the source: number, first row, row after the last one."""
        total, step = self.source.count, self.range_rows
        starts = range(0, total, step)
        return [(k, start, min(start + step, total)) for k, start in enumerate(starts)]

    @property
    def network(self) -> Checkpoint | None:
        """The network of the job."""
        return load_checkpoint(self.path("network.safetensors")) if self.has_network else None

    def write_network(self, checkpoint: Checkpoint) -> None:
        """Put the network where every process finds it."""
        with atomic_output(self.path("network.safetensors"), overwrite=True) as file:
            file.write(save_checkpoint(checkpoint.net, checkpoint.info))

    def write_survey(self, survey: Survey, targets: list[int]) -> None:
        """Put the survey, and what each block is to keep, where every process finds it."""
        cuts = survey.cuts
        numbers = {name: getattr(survey, name) for name in _NUMBERS}
        numbers |= {"radius": survey.frame.radius, "targets": targets}
        tensors = {
            "center": survey.frame.center,
            "light": survey.light,
            "axes": cuts.axes,
            "places": cuts.places,
            "children": cuts.children,
        }
        described = {"plan": survey.plan.model_dump_json(), "numbers": json.dumps(numbers)}
        save_tensors(self.path("survey.safetensors"), tensors, described)

    def read_survey(self) -> tuple[Survey, list[int]]:
        """Return the survey, and what each block is to keep."""
        tensors, described = map_tensors(self.path("survey.safetensors"))
        numbers: dict[str, Any] = json.loads(described["numbers"])
        names = ("axes", "places", "children")
        cuts = Cuts(**{name: tensors[name] for name in names}, count=self.blocks)
        radius, targets = numbers.pop("radius"), numbers.pop("targets")
        found = Survey(
            frame=RobustFrame(center=tensors["center"], radius=radius),
            plan=EffectPlan.model_validate_json(described["plan"]),
            light=tensors["light"],
            cuts=cuts,
            **numbers,
        )
        return found, targets

    def key(self, checkpoint: Checkpoint | None) -> str:
        """Name everything that the result depends on: file, choices, network, version."""
        path = Path(self.source.path)
        stat = path.stat()
        with path.open("rb") as file:
            header = file.read(self.source.offset)
        said = {
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
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def is_cut(self, key: str) -> bool:
        """Return whether the folder holds all blocks of just this job."""
        try:
            manifest = json.loads(self.path("manifest.json").read_text(encoding="utf-8"))
            self.read_survey()
        except (OSError, ValueError, KeyError, TypeError, InputNotFoundError, FileFormatError):
            return False
        return isinstance(manifest, dict) and manifest.get("key") == key

    def start_over(self) -> None:
        """Make an empty folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        Path(self.folder).mkdir()

    def declare_cut(self, key: str) -> None:
        """Report that all blocks are there: from now on the job can be resumed."""
        source = asdict(self.source) | {"names": [], "layout": []}
        text = json.dumps({"key": key, "blocks": self.blocks, "source": source}, indent=2)
        with atomic_output(self.path("manifest.json"), overwrite=True) as file:
            file.write(text.encode())

    @classmethod
    def beside(cls, output: str | os.PathLike[str], **values: Any) -> Self:
        """Return the job of an output; its folder lies beside it and is hidden."""
        target = Path(os.path.realpath(output))
        return cls(folder=str(target.with_name(f".{target.name}.blocks")), **values)
