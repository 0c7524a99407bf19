r"""Compare the presets, other methods and external tools: quality against seconds.

``python -m benchmarks.compare SCENE.ply ... -o DIR`` compares as CVT-GS does, but with images of
the full scene instead of photographs: every method gets the same scenes and the same number of
Gaussians M, and one scorer renders what it writes, without fine-tuning. Seconds are those of a
separate process, with start, reading and writing. Output is one Markdown table, the mean over the
scenes first; the folder gets that and a plot, updated after every scene.

Methods are the presets of cvtgs, ``standard, no network``, the baselines of
``benchmarks.baselines``, and any tool that reads and writes PLY files:

    python -m benchmarks.compare a.ply b.ply --rho 0.1 0.01 -o compared \
        --methods standard "mass pruning" NanoGS \
        --tool "other=other-tool {IN} -o {OUT} --keep {RHO} --max {COUNT}"

Scenes and judges are chosen as in ``benchmarks.quality``. Let it run once on a small scene first:
what compiles itself does so then.
"""

import argparse
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Literal

import cvtgs
from benchmarks.baselines import BASELINES
from benchmarks.measuring import Cost, machine, run, write_file
from benchmarks.quality import (
    MEAN,
    SIZE,
    VIEWS,
    Quality,
    Scorer,
    make_scorer,
    scenes,
    scoring_parser,
)
from cvtgs.errors import MissingDependencyError
from cvtgs.plots import Panel, Series, line_chart

NO_NETWORK = "standard, no network"


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One scene, and how far to go.

    Attributes:
        source: The scene's file.
        rho: Share of Gaussians to keep.
        count: Number of Gaussians to keep.
    """

    source: Path
    rho: float
    count: int


Clock = Literal["wall", "cpu"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What one run of one method gave.

    Attributes:
        quality: Against the full scene.
        wall_seconds: From the start of the process to its end.
        cpu_seconds: Processor time outside the kernel.
        count: Gaussians that it wrote.
        wanted: Gaussians that it should have written.
    """

    quality: Quality
    wall_seconds: float
    cpu_seconds: float
    count: int
    wanted: int

    def seconds(self, clock: Clock) -> float:
        """Return the time on a clock."""
        return self.wall_seconds if clock == "wall" else self.cpu_seconds


Table = Mapping[str, Mapping[str, Sequence[Result | None]]]
"""One result per ratio, None for a failure, by method, by scene."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    commands = commands_of(options)
    text = ""
    for table in measure(commands, options):
        text = report(table, options)
        if options.output is not None:
            write_file(options.output / "compare.md", text.encode())
            try:
                plot = chart(table, options.rho, clock=options.clock)
            except MissingDependencyError as error:
                print(f"without a plot: {error}", file=sys.stderr)
                continue
            if plot is not None:
                write_file(options.output / "compare.png", plot)
    print(text)


def parser() -> argparse.ArgumentParser:
    found = scoring_parser(__doc__)
    found.formatter_class = argparse.RawDescriptionHelpFormatter
    found.add_argument(
        "--methods", nargs="*", choices=[*own_methods([]), *BASELINES], metavar="NAME",
        help=f"some of: {'; '.join([*own_methods([]), *BASELINES])} (all of them)",
    )  # fmt: skip
    found.add_argument(
        "--tool", action="append", default=[], metavar="NAME=COMMAND",
        help="an external tool; {IN}, {OUT}, {RHO} and {COUNT} are filled in; may be repeated",
    )  # fmt: skip
    found.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="whose seconds")
    found.add_argument("-o", "--output", type=Path, help="folder for compare.md and compare.png")
    return found


def own_methods(settings: Sequence[str]) -> dict[str, list[str]]:
    """Return the commands of cvtgs itself, by name."""
    command = [sys.executable, "-m", "cvtgs", "simplify", "{IN}", "{OUT}", "--count", "{COUNT}"]
    command += ["--overwrite", "--quiet"]
    command += [part for setting in settings for part in ("--set", setting)]
    methods = {name: [*command, "--preset", name] for name in cvtgs.PRESETS}
    return methods | {
        NO_NETWORK: [*command, "--preset", "standard", "--set", "merge.network=false"]
    }


def commands_of(options: argparse.Namespace) -> dict[str, list[str]]:
    """Return every method's command, with places to fill in, by name."""
    run_baseline = [sys.executable, "-m", "benchmarks.baselines"]
    methods = own_methods(options.set) | {
        name: [*run_baseline, name, "{IN}", "{OUT}", "--count", "{COUNT}"] for name in BASELINES
    }
    names = list(methods) if options.methods is None else options.methods
    commands = {name: methods[name] for name in names}
    for tool in options.tool:
        name, separator, command = tool.partition("=")
        if not separator or "{OUT}" not in command or "{IN}" not in command:
            raise SystemExit(
                f"--tool must be NAME=COMMAND with {{IN}} and {{OUT}}; found {tool!r}."
            )
        if name in commands:
            raise SystemExit(f"--tool: there is a method named {name!r} already.")
        commands[name] = shlex.split(command)
    if not commands:
        raise SystemExit("name at least one method or tool.")
    return commands


