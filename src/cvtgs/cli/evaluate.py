"""``cvtgs evaluate``: scores of simplified scenes."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.cli.display import progress_bars, size_text
from cvtgs.cli.looking import (
    add_looking_options,
    add_scoring_options,
    background_color,
    check_looking_options,
    chosen_cameras,
    load_scenes,
    looking_device,
)
from cvtgs.errors import InvalidArgumentError

if TYPE_CHECKING:
    from cvtgs.evaluation import Evaluation, SceneScores

SIZE = 640


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "evaluate",
        help="score simplified scenes against the full one",
        description="Render REF and every SMALL from the same views and print PSNR, SSIM and, "
        "where its weights are, LPIPS against the images of REF; with --images also against "
        "photographs.",
    )
    add_scoring_options(parser)
    parser.add_argument(
        "--images",
        type=Path,
        metavar="DIR",
        help="photographs of the cameras of --cameras, found by name",
    )
    parser.add_argument("--json", action="store_true", help="print JSON, with every view")
    add_looking_options(parser, size=SIZE)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.evaluation import (  # noqa: PLC0415 (keeps --help fast)
        EvaluationSettings,
        evaluate,
        load_photographs,
    )

    check_looking_options(options)
    if options.images is not None and options.cameras is None:
        raise InvalidArgumentError("--images needs the cameras of the photographs: --cameras.")
    background = background_color(options)
    scenes, sizes = load_scenes([options.reference, *options.small], looking_device(options))
    name, *others = scenes
    with progress_bars(quiet=options.quiet) as listener:
        cameras = chosen_cameras(options, scenes[name])
        photographs = (
            load_photographs(options.images, cameras, background=background)
            if options.images is not None
            else None
        )
        evaluation = evaluate(
            scenes[name],
            {other: scenes[other] for other in others},
            cameras,
            reference_name=name,
            photographs=photographs,
            settings=EvaluationSettings(
                background=background, lpips=options.lpips, backend=options.backend
            ),
            listener=listener,
        )
    if options.json:
        print(evaluation.to_json(), end="")
    elif not options.quiet:
        _print_scores(evaluation, sizes)


def _print_scores(evaluation: "Evaluation", sizes: dict[str, int]) -> None:
    print(
        f"{len(evaluation.views)} views of {evaluation.width} x {evaluation.height} pixels, "
        f"rendered by {evaluation.backend}"
    )
    print(f"against {evaluation.reference}, {evaluation.reference_count:,} Gaussians:")
    _print_table(evaluation.scenes, sizes)
    if evaluation.photographs:
        print("against photographs:")
        _print_table(evaluation.photographs, sizes)
    if evaluation.lpips_sentence:
        print(evaluation.lpips_sentence)


def _print_table(scenes: "tuple[SceneScores, ...]", sizes: dict[str, int]) -> None:
    width = max(len(scene.name) for scene in scenes)
    print(f"  {'':{width}}  {'Gaussians':>12}  {'size':>9}  {'PSNR':>6}  {'SSIM':>6}  LPIPS")
    for scene in scenes:
        distance = f"{scene.lpips.mean:.4f}" if scene.lpips else "-"
        print(
            f"  {scene.name:{width}}  {scene.count:>12,}  {size_text(sizes[scene.name]):>9}  "
            f"{scene.psnr.mean:>6.2f}  {scene.ssim.mean:>6.4f}  {distance}"
        )
