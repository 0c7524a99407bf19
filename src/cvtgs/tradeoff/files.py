"""The files of a tradeoff: tables for programs, a plot, and a page to look at."""

import os
from pathlib import Path
from typing import NamedTuple

from cvtgs.errors import MissingDependencyError
from cvtgs.evaluation.comparison_files import PAGE, make_folder
from cvtgs.evaluation.page import comparison_page
from cvtgs.io import atomic_output, check_output
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.tradeoff.chart import tradeoff_chart
from cvtgs.tradeoff.measure import Measured
from cvtgs.tradeoff.summary import foreword

CSV, JSON, PLOT = "tradeoff.csv", "tradeoff.json", "tradeoff.png"
STAGE = "write pages"


class Written(NamedTuple):
    """What was written.

    Attributes:
        paths: The files.
        note: What is missing and why; empty if nothing is.
    """

    paths: tuple[Path, ...]
    note: str


def check_tradeoff_files(
    folder: str | os.PathLike[str], *, more: tuple[str, ...] = (), overwrite: bool = False
) -> None:
    """Make the folder and check that the files could be written, before the work begins."""
    make_folder(folder)
    for name in (CSV, JSON, PLOT, PAGE, *more):
        check_output(Path(folder) / name, overwrite)


def write_tradeoff(
    measured: Measured,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> Written:
    """Write ``tradeoff.csv``, ``.json``, ``.png`` and ``index.html``, each completely or not.

    Without matplotlib, the plot is left out.

    Args:
        measured: What was measured.
        folder: Where to write; made if it is missing.
        overwrite: Whether existing files may be replaced.
        listener: Told about each file.

    Returns:
        The paths of the files, and what is missing.

    Raises:
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.
    """
    check_tradeoff_files(folder, overwrite=overwrite)
    tradeoff = measured.tradeoff
    chart, note = _chart(measured)
    page = comparison_page(measured.comparison, foreword=foreword(tradeoff, chart))
    contents = {
        CSV: tradeoff.to_csv().encode(),
        JSON: tradeoff.to_json().encode(),
        PLOT: chart,
        PAGE: page.encode(),
    }
    kept = {Path(folder) / name: content for name, content in contents.items() if content}
    for done, (path, content) in enumerate(kept.items(), start=1):
        with atomic_output(path, overwrite=overwrite) as file:
            file.write(content)
        listener(ProgressEvent(stage=STAGE, done=done, total=len(kept)))
    return Written(tuple(kept), note)


def _chart(measured: Measured) -> tuple[bytes | None, str]:
    try:
        return tradeoff_chart(measured.tradeoff), ""
    except MissingDependencyError as error:
        return None, str(error)
