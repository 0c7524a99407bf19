"""``cvtgs levels``: several sizes of one scene, and an index for viewers."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import READABLE, progress_bars, size_text
from cvtgs.cli.lists import add_ratios_option, ratios_of
from cvtgs.cli.looking import (
    add_looking_options,
    background_color,
    check_looking_options,
    chosen_cameras,
    looking_device,
)
from cvtgs.cli.simplify import read_settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cvtgs.evaluation import Evaluation
    from cvtgs.levels import LevelsIndex
    from cvtgs.progress import ProgressListener
    from cvtgs.scene import GaussianScene
    from cvtgs.simplify import Level

SIZE = 400


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "levels",
        help="make several sizes of a scene at once",
        description="Write IN in several sizes, each an ordinary scene of exactly ceil(rho * N) "
        "Gaussians, and levels.json with counts, bytes, scores, geometric errors and boxes. It "
        "takes little more time than the finest size alone; scoring comes on top (--no-scores).",
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"scene to read ({READABLE})")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="directory to write to"
    )
    add_ratios_option(parser)
    parser.add_argument(
        "--suffix", default=".ply", metavar="END", help="format of the files (default .ply)"
    )
    parser.add_argument("--preset", metavar="NAME", help="as of cvtgs simplify")
    parser.add_argument("--ckpt", default="auto", metavar="NAME", help="as of cvtgs simplify")
    parser.add_argument("--config", type=Path, metavar="F.toml", help="configuration file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="change one setting; may be repeated",
    )  # fmt: skip
    parser.add_argument("--no-scores", action="store_true", help="do not look at the levels")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    add_looking_options(parser, size=SIZE)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.config import SimplifyConfig  # noqa: PLC0415 (keeps --help fast)
    from cvtgs.counts import target_count  # noqa: PLC0415
    from cvtgs.io import load, load_cameras  # noqa: PLC0415
    from cvtgs.levels import level_names, write_levels  # noqa: PLC0415
    from cvtgs.levels.write import check_levels  # noqa: PLC0415
    from cvtgs.simplify import Simplifier  # noqa: PLC0415

    check_looking_options(options)
    rhos = sorted(ratios_of(options.rho), reverse=True)
    for rho in rhos:
        target_count(1, rho)
    names = level_names(rhos, options.suffix)
    check_levels(options.output, names, overwrite=options.overwrite)
    config = SimplifyConfig.compose(
        file=options.config, preset=options.preset, settings=read_settings(options.settings)
    )
    checkpoint = None if options.ckpt == "none" else options.ckpt
    with progress_bars(quiet=options.quiet) as listener:
        simplifier = Simplifier(checkpoint, config=config, device=options.device, listener=listener)
        scene = load(options.input)
        cameras = None if options.cameras is None else load_cameras(options.cameras)
        levels = simplifier.levels(scene, rhos, cameras=cameras)
        scores = None if options.no_scores else _scores(options, scene, levels, names, listener)
        index = write_levels(
            levels,
            options.output,
            rhos=rhos,
            source=options.input.name,
            suffix=options.suffix,
            evaluation=scores,
            overwrite=options.overwrite,
        )
    if not options.quiet:
        _print_index(index)


def _scores(
    options: argparse.Namespace,
    scene: "GaussianScene",
    levels: "Sequence[Level]",
    names: "Sequence[str]",
    listener: "ProgressListener",
) -> "Evaluation":
    from cvtgs.evaluation import EvaluationSettings, evaluate  # noqa: PLC0415
    from cvtgs.filters import valid_rows  # noqa: PLC0415

    device = looking_device(options)
    full = scene.select(valid_rows(scene)).to(device)
    return evaluate(
        full,
        {name: level.scene.to(device) for name, level in zip(names, levels, strict=True)},
        chosen_cameras(options, full),
        settings=EvaluationSettings(background=background_color(options), backend=options.backend),
        listener=listener,
    )


def _print_index(index: "LevelsIndex") -> None:
    width = max(len(level.file) for level in index.levels)
    print(f"{index.source}, {index.source_count:,} Gaussians:")
    print(f"  {'':{width}}  {'Gaussians':>12}  {'size':>9}  {'error':>9}  {'PSNR':>6}  seconds")
    for level in index.levels:
        psnr = "-" if level.psnr is None else f"{level.psnr:.2f}"
        print(
            f"  {level.file:{width}}  {level.count:>12,}  {size_text(level.bytes):>9}  "
            f"{level.geometric_error:>9.3g}  {psnr:>6}  {level.seconds:.2f}"
        )
