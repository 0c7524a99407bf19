"""``cvtgs levels``: several sizes of one scene, and an index for viewers."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import cvtgs
from cvtgs.cli.cameras import (
    SCORED_SIZE,
    add_view_options,
    choose_cameras,
    evaluation_settings,
    own_cameras,
    say_views,
)
from cvtgs.cli.display import progress_bars, say, say_table, say_wrapped, shortfall_note
from cvtgs.cli.jobs import check_suffix
from cvtgs.cli.options import (
    AddParser,
    add_options,
    checkpoint_of,
    dotted,
    ratios,
    read_config,
    read_settings,
)
from cvtgs.cli.paths import is_same_file
from cvtgs.cli.streams import (
    add_stream_options,
    check_stream_options,
    of_different_sizes,
    stream_blocks,
    stream_levels,
)
from cvtgs.cli.view import check_page, write_page
from cvtgs.errors import InvalidArgumentError
from cvtgs.text import counted, printable, size_text

PLAIN_RHOS, STREAM_RHOS = "0.1,0.01,0.001", "1,0.25,0.06,0.015"


def add_levels(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "levels",
        help="simplify a scene to several sizes at once",
        description="Write IN in several sizes, each an ordinary scene of exactly ceil(rho * N) "
        "Gaussians, and levels.json with counts, bytes, scores, geometric errors and boxes. This "
        "takes about 1.6 times as long as the finest of three sizes, plus the time for scoring, "
        "which --no-scores skips.",
    )
    parser.set_defaults(run=levels)
    add_options(
        parser,
        "input",
        "-o/--output",
        "--rho",
        rho="ratios of Gaussians to keep (default 0.1,0.01,0.001; with --stream 1,0.25,0.06,0.015)",
    )
    parser.set_defaults(rho=None)
    parser.add_argument(
        "--suffix", metavar="END", type=dotted, help="format of the files (default .ply)"
    )
    add_stream_options(parser)
    add_options(parser, "--preset", "--ckpt", "--config", "--set", "--sh-degree", "--axes")
    parser.add_argument(
        "--no-scores", action="store_true", help="skip rendering and scoring the levels"
    )
    add_options(parser, "--viewer", "--trust-sizes", "--overwrite")
    add_view_options(
        parser,
        size=SCORED_SIZE,
        split="split of --cameras to score from (default: all of --cameras); if it is given, "
        "presets that use images are fitted to the split train",
        views="number of views to score from; with --cameras, N of them, spread evenly (default "
        "8, or all of --cameras)",
    )


def levels(options: argparse.Namespace) -> None:
    """Run ``cvtgs levels``."""
    settings = evaluation_settings(options)
    default = PLAIN_RHOS if options.stream is None else STREAM_RHOS
    rhos = sorted(options.rho or ratios(default), reverse=True)
    check_suffix(options.suffix)
    suffix = options.suffix or ".ply"
    names = cvtgs.levels.level_names(rhos, suffix)
    check_stream_options(options)
    check_page(options)
    _check_input(options, names)
    if options.stream is None:
        cvtgs.levels.check_levels(options.output, names, overwrite=options.overwrite)
    config = read_config(options, read_settings(options.settings))
    is_scored = options.stream is None and not options.no_scores
    if options.cameras is not None and not (is_scored or config.uses_images or options.quiet):
        say_wrapped(f"--cameras is not used: {config.preset} renders no images.")
    if options.stream is not None and stream_blocks(options, config, rhos):
        return
    with progress_bars(quiet=options.quiet) as listener:
        simplifier = cvtgs.Simplifier(
            checkpoint_of(options), config=config, device=options.device, listener=listener
        )
        scene = cvtgs.load(options.input, axes=options.axes.source, trust_sizes=options.trust_sizes)
        if options.stream is not None and options.rho is None:
            rhos = of_different_sizes(rhos, len(scene), int(cvtgs.validity.valid_rows(scene).sum()))
        degree = scene.sh_degree if options.sh_degree is None else options.sh_degree
        cameras = _cameras_to_fit(options, scene) if config.uses_images else None
        views = _checked_views(options, scene, settings) if is_scored else None
        made = simplifier.levels(scene.with_sh_degree(degree), rhos, cameras=cameras)
        if options.stream is not None:
            stream_levels(options, made, listener)
            return
        index = cvtgs.levels.write_levels(
            made,
            options.output,
            rhos=rhos,
            source=options.input.name,
            suffix=suffix,
            axes=options.axes.target,
            overwrite=options.overwrite,
        )
        if views is not None:
            evaluation = _score(options, scene, names, views, settings, listener)
            index = cvtgs.levels.add_scores(index, options.output, evaluation)
    if not options.quiet:
        if views is not None:
            say_views(evaluation)
        _say_levels(index, made)
        if is_scored and cameras is not None and options.split != "test":
            say_wrapped(
                "Levels were fitted to cameras of which some score, which favours them; with "
                "--cameras and --split test, others do."
            )
        _say_older(options, names)
    small = {name: level.scene for name, level in zip(names, made, strict=True)}
    title = str(options.input) if options.input.name in small else options.input.name
    write_page(options, {title: scene, **small})


def _check_input(options: argparse.Namespace, names: Sequence[str]) -> None:
    """Raise if a level would replace the scene, whose name nobody gave as an output."""
    from cvtgs.streams.files import is_replaced

    file = Path(os.path.realpath(cvtgs.io.scene_file(options.input)))
    for place in (file, file.parent):  # a SOG is a folder
        replaced = any(is_same_file(options.output / name, place) for name in names)
        if options.stream is not None:
            is_inside = is_same_file(place.parent, options.output)
            replaced = is_inside and is_replaced(place.name, options.stream)
        if replaced:
            raise InvalidArgumentError(
                f"{options.input}: a level must not replace the scene; choose another folder."
            )


def _cameras_to_fit(
    options: argparse.Namespace, scene: "cvtgs.GaussianScene"
) -> "cvtgs.Cameras | None":
    """Read the cameras for presets that use images: not the split, by which levels are scored."""
    if options.cameras is not None:
        return cvtgs.load_cameras(options.cameras, split=options.split and "train")
    own = own_cameras(options, scene, options.input)
    return None if own is None else own.cameras


def _checked_views(
    options: argparse.Namespace,
    scene: "cvtgs.GaussianScene",
    settings: "cvtgs.evaluation.EvaluationSettings",
) -> "cvtgs.Cameras":
    """Return the views that score; raise before the long work if the levels cannot be scored."""
    from cvtgs.devices import chosen_device
    from cvtgs.evaluation.compare import check_scores

    full = cvtgs.validity.valid_part(scene).to(chosen_device(options.device))
    views = choose_cameras(options, full)
    check_scores(full, views, settings=settings, name=options.input.name)
    return views


def _score(
    options: argparse.Namespace,
    scene: "cvtgs.GaussianScene",
    names: Sequence[str],
    views: "cvtgs.Cameras",
    settings: "cvtgs.evaluation.EvaluationSettings",
    listener: "cvtgs.ProgressListener",
) -> "cvtgs.evaluation.Evaluation":
    """Score the files of the levels against the full scene."""
    from cvtgs.devices import chosen_device

    device, axes = chosen_device(options.device), options.axes.target
    full = cvtgs.validity.valid_part(scene).to(device)
    files = {
        name: cvtgs.load(options.output / name, axes=axes, trust_sizes=True).to(device)
        for name in names
    }
    return cvtgs.evaluate(full, files, views, settings=settings, listener=listener)


def _say_levels(index: "cvtgs.levels.LevelsIndex", made: "Sequence[cvtgs.Level]") -> None:
    """Print the table of the levels, and which have fewer Gaussians than asked for."""
    say(f"{index.source}, {counted(index.source_count, 'Gaussian')}:")
    rows = [["", "Gaussians", "size", "error", "PSNR", "alpha", "seconds"]]
    for level in index.levels:
        psnr = "-" if level.psnr is None else f"{level.psnr:.2f}"
        alpha = "-" if level.alpha_error is None else f"{level.alpha_error:.4f}"
        error, seconds = f"{level.geometric_error:.3g}", f"{level.seconds:.2f}"
        size = size_text(level.bytes)
        rows.append([level.file, f"{level.count:,}", size, error, psnr, alpha, seconds])
    say_table(rows)
    for report in (level.report for level in made):
        if report.shortfall:
            say(shortfall_note(report))


def _say_older(options: argparse.Namespace, names: Sequence[str]) -> None:
    """Name the levels in the folder that an earlier run left there."""
    older = {path.name for path in options.output.glob("rho_*")} - {*names, options.input.name}
    if older:
        listed = ", ".join(map(printable, sorted(older)))
        say_wrapped(f"Not in {cvtgs.levels.INDEX_NAME}, of an earlier run: {listed}.")
