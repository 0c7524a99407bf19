"""Shared by benchmarks: cost of processes and functions, files, words, tables on pages."""

import hashlib
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch

import cvtgs
from cvtgs.devices import device_name
from cvtgs.errors import RunError, input_errors
from cvtgs.io import atomic_output
from cvtgs.tradeoff.process_cost import run_process


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Cost of one process and of those that it started and waited for.

    Attributes:
        user_seconds: User CPU time.
        wall_seconds: Wall-clock time from start to end.
        peak_bytes: Peak resident size, of the largest of them.
        output: Its stdout.
        system: The machine, and the version of cvtgs; empty if unknown.
    """

    user_seconds: float
    wall_seconds: float
    peak_bytes: int
    output: str
    system: str = ""


def run_python(*arguments: str) -> Cost:
    """Run this Python with arguments and measure it."""
    return run([sys.executable, *arguments])


def run(command: Sequence[str]) -> Cost:
    """Run a command and measure it; a failure ends the benchmark."""
    try:
        with importable() if command[0] == sys.executable else nullcontext():
            cost = run_process(command)
    except RunError as error:
        raise SystemExit(f"{' '.join(command)} failed: {error}") from None
    sys.stderr.write(cost.errors)
    return Cost(
        user_seconds=cost.user_seconds,
        wall_seconds=cost.wall_seconds,
        peak_bytes=cost.peak_memory_bytes,
        output=cost.output,
        system=system(),
    )


@contextmanager
def importable() -> Iterator[None]:
    """Let child processes import benchmarks; they do not look in the current folder."""
    before = os.environ.get("PYTHONPATH")
    root = str(Path(__file__).parents[1])
    os.environ["PYTHONPATH"] = root if before is None else os.pathsep.join([before, root])
    try:
        yield
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Limit child processes to a number of cores, where the system supports it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:count])  # children inherit this
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def fastest(run: Callable[[], object], *, runs: int) -> float:
    """Return the smallest CPU seconds of several runs."""
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return min(seconds)


def spread(values: Sequence[float]) -> str:
    """Format median, minimum and maximum."""
    return f"{statistics.median(values):.2f} ({min(values):.2f}-{max(values):.2f})"


def difference(value: float, base: float) -> float:
    """Subtract a base; two infinite values, of images without any error, are equal."""
    return 0.0 if value == base else value - base


def machine() -> str:
    """Return the names of processor and Python."""
    model = device_name(torch.device("cpu"))
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def system() -> str:
    """Return the machine and the version of cvtgs."""
    return f"{machine()}, cvtgs {cvtgs.__version__}"


def generated_scenes(
    folder: Path, scenes: Sequence[tuple[str, int, int]], *, seed: int = 0
) -> list[Path]:
    """Write generated scenes of some kinds, counts and SH degrees; return their files."""
    files = []
    for kind, count, degree in scenes:
        path = folder / f"{kind}_{count // 1000}k_sh{degree}.ply"
        cvtgs.save(cvtgs.synthetic.scene(kind, count, sh_degree=degree, seed=seed), path)
        files.append(path)
    return files


def names_of(files: Sequence[Path]) -> list[str]:
    """Return a name for each file: its stem, or its last folders and whole name where stems agree.

    Raises:
        SystemExit: A file is given twice, or two names would be the same.
    """
    names, places = [file.stem for file in files], [file.resolve() for file in files]
    for depth in range(2, max((len(place.parts) for place in places), default=0)):
        names = [
            name if names.count(name) == 1 else "-".join(place.parts[-depth:])
            for name, place in zip(names, places, strict=True)
        ]
    for name in names:
        if names.count(name) > 1:
            raise SystemExit(f"{name}: is given {names.count(name)} times.")
    return names


def digest_of(source: Path) -> str:
    """Return the SHA-256 of a file, or of the file of the scene in a folder."""
    with input_errors(source), cvtgs.io.scene_file(source).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def filled(text: str, places: Mapping[str, str]) -> str:
    """Replace the placeholders in a text; other braces stay."""
    anywhere = "|".join(re.escape(place) for place in places)
    return re.sub(anywhere, lambda found: places[found[0]], text)


def settings_of(words: Sequence[str]) -> dict[str, str]:
    """Parse ``key=value`` words."""
    wrong = [word for word in words if "=" not in word]
    if wrong:
        raise SystemExit(f"a setting must be KEY=VALUE; found {wrong[0]!r}.")
    return dict(word.split("=", 1) for word in words)


def write_file(path: Path, content: bytes) -> None:
    """Write a file atomically; create its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path, overwrite=True) as file:
        file.write(content)


def renew_tables(page: Path, text: str, *, script: str) -> None:
    """Replace the tables of a script on a page."""
    before, after = around_tables(page, script=script)
    page.write_text(f"{before}\n\n{text}\n{after}", encoding="utf-8")


def around_tables(page: Path, *, script: str) -> tuple[str, str]:
    """Return what is before and after the tables of a script on a page; exit without them."""
    start, end = f"<!-- tables: python -m {script} -->", "<!-- end of tables -->"
    with input_errors(page):
        before, begins, rest = page.read_text(encoding="utf-8").partition(start)
    _, ends, after = rest.partition(end)
    if not ends:
        raise SystemExit(f"{page}: must have the lines {start!r} and {end!r}; found none.")
    return before + begins, ends + after


def warm_up() -> None:
    """Load libraries and compiled code, with and without images, before anything is measured."""
    scene = cvtgs.synthetic.scene("object", 1000, sh_degree=0, seed=0)
    for preset in ("standard", "matched"):
        cvtgs.Simplifier(config=preset).simplify(scene, 0.1)
