"""Streams of files that need not fit into memory, written as one part per block of space."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis import drop_unused_bands
from cvtgs.analysis.analyze import apparent_areas, visibility_at
from cvtgs.analysis.effects import restore_comments, select_columns
from cvtgs.checks import checked
from cvtgs.clock import StageClock
from cvtgs.counts import checked_whole, shared_out, target_count, written_ratios
from cvtgs.devices import HOST, full_precision, on_host, one_thread
from cvtgs.errors import InvalidArgumentError, check_path
from cvtgs.filters import filter_rows
from cvtgs.grouping import allocate, order_rows, tessellate_rows, weigh_rows
from cvtgs.io import change_axes
from cvtgs.io.atomic import make_folder
from cvtgs.io.axes import SCENE_AXES, checked_axes
from cvtgs.io.locks import output_lock
from cvtgs.io.ply import open_rows
from cvtgs.mergenet import Checkpoint
from cvtgs.outofcore import Workers
from cvtgs.outofcore.folders import in_folder, started
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import (
    check_memory,
    chosen_blocks,
    memory_to_plan,
    merging_in_levels,
    sample_rows,
    stream_bytes,
)
from cvtgs.outofcore.rows import BlockRows, analysis_of, read_rows
from cvtgs.outofcore.run import check_config, rows_per_range
from cvtgs.outofcore.scan import read_sample
from cvtgs.outofcore.sort import sort_into_blocks
from cvtgs.pipeline import level_facts, reduce_scene
from cvtgs.processes import with_progress
from cvtgs.progress import ProgressListener, silent
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.streams.files import (
    StreamFormat,
    StreamLevel,
    StreamPart,
    check_stream,
    join_levels,
    publish,
)
from cvtgs.streams.plan import CHUNK_GAUSSIANS, check_environment, near_rows, plan_part
from cvtgs.streams.sog import SogFormat
from cvtgs.streams.tiles import TilesFormat, check_no_environment, check_transform
from cvtgs.text import counted, shown
from cvtgs.validity import warn_of_dropped

SAMPLED = 1 << 15  # size of the sample that gives shares; fewer than twice as many rows are read

PRIOR_CELLS = 4.0  # added to the cells found and expected in a block, so that few mean little
POWER = 0.75  # of the factors on weights; below 1, since cells of blocks end at their borders


class StreamReport(NamedTuple):
    """Counts of a written stream: of each level, the finest first, and of chunks and blocks.

    Attributes:
        resumed_blocks: Number of blocks that an earlier run had finished.
    """

    levels: tuple[StreamLevel, ...]
    chunks: int
    blocks: int
    resumed_blocks: int


class BlockLevel(NamedTuple):
    """A level of a block; see :class:`cvtgs.report.Level`."""

    scene: GaussianScene
    geometric_error: float
    assignment: Int[Tensor, "n"] | None = None
    error_sums: Float[Tensor, "2 m"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamJob(Job):
    """Description of the whole job of a stream; its blocks are written as parts."""

    form: StreamFormat
    level_counts: tuple[int, ...]  # Gaussians to keep at each level, the finest first
    chunk_gaussians: int  # of the finest level in a chunk
    file_axes: tuple[str, str]  # of the input file and of the output
    sh_degree: int | None  # the highest to keep; None keeps all
    environment_radii: float | None  # beyond these, Gaussians are the environment; None for none

    def key(self, checkpoint: Checkpoint | None) -> str:
        """Return a digest of everything the result depends on."""
        options = (self.form, self.chunk_gaussians, self.file_axes, self.sh_degree)
        choices = repr((*options, self.environment_radii))
        facts = [Job.key(self, checkpoint), self.level_counts, choices]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    @property
    def file_bytes(self) -> int:
        """Estimate of the bytes of all files of the job."""
        return stream_bytes(self.source, sum(self.level_counts))

    @property
    def output(self) -> Path:
        """Folder that holds the files of the stream until all are written."""
        return self.path("stream")

    def part_path(self, block: int) -> Path:
        """Return the path of the JSON file with the :class:`StreamPart` of a block."""
        return self.path("part", block, suffix=".json")

    def read_part(self, block: int) -> StreamPart:
        """Read the written part of a block."""
        return StreamPart.model_validate_json(self.part_path(block).read_bytes())

    def has_part(self, block: int) -> bool:
        """Return whether a part is written, and all its files are complete."""
        try:
            part = self.read_part(block)
            paths = [self.output / name for name in part.names]
            if self.form.kind == "sog":  # each is a folder of files
                paths = [file for path in paths for file in path.parent.iterdir()]
            size = sum(path.stat().st_size for path in paths)
            has_far = all((self.output / name).exists() for name in part.environments.values())
        except (OSError, ValueError):
            return False
        return has_far and size == sum(level.bytes for level in part.levels)

    def block_counts(self) -> list[list[int]]:
        """Return the number of Gaussians of each block at each level, the finest first."""
        found: list[list[int]] = json.loads(self.path("targets.json").read_bytes())["targets"]
        return found

    def can_resume(self) -> bool:
        """Return whether the folder holds all sorted rows, their scan, and the targets."""
        try:
            self.read_scan()
            self.block_counts()
        except (OSError, ValueError, KeyError, TypeError):
            return False
        return self.has_sorted_rows()


@on_host()
@checked
def stream_file(  # noqa: PLR0913 (options by name)
    source: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    rhos: Sequence[float],
    *,
    kind: str,
    memory: int | None = None,
    blocks: int | None = None,
    chunk_gaussians: int = CHUNK_GAUSSIANS,
    environment_radii: float | None = None,
    transform: tuple[float, ...] | None = None,
    axes: tuple[str, str] = (SCENE_AXES, SCENE_AXES),
    sh_degree: int | None = None,
    simplifier: Simplifier | None = None,
    workers: Workers | None = None,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> StreamReport:
    """Write a file that need not fit into memory as a stream of levels.

    The file is sorted into blocks of space, which are stored in a hidden folder beside the output.
    Each block is simplified to its exact share of every level, based on the analysis of the whole
    scene, and written as a part of the stream. Shares follow the cells of a sample of the whole
    scene. After an interruption, the same call continues with the unfinished blocks. The result
    depends on the number of blocks, not on the workers.

    Args:
        source: A binary PLY file.
        folder: Folder to write to; created if it is missing. All files are written, or none.
        rhos: Ratios of the levels, in (0, 1].
        kind: ``sog`` or ``3dtiles``.
        memory: Bytes that one process may use; None for all free memory.
        blocks: Number of blocks, instead of ``memory``.
        chunk_gaussians: Maximum number of Gaussians of the finest level in a chunk.
        environment_radii: Gaussians farther from the centre than this, in robust radii, are the
            environment of a streamed SOG, which all levels share; None for no environment.
        transform: Root transform of 3D Tiles (:func:`cvtgs.streams.geo_transform`).
        axes: Axes of the input file and of the output; those of 3D Tiles are fixed, so their
            output must be ``rdf``.
        sh_degree: Highest SH degree to keep; None keeps all.
        simplifier: Configuration and network, not its listener; None for the defaults.
        workers: Call functions for ranges of the file and for blocks; None calls them one after
            the other in this process.
        overwrite: Whether files of an earlier stream may be replaced.
        listener: Called with progress events.

    Returns:
        The report.

    Raises:
        ConfigError: The configuration renders images, which needs the whole scene in memory.
        InvalidArgumentError: A ratio is out of range, two ratios give the same size, chunks would
            be empty, the kind does not have an option, or an argument is out of range or of another
            type.
        InvalidSceneError: No row is valid.
        FileFormatError: The file cannot be read in parts.
        OutputExistsError: The folder holds files that may not be replaced.
        OutputBusyError: Another run is writing this output.

    Example:
        >>> import tempfile
        >>> from cvtgs import load, save, synthetic
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file, out = Path(folder) / "scene.ply", Path(folder) / "out"
        ...     save(synthetic.scene("object", 2000, sh_degree=0), file)
        ...     report = stream_file(file, out, [1.0, 0.1], kind="sog", blocks=3)
        ...     [len(load(out, lod=lod)) for lod in (0, 1)], report.blocks
        ([2000, 200], 3)
    """
    check_path(source)
    check_path(folder)
    check_environment(environment_radii)
    form = _format(kind, axes=axes, environment_radii=environment_radii, transform=transform)
    simplifier, workers = simplifier or Simplifier(device="cpu"), workers or map
    check_config(simplifier.config, with_images=False)
    check_memory(memory, with_images=False)
    if sh_degree is not None:
        checked_whole(sh_degree, "sh_degree", least=0, most=3)
    rows = open_rows(source)
    ratios = written_ratios(rhos)
    targets = sorted({target_count(rows.count, rho) for rho in ratios}, reverse=True)
    checked_whole(chunk_gaussians, "chunk_gaussians")
    if len(targets) < len(ratios) or not targets:
        raise InvalidArgumentError(
            f"a stream needs levels of different sizes, found ratios {ratios} of "
            f"{counted(rows.count, 'Gaussian')}; other ratios help a small scene."
        )
    merged = [target for target in targets if target < rows.count] or targets
    room = memory or memory_to_plan()
    merging = merging_in_levels(targets, rows, simplifier.config.allocation)
    job = StreamJob(
        folder="",
        source=rows,
        target=merged[0],
        blocks=chosen_blocks(rows, room, wanted=blocks, most=targets[-1], merging=merging),
        boxes=(),
        config=simplifier.config,
        has_network=simplifier.checkpoint is not None,
        range_rows=rows_per_range(rows.count),
        sample_rows=sample_rows(room, rows),
        form=form,
        level_counts=tuple(targets),
        chunk_gaussians=chunk_gaussians,
        file_axes=axes,
        sh_degree=sh_degree,
        environment_radii=environment_radii,
    )
    job = in_folder(job, folder, simplifier.checkpoint, adapts=blocks is None)
    check_stream(folder, kind, overwrite=overwrite)
    lock = output_lock(Path(job.folder).parent)  # commands lock the output folder
    with lock, full_precision():
        parts, resumed = _run(job, simplifier.checkpoint, workers, StageClock(listener, HOST))
        publish(form, parts, job.output, Path(folder), overwrite=overwrite)
        job.remove()
    chunks = sum(part.chunks for part in parts)
    return StreamReport(join_levels(parts), chunks, len(parts), resumed)


def _format(
    kind: str,
    *,
    axes: tuple[str, str],
    environment_radii: float | None,
    transform: tuple[float, ...] | None,
) -> StreamFormat:
    """Return the format of a stream; refuse options that it does not have."""
    if not isinstance(axes, tuple | list) or len(axes) != 2:
        raise InvalidArgumentError(
            f"axes must be those of the input file and those of the output, found {shown(axes)}."
        )
    for name in axes:
        checked_axes(name)
    if kind != "3dtiles":
        if transform is not None:
            raise InvalidArgumentError("only 3D Tiles have a transform, found one for a SOG.")
        return SogFormat()
    if axes[1] != SCENE_AXES:
        raise InvalidArgumentError(
            f"3D Tiles have axes of their own (z up), so the axes of the output must be "
            f"{SCENE_AXES}, found {axes[1]!r}."
        )
    check_no_environment(environment_radii is not None)
    return TilesFormat(transform=check_transform(transform))


def _run(
    job: StreamJob, checkpoint: Checkpoint | None, workers: Workers, clock: StageClock
) -> tuple[list[StreamPart], int]:
    """Sort the file and write the missing parts; return all parts and the number resumed."""
    resumes = job.can_resume()
    with started(job, workers, clock, checkpoint, resumes=resumes):
        if not resumes:
            with one_thread():
                found = sort_into_blocks(job, workers, clock, keep_all=True)
                with clock.stage("allocate"):
                    ratios = [count / sum(found.rows) for count in job.level_counts]
                    shares = _shares(job, ratios, found.cells)
            _write_targets(job, found.rows, shares)
    make_folder(job.output)
    blocks = [block for block, counts in enumerate(job.block_counts()) if counts[0]]
    unfinished = [block for block in blocks if not job.has_part(block)]
    with clock.stage("blocks", len(unfinished)) as advance:
        list(with_progress(workers(partial(write_block, job), unfinished), advance))
    return [job.read_part(block) for block in blocks], len(blocks) - len(unfinished)


def _shares(job: StreamJob, ratios: Sequence[float], weights: Sequence[float]) -> list[list[float]]:
    """Estimate the share of each block in the cells of levels with these ratios, in any unit.

    A sample is grouped as a scene in one piece, so blocks where merging costs more have more cells.
    """
    sample = read_sample(job.source, SAMPLED)
    if job.blocks == 1 or len(sample) == 0:
        return [list(weights) for _ in ratios]
    config = job.config
    sample = select_columns(sample, config.effects)
    if job.sh_degree is not None:
        sample = sample.with_sh_degree(job.sh_degree)
    scan = job.read_scan()
    visibility = visibility_at(scan.visibility, sample.means, scan.frame)
    distances = scan.frame.distances(sample.means)
    areas = apparent_areas(sample.areas, distances, visibility, config=config.cvt)
    analysis = analysis_of(scan, BlockRows(sample, areas, visibility))
    sample = drop_unused_bands(sample, scan.plan)
    blocks = scan.partition.blocks_of(scan.frame.contract(sample.means))
    ordered, known = order_rows(sample, analysis, config), torch.tensor(weights).double()
    found = list[list[float]]()
    for ratio in ratios:
        target = max(1, round(ratio * len(sample)))
        if target >= len(sample):
            found.append(list(weights))
            continue
        rows = filter_rows(sample, analysis, target, config.filter).rows
        points = weigh_rows(sample, rows, analysis, config, ordered=ordered)
        tessellation = tessellate_rows(points, analysis, target, config)
        labels = allocate(points, tessellation, analysis, target, config.allocation)
        parts = 1.0 / torch.bincount(labels, minlength=target).double()[labels]
        counts = torch.bincount(blocks[points.rows], parts, minlength=job.blocks)
        expected = known / known.sum().clamp_min(1e-300) * target
        factors = (counts + PRIOR_CELLS) / (expected + PRIOR_CELLS)
        found.append((known * factors**POWER).tolist())
    return found


def _write_targets(job: StreamJob, rows: Sequence[int], shares: Sequence[Sequence[float]]) -> None:
    """Divide every level among the blocks; blocks with rows get at least one Gaussian."""
    invalid = job.source.count - sum(rows)
    if invalid:
        warn_of_dropped(invalid, job.source.count, job.read_scan().invalid_rows)
    rooms, levels = list(rows), []
    for target, parts in zip(job.level_counts, shares, strict=True):
        least = sum(1 for room in rooms if room)
        rooms = shared_out(max(least, min(target, sum(rooms))), parts, rooms=rooms)
        levels.append(rooms)
    content = json.dumps({"targets": list(zip(*levels, strict=True))})
    job.write_file("targets.json", content.encode())


@one_thread()
def write_block(job: StreamJob, block: int) -> None:
    """Simplify a block to all of its sizes, and write it as a part of the stream."""
    rows = read_rows(job, block)
    net = job.read_network(rows.scene.dtype)
    scene = select_columns(rows.scene, job.config.effects)
    scan = job.read_scan()
    analysis = analysis_of(scan, rows)
    if job.sh_degree is not None:
        scene = scene.with_sh_degree(job.sh_degree)
    levels: list[BlockLevel] = []
    clock = StageClock(silent, scene.device)
    for target in job.block_counts()[block]:
        reduced = reduce_scene(scene, analysis, target, job.config, net=net, clock=clock)
        small = restore_comments(reduced.scene, scene, analysis.plan)
        levels.append(BlockLevel(small, *level_facts(scene, analysis, reduced)))
    near = near_rows(levels[-1].scene, scan.frame, job.environment_radii)
    axes = job.file_axes
    if axes[0] != axes[1]:
        levels = [level._replace(scene=change_axes(level.scene, *axes)) for level in levels]
    plan = plan_part(levels, near, chunk_gaussians=job.chunk_gaussians)
    part = job.form.write_part(plan, job.output, part=block, listener=silent)
    job.write_file(job.part_path(block).name, part.model_dump_json().encode())
