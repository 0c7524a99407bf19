"""Levels of a scene on disk, and an index from which viewers choose among them."""

import os
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Self

import torch

from cvtgs.boxes import Corner
from cvtgs.config.base import Record
from cvtgs.counts import target_count, written, written_ratios
from cvtgs.errors import InvalidArgumentError, check_path
from cvtgs.evaluation import Evaluation, SceneScores
from cvtgs.io import check_output, check_save, load, save, scene_size
from cvtgs.io.atomic import make_folder, write_atomically
from cvtgs.io.axes import SCENE_AXES, checked_axes
from cvtgs.io.formats import READABLE_SUFFIXES, WRITABLE_SUFFIXES
from cvtgs.report import Level, check_one_scene
from cvtgs.text import counted, printable_name, shown

__all__ = ["LevelEntry", "LevelsIndex", "write_levels"]

INDEX_NAME = "levels.json"  # name of the index file, in the folder of the levels


class LevelEntry(Record):
    """One level.

    Attributes:
        file: Name of the file, in the folder of the index.
        rho: Ratio of Gaussians that was requested.
        count: Number of Gaussians in the file.
        bytes: Size of the file.
        geometric_error: Root mean square distance from the Gaussians of the full scene to those
            that represent them, weighted by apparent mass; scene units. 0 if all are kept.
        box_min: Smallest coordinates of the centres in the file, in its axes, scene units.
        box_max: Largest coordinates of the centres in the file.
        seconds: Wall-clock seconds in addition to the work shared with finer levels.
        psnr: Mean PSNR of the file against the full scene, dB; None if not measured.
        ssim: Mean SSIM, likewise.
        lpips: Mean LPIPS, likewise.
        alpha_error: Mean absolute difference of accumulated alpha, likewise.
        alpha_bias: Mean signed difference, negative if more of the background shows through.
    """

    file: str
    rho: float
    count: int
    bytes: int
    geometric_error: float
    box_min: Corner
    box_max: Corner
    seconds: float
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    alpha_error: float | None = None
    alpha_bias: float | None = None

    def with_scores(self, scores: SceneScores) -> Self:
        """Return the entry with scores.

        Args:
            scores: Scores of the file.

        Returns:
            A new entry.
        """
        return self.model_copy(update=scores.means())


class LevelsIndex(Record):
    """All levels of a scene: the content of ``levels.json``.

    Attributes:
        version: Version of this format.
        source: File name of the full scene.
        source_count: Number of Gaussians of the full scene.
        views: Number of views that the scores are means over; 0 without scores.
        width: Width of their images, pixels; 0 without scores.
        height: Height of their images, pixels; 0 without scores.
        levels: The levels, the finest first.
    """

    version: int = 1
    source: str
    source_count: int
    views: int = 0
    width: int = 0
    height: int = 0
    levels: tuple[LevelEntry, ...]


def level_names(rhos: Sequence[float], suffix: str = ".ply") -> tuple[str, ...]:
    """Return the file names of levels, one per ratio."""
    return tuple(f"rho_{written(rho)}{suffix}" for rho in rhos)


