"""Texts that several commands print: sizes, times, progress bars, and notes about a run."""

import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import cvtgs
from cvtgs.errors import OutputError, reason_of
from cvtgs.io.streams import copy_to
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import columns, counted, printable

WIDTH = 80  # maximum columns of a line of output
TIE = "\N{NO-BREAK SPACE}"  # lines do not break here; it is printed as an ordinary space


def say(text: str, *, file: TextIO | None = None, end: str = "\n", flush: bool = False) -> None:
    """Print a text; escape control characters and characters that the terminal cannot show."""
    file = sys.stdout if file is None else file
    if file is None:  # closed by the parent process
        return
    with _console_errors(file):
        print(printable(text, file.encoding or "utf-8"), file=file, end=end, flush=flush)


def flush_output() -> None:
    """Flush stdout."""
    say("", end="", flush=True)


def send_file(path: Path) -> None:
    """Write the bytes of a file to stdout."""
    with path.open("rb") as file, _console_errors(sys.stdout):
        copy_to(sys.stdout.buffer, file)
        sys.stdout.buffer.flush()


@contextmanager
def _console_errors(file: TextIO) -> Iterator[None]:
    """Turn a full disk or a closed pipe into an error of cvtgs; ignore it on stderr."""
    try:
        yield
    except OSError as error:
        if file is not sys.stderr:
            reason = reason_of(error)
            raise OutputError(f"standard output must be writable, found: {reason}.") from error


def say_wrapped(text: str, *, file: TextIO | None = None, indent: int = 0) -> None:
    """Print a sentence in lines of 80 columns, without breaks inside words or at a ``TIE``."""
    for line in textwrap.wrap(
        printable(text),
        WIDTH,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent + 2),
        break_long_words=False,
        break_on_hyphens=False,
    ):
        say(line.replace(TIE, " "), file=file)


def say_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of cells; the first column is aligned to the left, the others to the right."""
    widths = [max(map(columns, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        space = " " * (widths[0] - columns(first))
        cells = (f"{text:>{width}}" for text, width in zip(others, widths[1:], strict=True))
        say(f"  {first}{space}  {'  '.join(cells)}".rstrip())


@contextmanager
def progress_bars(*, quiet: bool, transient: bool = False) -> Iterator[ProgressListener]:
    """Show a bar per stage if stderr is a terminal; transient bars are removed at the end."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, TaskID

    with Progress(console=Console(stderr=True), transient=transient) as progress:
        bars: dict[str, TaskID] = {}
        encoding = sys.stderr.encoding or "utf-8"  # a StringIO has None

        def listen(event: ProgressEvent) -> None:
            if event.done == 0 or event.stage not in bars:
                bars[event.stage] = progress.add_task(event.stage, total=event.total)
            progress.update(bars[event.stage], completed=event.done, total=event.total)
            if event.note:
                text = escape(printable(f"{event.stage} {event.note}", encoding))
                progress.update(bars[event.stage], description=text)

        yield listen


def target_note(found: "cvtgs.budget.Found", views: str) -> str:
    """Return the scores of a search, and the views that they are measured over."""
    from cvtgs.evaluation.scorer import MOST_PSNR

    tries = "1 try" if len(found.tried) == 1 else f"{len(found.tried)} tries"
    least = "at least " if found.psnr == MOST_PSNR else ""  # closer views count no more
    return (
        f"PSNR {least}{found.psnr:.2f} dB, SSIM {found.ssim:.4f}, alpha error "
        f"{found.alpha_error:.4f} (bias {found.alpha_bias:+.4f}) over {views}; found in {tries}."
    )


def shortfall_note(report: "cvtgs.SimplifyReport") -> str:
    """Return why a result is smaller than asked for."""
    return f"Fewer than the requested {report.target_count:,}: {report.shortfall}."


def report_notes(report: "cvtgs.SimplifyReport") -> list[str]:
    """Return the sentences to print besides counts, sizes and seconds."""
    notes = []
    if report.device_note:
        notes.append(f"{report.device_note}.")
    if report.blocks > 1:
        resumed = f", {report.resumed_blocks} of them from an earlier run"
        notes.append(f"In {report.blocks} blocks{resumed if report.resumed_blocks else ''}.")
    if report.shortfall:
        notes.append(shortfall_note(report))
    if report.config.uses_images and report.views == "none":
        notes.append("No images were rendered, since no Gaussians had to merge.")
    together = " in all blocks together" * (report.blocks > 1)
    if report.matching is not None:
        matched = report.matching
        where = f"on {counted(matched.heldout, 'held-out image')}"
        if matched.heldout == matched.views:
            where = "on the same images"
        if report.blocks > 1:  # some may have held images out and others not
            where = "on average"
        notes.append(
            f"Matched to {counted(matched.views, 'image')} of the scene{together}: "
            f"{matched.psnr_after - matched.psnr_before:+.2f} dB {where}."
        )
    if report.refinement is not None:
        refined = report.refinement
        steps = counted(refined.steps, "step")
        if refined.stopped == "time" and refined.steps == 0:
            notes.append(
                f"Not refined: rendering {counted(refined.heldout, 'held-out image')} first took "
                f"{refined.cost.seconds:.1f} s and left no time for a step; allow more time "
                "(--refine), or fewer or smaller images (--set refine.heldout, --set refine.size)."
            )
        elif refined.gain == 0.0 and refined.stopped != "perfect":
            notes.append(f"Not refined: none of {steps} improved the held-out images.")
        elif refined.steps == 0:
            notes.append("Not refined: the held-out images were perfect from the start.")
        else:
            average = " on average" * (report.blocks > 1)
            notes.append(
                f"Refined in {steps}{together}: {refined.gain:+.2f} dB on held-out images{average}."
            )
    return notes
