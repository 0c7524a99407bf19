"""``cvtgs tradeoff``: what more time buys, preset by preset."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import READABLE, progress_bars
from cvtgs.cli.lists import add_ratios_option, ratios_of, words_of
from cvtgs.cli.looking import (
    add_looking_options,
    add_lpips_option,
    background_color,
    check_looking_options,
    chosen_cameras,
)

if TYPE_CHECKING:
    from cvtgs.tradeoff import Tradeoff

SIZE = 640
MOST_CAMERAS = 8


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "tradeoff",
        help="run all presets on a scene and show seconds against quality",
        description="Simplify IN by every preset, each run in a process of its own, score the "
        "results against IN, print a table, and write tradeoff.csv, tradeoff.json, tradeoff.png "
        "and index.html, one file that needs no network. Of given cameras, 8 are used unless "
        "--views says otherwise.",
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"the full scene ({READABLE})")
    add_ratios_option(parser)
    parser.add_argument("--presets", metavar="NAME,NAME", help="which presets (default: all)")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="directory to write to"
    )
    parser.add_argument("--save", action="store_true", help="keep the small scenes there, too")
    add_lpips_option(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    add_looking_options(parser, size=SIZE)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.evaluation import EvaluationSettings  # noqa: PLC0415 (keeps --help fast)
    from cvtgs.tradeoff import measure_tradeoff, write_tradeoff  # noqa: PLC0415
    from cvtgs.tradeoff.files import check_tradeoff_files  # noqa: PLC0415
    from cvtgs.tradeoff.runs import tasks_of  # noqa: PLC0415

    check_looking_options(options)
    presets = None if options.presets is None else words_of(options.presets)
    ratios = ratios_of(options.rho)
    kept = tuple(task.file_name for task in tasks_of(presets, ratios) if options.save)
    check_tradeoff_files(options.output, more=kept, overwrite=options.overwrite)
    with progress_bars(quiet=options.quiet) as listener:
        measured = measure_tradeoff(
            options.input,
            presets=presets,
            ratios=ratios,
            cameras=lambda scene: chosen_cameras(options, scene, most=MOST_CAMERAS),
            settings=EvaluationSettings(
                background=background_color(options), lpips=options.lpips, backend=options.backend
            ),
            device=options.device,
            folder=options.output if options.save else None,
            listener=listener,
        )
        paths, note = write_tradeoff(
            measured, options.output, overwrite=options.overwrite, listener=listener
        )
    if not options.quiet:
        _print_tables(measured.tradeoff)
        names = ", ".join(path.name for path in paths)
        print(f"Wrote {names}. Open {paths[-1]} in a browser.")
        if note:
            print(f"Without a plot: {note}")


def _print_tables(tradeoff: "Tradeoff") -> None:
    from cvtgs.tradeoff.table import MARK_MEANS, cells, heading, how_measured  # noqa: PLC0415

    for rho in tradeoff.ratios:
        print(heading(tradeoff, rho))
        columns = [cells(tradeoff, result) for result in tradeoff.results if result.rho == rho]
        left = max(len(name) for name in columns[0])
        widths = [max(map(len, column.values())) for column in columns]
        for name in columns[0]:
            words = (
                f"{column[name]:>{width}}" for column, width in zip(columns, widths, strict=True)
            )
            print(f"  {name:{left}}  {'  '.join(words)}".rstrip())
    print(MARK_MEANS)
    print(how_measured(tradeoff))
