"""Write levels and their index into a folder."""

import os
from collections.abc import Sequence
from pathlib import Path

from cvtgs.evaluation import Evaluation
from cvtgs.io import atomic_output, check_output, check_save, save
from cvtgs.levels.index import LevelEntry, LevelsIndex
from cvtgs.report import Level

INDEX_NAME = "levels.json"
"""Name of the index beside the levels."""


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
    overwrite: bool = False,
) -> LevelsIndex:
    """Write levels and, at last, the index that names them.

    Args:
        levels: The levels.
        folder: Where to; made if it is not there.
        rhos: The ratio of each.
        source: Name of the full scene.
        suffix: End of the names, which says the format.
        evaluation: How the levels look, by the names of :func:`level_names`; None without scores.
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
        save(level.scene, place / name, overwrite=overwrite)
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
