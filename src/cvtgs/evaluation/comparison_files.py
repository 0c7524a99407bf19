"""The files of a comparison: a page, a contact sheet and the error maps."""

import os
from collections.abc import Callable
from pathlib import Path

from cvtgs.errors import OutputError
from cvtgs.evaluation.compare import Comparison
from cvtgs.evaluation.images import encode
from cvtgs.evaluation.page import comparison_page
from cvtgs.evaluation.sheet import contact_sheet, error_sheet
from cvtgs.io import atomic_output, check_output
from cvtgs.progress import ProgressEvent, ProgressListener, silent

PAGE, SHEET, ERRORS = "index.html", "sheet.png", "errors.png"
STAGE = "write pages"


def check_exhibition(folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Make the folder and check that the files could be written, before the work begins."""
    make_folder(folder)
    for name in (PAGE, SHEET, ERRORS):
        check_output(Path(folder) / name, overwrite)


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Make a folder to write to, with its parents, unless it is there."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(f"{os.fspath(folder)}: cannot be made: {reason}.") from error


def write_exhibition(
    comparison: Comparison,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> tuple[Path, ...]:
    """Write ``index.html``, ``sheet.png`` and ``errors.png``, each completely or not at all.

    Args:
        comparison: Images and scores, at least one simplified scene.
        folder: Where to write; made if it is missing.
        overwrite: Whether existing files may be replaced.
        listener: Told about each file.

    Returns:
        The paths of the files.

    Raises:
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation import compare
        >>> from cvtgs.views import automatic_views
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 300, sh_degree=0)
        >>> views = automatic_views(scene, 2, width=32, height=24)
        >>> comparison = compare(scene, {"same": scene}, views)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [path.name for path in write_exhibition(comparison, folder)]
        ['sheet.png', 'errors.png', 'index.html']
    """
    check_exhibition(folder, overwrite=overwrite)
    makers: dict[str, Callable[[], bytes]] = {
        SHEET: lambda: encode(contact_sheet(comparison), "png"),
        ERRORS: lambda: encode(error_sheet(comparison), "png"),
        PAGE: lambda: comparison_page(comparison).encode(),
    }
    listener(ProgressEvent(stage=STAGE, done=0, total=len(makers)))
    paths = tuple(Path(folder) / name for name in makers)
    for done, (path, make) in enumerate(zip(paths, makers.values(), strict=True), start=1):
        content = make()
        with atomic_output(path, overwrite=overwrite) as file:
            file.write(content)
        listener(ProgressEvent(stage=STAGE, done=done, total=len(makers)))
    return paths
