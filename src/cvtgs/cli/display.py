"""Texts that several commands print: sizes, times, progress bars."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import cvtgs
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import printable

if TYPE_CHECKING:
    from cvtgs.clock import StageCost


def say(text: str, *, file: TextIO | None = None, end: str = "\n", flush: bool = False) -> None:
    """Print a text, with what a terminal would obey or cannot show as escapes."""
    file = sys.stdout if file is None else file
    print(printable(text, file.encoding or "utf-8"), file=file, end=end, flush=flush)


def size_text(count: int) -> str:
    """Return a number of bytes in decimal units."""
    if count < 1000:
        return f"{count} B"
    value = count / 1000
    for unit in ("kB", "MB"):
        if value < 1000:
            return f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def file_size(path: Path) -> str:
    """Return the size of a scene file, or of the scene in a folder."""
    return size_text(cvtgs.io.scene_size(path))


def stage_seconds(stages: Sequence["StageCost"]) -> str:
    """Return the time of all stages together, and of each."""
    total = f"{sum(stage.seconds for stage in stages):.2f} s"
    parts = ", ".join(f"{stage.stage} {stage.seconds:.2f}" for stage in stages)
    return f"{total} ({parts})" if parts else total


@contextmanager
def progress_bars(*, quiet: bool) -> Iterator[ProgressListener]:
    """Show a bar per stage on stderr if it is a terminal."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, TaskID

    with Progress(console=Console(stderr=True)) as progress:
        bars: dict[str, TaskID] = {}
        encoding = sys.stderr.encoding or "utf-8"  # None of a StringIO

        def listen(event: ProgressEvent) -> None:
            if event.done == 0 or event.stage not in bars:
                bars[event.stage] = progress.add_task(event.stage, total=event.total)
            progress.update(bars[event.stage], completed=event.done, total=event.total)
            if event.note:
                text = escape(printable(f"{event.stage} {event.note}", encoding))
                progress.update(bars[event.stage], description=text)

        yield listen
