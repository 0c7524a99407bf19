"""The evaluation of CVT-GS against photographs: ``python -m benchmarks.paper DATASETS -o DIR``.

DATASETS is a folder with NeRF-Synthetic, Mip-NeRF 360, Tanks and Temples and Deep Blending, or some
of their scenes, and with models that were trained on them by INRIA's code, nerfstudio or gsplat
(``benchmarks.datasets`` says how they are found). Every method simplifies each model to 10 %, 1 %
and 0.1 % of its Gaussians, in its own process, without fine-tuning. Images from the held-out
cameras (every eighth, or ``transforms_test.json``) are compared with their photographs at the
published size: PSNR, SSIM, LPIPS. Seconds are wall-clock seconds of the process from start to end.

DIR gets ``paper.md`` (tables next to the published figures of ``published.json``),
``results.json``, and the simplified scenes in ``scenes``. To resume an interrupted run, start it
again; results of a model that was replaced are measured again. Scenes that are missing or unusable
are listed and left out.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean

import pydantic

import cvtgs
from benchmarks.baselines import BASELINES
from benchmarks.compare import Run, Task, attempt, baseline_methods, own_methods
from benchmarks.compare_tables import (
    Result,
    Table,
    joined,
    markdown,
    read_results,
    results_json,
    systems_of,
)
from benchmarks.datasets import (
    DATASETS,
    Capture,
    find_captures,
    read_test_views,
)
from benchmarks.measuring import Cost, digest_of, system, write_file
from benchmarks.quality import RATIOS, PhotographJudge, markdown_rows
from benchmarks.worlds import place_cameras
from cvtgs.errors import CvtgsError
from cvtgs.evaluation.scorer import Metrics, chosen_metrics

FULL = "full scene"
MERGED = "paper, no network"
OURS = ("paper", MERGED, "standard")
LARGE = (800, 800)
"""An image size in pixels that every LPIPS network accepts."""

PUBLISHED = Path(__file__).with_name("published.json")


class Gain(pydantic.BaseModel):
    """A published difference of PSNR, by ratio."""

    name: str
    of: str
    over: str
    psnr: Mapping[str, float]


class Published(pydantic.BaseModel):
    """Published figures and their source."""

    source: str
    gains: tuple[Gain, ...]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    found = find_captures(options.datasets)
    notes = list(found.notes)
    for note in notes:
        print(note, file=sys.stderr)
    if not found.captures:
        raise SystemExit(f"{options.datasets}: no scene with a trained model was found in it.")
    results = options.output / "results.json"
    table = of_present_models(read_results(results), found.captures)
    metrics = chosen_metrics(options.lpips, LARGE)
    network = metrics.lpips.network if metrics.lpips else f"none: {metrics.note}"
    keep_network(options.output / "lpips.txt", network)
    for capture in found.captures:
        try:
            for part in measure(capture, table, options, metrics):
                table = joined(table, part)
                write_file(results, results_json(table).encode())
        except (SystemExit, CvtgsError) as error:
            notes.append(f"{capture.name}: left out. {error}")
            print(notes[-1], file=sys.stderr)
        write_file(
            options.output / "paper.md",
            report(table, found.captures, notes, options, network).encode(),
        )
    print((options.output / "paper.md").read_text(encoding="utf-8"))


def keep_network(path: Path, network: str) -> None:
    """Record the LPIPS network; exit if earlier results used another one."""
    before = path.read_text(encoding="utf-8") if path.is_file() else network
    if before != network:
        raise SystemExit(
            f"{path.parent}: its results were scored with LPIPS {before}, but this run would "
            f"use {network}; choose the network with --lpips, or use another folder."
        )
    write_file(path, network.encode())


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("datasets", type=Path, metavar="DATASETS", help="folder to search")
    found.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    found.add_argument("--rho", type=float, nargs="+", default=list(RATIOS))
    found.add_argument(
        "--methods", nargs="+", choices=[*OURS, *BASELINES], default=[*OURS, *BASELINES],
        metavar="NAME", help=f"some of: {'; '.join([*OURS, *BASELINES])} (all of them)",
    )  # fmt: skip
    found.add_argument(
        "--lpips", choices=("auto", "vgg", "alex", "off"), default="auto", help="network of LPIPS"
    )
    return found


def commands(methods: Sequence[str]) -> dict[str, list[str]]:
    """Return the command of every method, with placeholders."""
    own = own_methods([])
    known = {
        "paper": own["paper"],
        MERGED: [*own["paper"], "--set", "merge.network=false"],
        "standard": own["standard"],
    }
    return {name: (known | baseline_methods())[name] for name in methods}


def of_present_models(table: Table, captures: Sequence[Capture]) -> Table:
    """Drop the results of models that were replaced since, or that are unknown."""
    sources = {key_of(capture): digest_of(capture.model.path) for capture in captures}
    return {
        scene: {
            method: {
                rho: result
                for rho, result in row.items()
                if result is None or result.source == sources.get(scene, result.source)
            }
            for method, row in rows.items()
        }
        for scene, rows in table.items()
    }


def measure(
    capture: Capture, table: Table, options: argparse.Namespace, metrics: Metrics
) -> Iterator[Table]:
    """Yield each new result of a scene as a table of one entry."""
    known = table.get(key_of(capture), {})
    todo = [
        (method, rho)
        for rho in options.rho
        for method in commands(options.methods)
        if known.get(method, {}).get(rho) is None
    ]
    has_full = known.get(FULL, {}).get(1.0) is not None
    if has_full and not todo:
        return
    scene, source = cvtgs.load(capture.model.path), digest_of(capture.model.path)
    views = read_test_views(capture)
    cameras = place_cameras(capture, scene, views.cameras)
    judge = PhotographJudge(cameras, views.photographs, capture.dataset.background, metrics)
    print(
        f"{capture.name}: {len(scene):,} Gaussians of {capture.model.layout}'s layout, "
        f"{len(cameras)} photographs of {cameras.width} x {cameras.height} in "
        f"{views.folder}",
        file=sys.stderr,
    )
    if not has_full:
        nothing = Cost(user_seconds=0.0, wall_seconds=0.0, peak_bytes=0, output="", system=system())
        full = result_of(judge, (scene, nothing), wanted=len(scene), source=source)
        yield one_row(capture, FULL, 1.0, full)
    for method, rho in todo:
        count = cvtgs.target_count(len(scene), rho)
        task = Task(
            source=capture.model.path.resolve(),
            rho=rho,
            count=count,
            output=(options.output / "scenes" / f"{capture.name} {rho:g} {method}.ply").resolve(),
        )
        made = attempt(commands([method])[method], task, keep=True)
        found = made and result_of(judge, made, wanted=count, source=source)
        yield one_row(capture, method, rho, found)


def result_of(judge: PhotographJudge, made: Run, *, wanted: int, source: str) -> Result:
    scene, cost = made
    return Result(
        quality=judge.score(scene),
        wall_seconds=cost.wall_seconds,
        cpu_seconds=cost.user_seconds,
        count=len(scene),
        wanted=wanted,
        source=source,
        system=cost.system,
    )


def one_row(capture: Capture, method: str, rho: float, result: Result | None) -> Table:
    return {key_of(capture): {method: {rho: result}}}


def key_of(capture: Capture) -> str:
    return f"{capture.dataset.name}: {capture.name}"


def report(
    table: Table,
    captures: Sequence[Capture],
    notes: Sequence[str],
    options: argparse.Namespace,
    network: str,
) -> str:
    """Return the page: published gains first, then a section per dataset."""
    layouts = ", ".join(sorted({capture.model.layout for capture in captures}))
    parts = [
        "# The evaluation of CVT-GS\n",
        f"Against photographs that were held out; models of {layouts}; "
        f"LPIPS: {network}. Seconds: wall clock, one process per run, reading and "
        f"writing included; {systems_of(table)}.\n",
        gains_table(table, options.rho),
    ]
    for dataset in DATASETS:
        names = [key_of(one) for one in captures if one.dataset == dataset]
        rows = {name: spread_full(table[name], options.rho) for name in names if name in table}
        if rows:
            parts.append(f"## {dataset.name}: {len(rows)} of {len(dataset.scenes)} scenes\n")
            parts.append(markdown(rows, options.rho))
    if notes:
        parts.append("## Left out\n")
        parts.append("".join(f"- {note}\n" for note in notes))
    return "\n".join(parts)


def spread_full(
    rows: Mapping[str, Mapping[float, Result | None]], ratios: Sequence[float]
) -> dict[str, Mapping[float, Result | None]]:
    """Repeat the result of the full scene at every ratio."""
    full = rows.get(FULL, {}).get(1.0)
    others = {name: row for name, row in rows.items() if name != FULL}
    return {FULL: dict.fromkeys(ratios, full), **others}


def gains_table(table: Table, ratios: Sequence[float]) -> str:
    """Compare PSNR gains with the published ones, as means over the scenes with both results."""
    published = Published.model_validate(json.loads(PUBLISHED.read_text(encoding="utf-8")))
    lines = []
    for gain in published.gains:
        for rho in ratios:
            pairs = [
                (rows.get(gain.of, {}).get(rho), rows.get(gain.over, {}).get(rho))
                for rows in table.values()
            ]
            found = [one.quality.psnr - two.quality.psnr for one, two in pairs if one and two]
            claimed = gain.psnr.get(f"{rho:g}")
            lines.append(
                [
                    gain.name,
                    f"{rho:g}",
                    f"{mean(found):+.2f}" if found else "-",
                    str(len(found)),
                    "-" if claimed is None else f"{claimed:+.2f}",
                ]
            )
    heads = ["gain, dB", "ratio", "here", "scenes", "published"]
    return f"{markdown_rows(heads, lines)}\nPublished: {published.source}.\n"


if __name__ == "__main__":
    main()
