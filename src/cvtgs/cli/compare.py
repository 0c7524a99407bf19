"""``cvtgs compare``: a page, a contact sheet and error maps."""

import argparse
from pathlib import Path

from cvtgs.cli.display import progress_bars
from cvtgs.cli.looking import (
    add_looking_options,
    add_scoring_options,
    background_color,
    check_looking_options,
    chosen_cameras,
    load_scenes,
    looking_device,
)

SIZE = 800
MOST_CAMERAS = 8


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "compare",
        help="make a page that shows the full scene and simplified ones side by side",
        description="Write index.html, one file that needs no network, with a divider between "
        "REF and each SMALL; sheet.png, all images with their scores; and errors.png, where "
        "they differ. Of given cameras, 8 are used unless --views says otherwise.",
    )
    add_scoring_options(parser)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="directory to write to"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    add_looking_options(parser, size=SIZE)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.evaluation import (  # noqa: PLC0415 (keeps --help fast)
        EvaluationSettings,
        compare,
        write_exhibition,
    )
    from cvtgs.evaluation.comparison_files import check_exhibition  # noqa: PLC0415

    check_looking_options(options)
    check_exhibition(options.output, overwrite=options.overwrite)
    scenes, sizes = load_scenes([options.reference, *options.small], looking_device(options))
    name, *others = scenes
    with progress_bars(quiet=options.quiet) as listener:
        comparison = compare(
            scenes[name],
            {other: scenes[other] for other in others},
            chosen_cameras(options, scenes[name], most=MOST_CAMERAS),
            reference_name=name,
            sizes=sizes,
            settings=EvaluationSettings(
                background=background_color(options), lpips=options.lpips, backend=options.backend
            ),
            listener=listener,
        )
        paths = write_exhibition(
            comparison, options.output, overwrite=options.overwrite, listener=listener
        )
    if not options.quiet:
        for scores in comparison.evaluation.scenes:
            print(
                f"{scores.name}: {scores.count:,} Gaussians, "
                f"PSNR {scores.psnr.mean:.2f} dB, SSIM {scores.ssim.mean:.4f}"
            )
        print(f"Wrote {', '.join(path.name for path in paths)}. Open {paths[-1]} in a browser.")
