r"""Compare the presets, other methods and external tools: quality against seconds.

``python -m benchmarks.compare SCENE.ply ... -o DIR`` follows the comparison of CVT-GS, but with
images of the full scene instead of photographs: every method gets the same scenes and the same
number of Gaussians M, and one scorer renders all results, without fine-tuning. Seconds are those
of a separate process, including start-up, reading and writing. The script prints Markdown tables,
means over the scenes first; the folder gets them and a plot, updated after every scene.

Methods are the presets of cvtgs, ``standard, no network``, the baselines of
``benchmarks.baselines``, and any tool that reads and writes PLY files:

    python -m benchmarks.compare a.ply b.ply --rho 0.1 0.01 -o compared \
        --methods standard "mass pruning" NanoGS \
        --tool "other=other-tool {IN} -o {OUT} --keep {RHO} --max {COUNT}"

Scenes and scorers are chosen as in ``benchmarks.quality``; ``--cameras CAPTURE --split test
--images DIR`` scores against photographs. Run it once on a small scene first, so that compiled
code is compiled and cached. ``--results FILE`` adds the results to those in the file and shows
all of them, so that methods can be run one by one; ``--methods`` without names only shows them.
Results of a scene must be of the same file, cameras, size and background. ``--outputs DIR`` keeps
every file that a method wrote, with its seconds, and reuses a kept file of the same command, scene
and count (and version of cvtgs, except for tools) instead of running the method again. ``--set``
changes the presets, which then have the settings in their names.
"""

import argparse
import json
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cvtgs
from benchmarks.baselines import BASELINES
from benchmarks.compare_tables import (
    Result,
    Table,
    chart,
    failures,
    joined,
    judges_of,
    markdown,
    read_results,
    results_json,
    results_of,
    systems_of,
    wrong_counts,
)
from benchmarks.measuring import Cost, digest_of, filled, names_of, run, write_file
from benchmarks.quality import Scorer, judge_of, make_scorer, scenes, scoring_parser
from cvtgs.errors import MissingDependencyError

