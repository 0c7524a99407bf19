"""Several sizes of one scene on the disk, and an index for viewers to choose among them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import torch

from cvtgs.config.base import Record
from cvtgs.evaluation import Evaluation, SceneScores
from cvtgs.io import atomic_output, check_output, check_save, save
from cvtgs.report import Level

__all__ = ["INDEX_NAME", "LevelEntry", "LevelsIndex", "level_names", "write_levels"]

INDEX_NAME = "levels.json"
"""Name of the index beside the levels."""

Corner = tuple[float, float, float]


class LevelEntry(Record):
    """One level.

    Attributes:
        file: Name of the file, in the folder of the index.
        rho: Ratio of Gaussians that was given.
        count: Its Gaussians.
        bytes: Size of the file.
        geometric_error: Root mean square distance from the Gaussians of the full scene to those
            that represent them, weighted by mass; scene units. 0 if all are there.
        box_min: Least coordinates of the centres, scene units.
        box_max: Largest coordinates of the centres.
        nested: Whether each of its cells consists of whole cells of the finest level.
        seconds: Wall-clock seconds beyond what finer levels had done already.
        psnr: Mean PSNR against the full scene, dB; None if it was not measured.
        ssim: The same for SSIM.
        lpips: The same for LPIPS.
    """

    file: str
    rho: float
    count: int
    bytes: int
    geometric_error: float
    box_min: Corner
    box_max: Corner
    nested: bool
    seconds: float
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None

    @classmethod
    def of(
        cls, level: Level, rho: float, *, file: str, size: int, scores: SceneScores | None
    ) -> Self:
        """Describe a level.

        Args:
            level: The level.
            rho: Ratio that was given.
            file: Name of its file.
            size: Bytes of its file.
            scores: Its scores; None if it was not evaluated.

        Returns:
            The entry.
        """
        lowest, highest = torch.aminmax(level.scene.means, dim=0)
        return cls(
            file=file,
            rho=rho,
            count=len(level.scene),
            bytes=size,
            geometric_error=level.geometric_error,
            box_min=_corner(lowest),
            box_max=_corner(highest),
            nested=level.nested,
            seconds=level.report.seconds,
            psnr=scores.psnr.mean if scores else None,
            ssim=scores.ssim.mean if scores else None,
            lpips=scores.lpips.mean if scores and scores.lpips else None,
        )


class LevelsIndex(Record):
    """All levels of a scene, as ``levels.json`` holds them.

    Attributes:
        version: Version of this format.
        source: Name of the file of the full scene.
        source_count: Its Gaussians.
        views: Views that the scores are means over; 0 without scores.
        levels: The levels, the finest first.
    """

    version: int = 1
    source: str
    source_count: int
    views: int = 0
    levels: tuple[LevelEntry, ...]

    def to_json(self) -> str:
        """Return the index as indented JSON.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"


def _corner(point: torch.Tensor) -> Corner:
    x, y, z = point.tolist()
    return x, y, z


def level_names(rhos: Sequence[float], suffix: str = ".ply") -> tuple[str, ...]:
    """Name the files of levels.

    Args:
        rhos: Ratios.
        suffix: End of the names, which says the format.

    Returns:
        One name per ratio.

    Example:
        >>> level_names([0.1, 0.001])
        ('rho_0.1.ply', 'rho_0.001.ply')
    """
    return tuple(f"rho_{rho!r}{suffix}" for rho in rhos)


def check_levels(
    folder: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> None:
    """Check that levels could be written, before the long work that comes first."""
    place = Path(folder)
    if not place.exists():
        check_output(place)  # its parent is there and writable
        for name in names:
            check_save(place.parent / f".{name}", overwrite=True)
        return
    for name in names:
        check_save(place / name, overwrite=overwrite)
    check_output(place / INDEX_NAME, overwrite=overwrite)


def write_levels(
    levels: Sequence[Level],
    folder: str | os.PathLike[str],
    *,
    rhos: Sequence[float],
    source: str,
    suffix: str = ".ply",
    evaluation: Evaluation | None = None,
    axes: str = "rdf",
    overwrite: bool = False,
) -> LevelsIndex:
    """Write levels and, at last, the index that names them.

    Args:
        levels: The levels.
        folder: Where to write; made if it is missing.
        rhos: The ratio of each.
        source: Name of the full scene.
        suffix: End of the names, which says the format.
        evaluation: Scores of the levels, by the names of :func:`level_names`; None for none.
        axes: The axes of the files, as :func:`cvtgs.io.change_axes` names them.
        overwrite: Whether existing files may be replaced.

    Returns:
        The index, the finest level first.

    Raises:
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
    place, names = Path(folder), level_names(rhos, suffix)
    check_levels(place, names, overwrite=overwrite)
    place.mkdir(exist_ok=True)
    scores = {one.name: one for one in evaluation.scenes} if evaluation else {}
    entries = []
    for level, rho, name in zip(levels, rhos, names, strict=True):
        save(level.scene, place / name, overwrite=overwrite, axes=axes)
        size = (place / name).stat().st_size
        entries.append(LevelEntry.of(level, rho, file=name, size=size, scores=scores.get(name)))
    index = LevelsIndex(
        source=source,
        source_count=levels[0].report.input_count,
        views=len(evaluation.views) if evaluation else 0,
        levels=tuple(sorted(entries, key=lambda entry: -entry.count)),
    )
    with atomic_output(place / INDEX_NAME, overwrite=overwrite) as file:
        file.write(index.to_json().encode())
    return index