def measure(commands: Mapping[str, list[str]], options: argparse.Namespace) -> Iterator[Table]:
    """Run every method on every scene; give the table so far after each scene."""
    score = make_scorer(options)
    table: dict[str, dict[str, list[Result | None]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for scene_name, scene, source in sources(options, folder):
            tasks = [
                Task(source=source, rho=rho, count=cvtgs.target_count(len(scene), rho))
                for rho in options.rho
            ]
            runs = {
                method: [attempt(command, task, folder / "small.ply") for task in tasks]
                for method, command in commands.items()
            }
            table[scene_name] = judged(scene, runs, tasks, score=score)
            print(f"compared on {scene_name}: {len(scene)} Gaussians", file=sys.stderr)
            yield dict(table)


def sources(
    options: argparse.Namespace, folder: Path
) -> Iterator[tuple[str, cvtgs.GaussianScene, Path]]:
    """Return name, scene and file of every scene; generated ones are written to the folder."""
    for number, (name, scene) in enumerate(scenes(options.files, options.count)):
        path = options.files[number] if options.files else folder / "full.ply"
        if not options.files:
            cvtgs.save(scene, path, overwrite=True)
        yield name, scene, path.resolve()


Run = tuple[cvtgs.GaussianScene, Cost]


def attempt(command: Sequence[str], task: Task, output: Path) -> Run | None:
    """Run a method's command on a task; None if it fails."""
    output.unlink(missing_ok=True)
    places = {
        "{IN}": str(task.source),
        "{OUT}": str(output),
        "{RHO}": f"{task.rho:.12g}",
        "{COUNT}": str(task.count),
    }
    try:
        cost = run([filled(part, places) for part in command])
        return cvtgs.load(output), cost
    except (SystemExit, OSError, cvtgs.CvtgsError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return None


def filled(part: str, places: Mapping[str, str]) -> str:
    """Replace the places in one argument; other braces stay as they are."""
    anywhere = "|".join(re.escape(place) for place in places)
    return re.sub(anywhere, lambda found: places[found[0]], part)


def judged(
    scene: cvtgs.GaussianScene,
    runs: Mapping[str, Sequence[Run | None]],
    tasks: Sequence[Task],
    *,
    score: Scorer,
) -> dict[str, list[Result | None]]:
    """Score everything that was made of one scene, all at once."""
    small = [made[0] for row in runs.values() for made in row if made is not None]
    found = iter(score(scene, small) if small else [])
    return {
        method: [
            None
            if made is None
            else Result(
                quality=next(found),
                wall_seconds=made[1].wall_seconds,
                cpu_seconds=made[1].user_seconds,
                count=len(made[0]),
                wanted=task.count,
            )
            for made, task in zip(row, tasks, strict=True)
        ]
        for method, row in runs.items()
    }


def report(table: Table, options: argparse.Namespace) -> str:
    """Report what was measured, the table, and what is not as it should be."""
    own = f"cvtgs' own renderer, {VIEWS} automatic views of {SIZE} x {SIZE} pixels"
    judge = "the command of --scorer" if options.scorer else own
    clock = "wall-clock" if options.clock == "wall" else "user CPU"
    parts = [
        f"Scenes: {', '.join(table)}. Judge: {judge}. "
        f"Seconds: {clock}, one process per run, reading and writing included; {machine()}. "
        f"cvtgs {cvtgs.__version__}.",
        markdown(table, options.rho, means_only=options.means, clock=options.clock),
        wrong_counts(table, options.rho),
        failures(table, options.rho),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


METRICS: Mapping[str, tuple[Callable[[Result], float | None], str]] = {
    "PSNR": (lambda result: result.quality.psnr, ".2f"),
    "SSIM": (lambda result: result.quality.ssim, ".4f"),
    "LPIPS": (lambda result: result.quality.lpips, ".4f"),
}


def markdown(
    table: Table, ratios: Sequence[float], *, means_only: bool = False, clock: Clock = "wall"
) -> str:
    """Return a Markdown table: the mean first, then scene by scene.

    A mean is over all scenes; a dash stands where a run failed or nothing was measured. There are
    no columns for LPIPS if nobody measured it.
    """
    metrics = {**METRICS, "s": (lambda result: result.seconds(clock), ".1f")}
    everything = [found for rows in table.values() for row in rows.values() for found in row]
    if all(found is None or found.quality.lpips is None for found in everything):
        del metrics["LPIPS"]
    heads = [f"{name} at {rho:g}" for rho in ratios for name in metrics]
    lines = [f"| scene | method | {' | '.join(heads)} |", "|---" * (len(heads) + 2) + "|"]
    groups = {MEAN: list(table.values())}
    if not means_only:
        groups |= {scene: [rows] for scene, rows in table.items()}
    for group, tables in groups.items():
        for method in tables[0]:
            cells = [
                cell([found and value(found) for found in column], form)
                for column in zip(*(rows[method] for rows in tables), strict=True)
                for value, form in metrics.values()
            ]
            lines.append(f"| {group} | {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(values: Sequence[float | None], form: str) -> str:
    """Return the text of a mean, or a dash if a value is missing."""
    known = [value for value in values if value is not None]
    return f"{mean(known):{form}}" if len(known) == len(values) else "-"


def wrong_counts(table: Table, ratios: Sequence[float]) -> str:
    """Name the runs that did not give exactly M Gaussians; quality is not comparable there."""
    lines = [
        f"- {method}, {scene}, {rho:g}: {found.count:,} instead of {found.wanted:,}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in zip(ratios, row, strict=True)
        if found is not None and found.count != found.wanted
    ]
    return "\n".join(["Not the number of Gaussians that was asked for:\n", *lines] if lines else [])


def failures(table: Table, ratios: Sequence[float]) -> str:
    """Name the runs that failed."""
    lines = [
        f"- {method}, {scene}, {rho:g}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in zip(ratios, row, strict=True)
        if found is None
    ]
    return "\n".join(["Failed:\n", *lines] if lines else [])


def chart(table: Table, ratios: Sequence[float], *, clock: Clock = "wall") -> bytes | None:
    """Draw mean PSNR over mean seconds, a line per method and a point per ratio.

    Points with a failure in any scene are left out; None if there are no others.
    """
    series = []
    for method in next(iter(table.values())):
        columns = zip(*(rows[method] for rows in table.values()), strict=True)
        complete = [[found for found in column if found] for column in columns if all(column)]
        if complete:
            line = Series(
                name=method,
                x=[max(mean(each.seconds(clock) for each in column), 1e-3) for column in complete],
                y=[mean(each.quality.psnr for each in column) for column in complete],
                markers=True,
            )
            series.append(line)
    if not series:
        return None
    shares = ", ".join(f"{rho:g}" for rho in sorted(ratios, reverse=True))
    panel = Panel(
        series=series,
        title=f"Share of Gaussians kept: {shares} (from above)",
        x_label="seconds, reading and writing included",
        y_label="PSNR, dB",
        log_x=True,
    )
    return line_chart([panel], width=1000, height=700)


if __name__ == "__main__":
    main()