NO_NETWORK = "standard, no network"


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One scene and a target count.

    Attributes:
        source: The scene's file.
        rho: Share of Gaussians to keep.
        count: Number of Gaussians to keep.
        output: The file to write.
    """

    source: Path
    rho: float
    count: int
    output: Path


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    commands = commands_of(options)
    text = ""
    known = {} if options.results is None else read_results(options.results)
    if commands:
        check_known(known, options)
    for measured in measure(commands, options) if commands else [{}]:
        table = joined(known, measured)
        if options.results is not None:
            write_file(options.results, results_json(table).encode())
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


def check_known(known: Table, options: argparse.Namespace) -> None:
    """Raise if known results are of other scenes or images than these options ask for."""
    files = dict(zip(names_of(options.files), options.files, strict=True))
    for name, file in (files or dict.fromkeys(cvtgs.synthetic.KINDS)).items():
        judge, source = judge_of(options, [] if file is None else [file]), source_of(options, file)
        for result in results_of({name: known.get(name, {})}):
            start = f"--results: {options.results} has results of {name}"
            if result.judge not in ("", judge):
                raise SystemExit(
                    f"{start} by another judge ({result.judge}); this is {judge}. Name another "
                    f"file."
                )
            if result.source not in ("", source):
                raise SystemExit(
                    f"{start} of another scene ({result.source}); this is {source}. Name another "
                    f"file."
                )


def source_of(options: argparse.Namespace, file: Path | None) -> str:
    """Return what tells a scene from others of its name."""
    return f"--count {options.count}" if file is None else digest_of(file)


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
    found.add_argument(
        "--clock", choices=("wall", "cpu"), default="wall", help="wall-clock or CPU seconds"
    )
    found.add_argument("--results", type=Path, metavar="FILE", help="add results to this file")
    found.add_argument("--outputs", type=Path, metavar="DIR", help="keep the files of the methods")
    found.add_argument("-o", "--output", type=Path, help="folder for compare.md and compare.png")
    return found


def own_methods(settings: Sequence[str]) -> dict[str, list[str]]:
    """Return the commands of cvtgs, by name."""
    command = [sys.executable, "-m", "cvtgs", "simplify", "{IN}", "{OUT}", "--count", "{COUNT}"]
    command += ["--overwrite", "--quiet"]
    command += [part for setting in settings for part in ("--set", setting)]
    methods = {name: [*command, "--preset", name] for name in cvtgs.PRESETS}
    return methods | {
        NO_NETWORK: [*command, "--preset", "standard", "--set", "merge.network=false"]
    }


def baseline_methods() -> dict[str, list[str]]:
    """Return the commands of the baselines, by name."""
    command, places = [sys.executable, "-m", "benchmarks.baselines"], ["{IN}", "{OUT}"]
    return {name: [*command, name, *places, "--count", "{COUNT}"] for name in BASELINES}


def commands_of(options: argparse.Namespace) -> dict[str, list[str]]:
    """Return the command of every method, with placeholders, by name."""
    own, suffix = own_methods(options.set), f" ({' '.join(options.set)})" if options.set else ""
    methods = own | baseline_methods()
    names = list(methods) if options.methods is None else options.methods
    commands = {f"{name}{suffix}" if name in own else name: methods[name] for name in names}
    for tool in options.tool:
        name, separator, command = tool.partition("=")
        if not separator or "{OUT}" not in command or "{IN}" not in command:
            raise SystemExit(
                f"--tool must be NAME=COMMAND with {{IN}} and {{OUT}}; found {tool!r}."
            )
        if name in commands:
            raise SystemExit(f"--tool: there is a method named {name!r} already.")
        commands[name] = shlex.split(command)
    if not commands and options.results is None:
        raise SystemExit("name at least one method or tool, or --results to show.")
    return commands


def measure(commands: Mapping[str, list[str]], options: argparse.Namespace) -> Iterator[Table]:
    """Run every method on every scene; yield the table so far after each scene."""
    table: dict[str, dict[str, dict[float, Result | None]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for scene_name, scene, full in sources(options, folder):
            file = options.files[len(table)] if options.files else None
            score, runs = make_scorer(options, file), {}
            for method, command in commands.items():
                for rho in options.rho:
                    place = folder / "small.ply"
                    if options.outputs is not None:
                        place = options.outputs / kept_name(scene_name, rho, method)
                    count = cvtgs.target_count(len(scene), rho)
                    task = Task(source=full, rho=rho, count=count, output=place)
                    runs[method, task] = attempt(command, task, keep=options.outputs is not None)
            judge = judge_of(options, [] if file is None else [file])
            source = source_of(options, file)
            table[scene_name] = judged(scene, runs, score=score, judge=judge, source=source)
            print(f"compared on {scene_name}: {len(scene)} Gaussians", file=sys.stderr)
            yield dict(table)


def kept_name(scene_name: str, rho: float, method: str) -> str:
    """Return the name of the file that a method wrote for a scene and a ratio."""
    return re.sub(r"[/\\]", "-", f"{scene_name} {rho:.12g} {method}.ply")


def sources(
    options: argparse.Namespace, folder: Path
) -> Iterator[tuple[str, cvtgs.GaussianScene, Path]]:
    """Yield name, scene and file of every scene; generated ones are written to the folder."""
    for number, (name, scene) in enumerate(scenes(options.files, options.count)):
        path = options.files[number] if options.files else folder / "full.ply"
        if not options.files:
            cvtgs.save(scene, path, overwrite=True)
        yield name, scene, path.resolve()


Run = tuple[cvtgs.GaussianScene, Cost]


def attempt(command: Sequence[str], task: Task, *, keep: bool) -> Run | None:
    """Run a method's command on a task, or load its kept file; return None on failure."""
    output, costs = task.output, task.output.with_suffix(".json")
    made_by = {"command": list(command), "count": task.count}
    if command[:2] == [sys.executable, "-m"]:
        made_by["cvtgs"] = cvtgs.__version__
    if keep:
        made_by["scene"] = digest_of(task.source)
    if keep and output.is_file() and costs.is_file():
        kept = json.loads(costs.read_text(encoding="utf-8"))
        if kept.get("made_by") == made_by:
            return cvtgs.load(output), Cost(**kept["cost"])
    output.unlink(missing_ok=True)
    output.parent.mkdir(parents=True, exist_ok=True)
    places = {
        "{IN}": str(task.source),
        "{OUT}": str(output),
        "{RHO}": f"{task.rho:.12g}",
        "{COUNT}": str(task.count),
    }
    try:
        cost = run([filled(part, places) for part in command])
        found = cvtgs.load(output)
    except (SystemExit, OSError, cvtgs.CvtgsError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return None
    if keep:
        write_file(costs, json.dumps({"made_by": made_by, "cost": asdict(cost)}).encode())
    return found, cost


def judged(
    scene: cvtgs.GaussianScene,
    runs: Mapping[tuple[str, Task], Run | None],
    *,
    score: Scorer,
    judge: str,
    source: str,
) -> dict[str, dict[float, Result | None]]:
    """Score all results of one scene in one call of the scorer."""
    small = [made[0] for made in runs.values() if made is not None]
    found = iter(score(scene, small) if small else [])
    rows: dict[str, dict[float, Result | None]] = {}
    for (method, task), made in runs.items():
        rows.setdefault(method, {})[task.rho] = made and Result(
            quality=next(found),
            wall_seconds=made[1].wall_seconds,
            cpu_seconds=made[1].user_seconds,
            count=len(made[0]),
            wanted=task.count,
            judge=judge,
            source=source,
            system=made[1].system,
        )
    return rows


def report(table: Table, options: argparse.Namespace) -> str:
    """Return the report: settings, tables, wrong counts and failures."""
    judge = "; ".join(judges_of(table)) or judge_of(options, options.files)
    clock = "wall-clock" if options.clock == "wall" else "user CPU"
    parts = [
        f"Scenes: {', '.join(table)}. Judge: {judge}. "
        f"Seconds: {clock}, one process per run, reading and writing included; "
        f"{systems_of(table)}.",
        markdown(table, options.rho, means_only=options.means, clock=options.clock),
        wrong_counts(table),
        failures(table),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


if __name__ == "__main__":
    main()