def check_levels(
    folder: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> None:
    """Make the folder and check that levels can be written, before any long computation."""
    ends = (end for end in WRITABLE_SUFFIXES if not end.endswith(READABLE_SUFFIXES))
    for name, end in product(names, ends):
        if name.lower().endswith(end):
            raise InvalidArgumentError(
                f"levels need a format that cvtgs can also read, found {end!r}; write them as "
                ".ply and convert those files."
            )
    make_folder(folder)
    for name in names:
        check_save(Path(folder) / name, overwrite=overwrite)
    check_output(Path(folder) / INDEX_NAME, overwrite=overwrite)


def write_levels(
    levels: Sequence[Level],
    folder: str | os.PathLike[str],
    *,
    rhos: Sequence[float],
    source: str | os.PathLike[str],
    suffix: str = ".ply",
    axes: str | None = None,
    overwrite: bool = False,
) -> LevelsIndex:
    """Write levels and, last, the index that names them; until then, there is none.

    Args:
        levels: The levels.
        folder: Folder to write to; created if it is missing.
        rhos: Ratio of each level.
        source: Name or path of the full scene; the index has its file name.
        suffix: File suffix, which selects the format.
        axes: The axes of the files, as :func:`cvtgs.io.change_axes` names them; None for those
            of the format.
        overwrite: Whether existing files may be replaced.

    Returns:
        The index, the finest level first.

    Raises:
        InvalidArgumentError: There is no level, levels are of different scenes, or the ratios are
            not those of the levels, all different and in (0, 1].
        FileFormatError: There is no format of this suffix.
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.

    Example:
        >>> import tempfile
        >>> from cvtgs import Simplifier, synthetic
        >>> levels = Simplifier(device="cpu").levels(synthetic.scene("object", 500), [0.1, 0.02])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     index = write_levels(levels, folder, rhos=[0.1, 0.02], source="object")
        >>> [(level.file, level.count) for level in index.levels]
        [('rho_0.1.ply', 50), ('rho_0.02.ply', 10)]
    """
    is_list = isinstance(levels, Sequence) and len(levels) > 0
    if not is_list or not all(isinstance(level, Level) for level in levels):
        raise InvalidArgumentError(
            f"levels must be those that Simplifier.levels returns, found {shown(levels)}."
        )
    check_one_scene(level.report.input_count for level in levels)
    check_path(source)
    check_path(folder)
    checked_axes(SCENE_AXES if axes is None else axes)
    ratios = written_ratios(rhos)
    total, counts = levels[0].report.input_count, [level.report.target_count for level in levels]
    if [target_count(total, rho) for rho in ratios] != counts or len({*ratios}) < len(ratios):
        raise InvalidArgumentError(
            f"rhos must be the ratios of the levels, in their order, and differ, since they name "
            f"the files; found {ratios} for {counts} of {counted(total, 'Gaussian')}."
        )
    place, names = Path(folder), level_names(ratios, suffix)
    check_levels(place, names, overwrite=overwrite)
    if overwrite:  # the old index would describe other files until the new one is written
        with suppress(OSError):  # then it cannot be replaced either
            (place / INDEX_NAME).unlink(missing_ok=True)
    entries = []
    for level, rho, name in zip(levels, ratios, names, strict=True):
        save(level.scene, place / name, overwrite=overwrite, axes=axes)
        entries.append(_entry(level, rho, place / name))
    index = LevelsIndex(
        source=printable_name(Path(source).name),
        source_count=total,
        levels=tuple(sorted(entries, key=lambda entry: -entry.count)),
    )
    write_atomically(place / INDEX_NAME, index.to_json().encode(), overwrite=overwrite)
    return index


def _entry(level: Level, rho: float, path: Path) -> LevelEntry:
    """Describe a level by its file, which may hold rounded values."""
    stored = load(path, axes=SCENE_AXES, trust_sizes=True)
    lowest, highest = torch.aminmax(stored.means, dim=0)
    return LevelEntry(
        file=path.name,
        rho=rho,
        count=len(stored),
        bytes=scene_size(path),
        geometric_error=level.geometric_error,
        box_min=tuple(lowest.tolist()),
        box_max=tuple(highest.tolist()),
        seconds=level.report.seconds,
    )


def add_scores(index: LevelsIndex, folder: Path, evaluation: Evaluation) -> LevelsIndex:
    """Add scores to the index of levels, also on disk."""
    scores = {one.name: one for one in evaluation.scenes}
    levels = tuple(level.with_scores(scores[level.file]) for level in index.levels)
    size = {"width": evaluation.width, "height": evaluation.height}
    index = index.model_copy(update={"levels": levels, "views": evaluation.view_count, **size})
    write_atomically(folder / INDEX_NAME, index.to_json().encode(), overwrite=True)
    return index
