"""``cvtgs levels``: several sizes of one scene, and an index for viewers."""

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import cvtgs
from cvtgs.cli.display import progress_bars, say, size_text
from cvtgs.cli.options import (
    AddParser,
    FileAxes,
    add_options,
    add_view_options,
    check_view_options,
    choose_cameras,
    evaluation_settings,
    read_axes,
    read_ratios,
    read_settings,
)
from cvtgs.errors import InvalidArgumentError

if TYPE_CHECKING:
    from cvtgs.evaluation import Evaluation
    from cvtgs.levels import LevelsIndex
    from cvtgs.progress import ProgressListener
    from cvtgs.report import Level
    from cvtgs.scene import GaussianScene


STREAMS = ("sog", "3dtiles")
PLAIN_RHOS, STREAM_RHOS = "0.1,0.01,0.001", "1,0.25,0.06,0.015"


def add_levels(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "levels",
        help="make several sizes of a scene at once",
        description="Write IN in several sizes, each an ordinary scene of exactly ceil(rho * N) "
        "Gaussians, and levels.json with counts, bytes, scores, geometric errors and boxes. It "
        "takes little more time than the finest size alone, plus the time of the scores "
        "(--no-scores).",
    )
    parser.set_defaults(run=levels)
    add_options(parser, "input", "-o/--output")
    parser.add_argument(
        "--rho",
        metavar="R,R",
        help="ratios of Gaussians to keep (default 0.1,0.01,0.001; of --stream 1,0.25,0.06,0.015)",
    )
    parser.add_argument("--suffix", metavar="END", help="format of the files (default .ply)")
    parser.add_argument(
        "--stream",
        choices=STREAMS,
        help="write chunks that viewers load while they show them, instead of whole scenes: sog "
        "(lod-meta.json, for PlayCanvas and SuperSplat) or 3dtiles (tileset.json, for CesiumJS)",
    )
    parser.add_argument(
        "--chunk",
        type=int,
        metavar="N",
        help="Gaussians in a chunk of a stream at its finest level (default 32768)",
    )
    add_options(parser, "--preset", "--ckpt", "--config", "--set", "--sh-degree", "--axes")
    parser.add_argument(
        "--no-scores", action="store_true", help="skip rendering and scoring the levels"
    )
    add_options(parser, "--trust-sizes", "--overwrite")
    add_view_options(parser, size=400)


def levels(options: argparse.Namespace) -> None:
    """Run ``cvtgs levels``."""
    check_view_options(options)
    axes = read_axes(options.axes)
    default = PLAIN_RHOS if options.stream is None else STREAM_RHOS
    rhos = sorted(read_ratios(options.rho or default), reverse=True)
    for rho in rhos:
        cvtgs.target_count(1, rho)
    suffix = options.suffix or ".ply"
    names = cvtgs.levels.level_names(rhos, suffix)
    _check_output(options, names)
    config = cvtgs.SimplifyConfig.compose(
        file=options.config, preset=options.preset, settings=read_settings(options.settings)
    )
    checkpoint = None if options.ckpt == "none" else options.ckpt
    with progress_bars(quiet=options.quiet) as listener:
        simplifier = cvtgs.Simplifier(
            checkpoint, config=config, device=options.device, listener=listener
        )
        scene = cvtgs.load(options.input, axes=axes.source, trust_sizes=options.trust_sizes)
        if options.sh_degree is not None:
            scene = scene.with_sh_degree(options.sh_degree)
        cameras = None if options.cameras is None else cvtgs.load_cameras(options.cameras)
        if cameras is None and axes.source is None:
            own = cvtgs.views.find_own_cameras(scene, options.input)
            cameras = None if own is None else own.cameras
        made = simplifier.levels(scene, rhos, cameras=cameras)
        if options.stream is not None:
            _write_stream(options, made, axes, listener)
            return
        index = cvtgs.levels.write_levels(
            made,
            options.output,
            rhos=rhos,
            source=options.input.name,
            suffix=suffix,
            axes=axes.target,
            overwrite=options.overwrite,
        )
        if not options.no_scores:
            files = {
                name: cvtgs.load(options.output / name, axes=axes.target, trust_sizes=True)
                for name in names
            }
            evaluation = _score(options, scene, files, listener)
            index = cvtgs.levels.add_scores(options.output, evaluation)
    if not options.quiet:
        _print_index(index)


def _check_output(options: argparse.Namespace, names: Sequence[str]) -> None:
    """Check options and outputs of levels or of a stream, before the long work that comes first."""
    from cvtgs.levels import check_levels
    from cvtgs.streams import check_stream

    if options.stream is None:
        if options.chunk is not None:
            raise InvalidArgumentError("--chunk goes with --stream.")
        check_levels(options.output, names, overwrite=options.overwrite)
        return
    if options.suffix is not None:
        raise InvalidArgumentError("--suffix cannot go with --stream, which sets the format.")
    if options.chunk is not None and options.chunk < 1:
        raise InvalidArgumentError(f"--chunk must be at least 1, found {options.chunk}.")
    check_stream(options.output, options.stream, overwrite=options.overwrite)


def _write_stream(
    options: argparse.Namespace,
    made: "Sequence[Level]",
    axes: "FileAxes",
    listener: "ProgressListener",
) -> None:
    """Write levels as a stream, and say what is in it."""
    from cvtgs.streams import plan_stream, write_sog_stream, write_tiles
    from cvtgs.streams.plan import CHUNK_GAUSSIANS

    if axes.target is not None:
        made = [
            level._replace(scene=cvtgs.io.change_axes(level.scene, "rdf", axes.target))
            for level in made
        ]
    plan = plan_stream(made, chunk_gaussians=options.chunk or CHUNK_GAUSSIANS)
    write = write_sog_stream if options.stream == "sog" else write_tiles
    written = write(plan, options.output, overwrite=options.overwrite, listener=listener)
    if options.quiet:
        return
    say(f"{options.input.name} in {len(plan.chunks):,} chunks, the finest level first:")
    say(f"  {'Gaussians':>12}  {'size':>9}  {'files':>6}  {'error':>9}")
    for level, one in zip(plan.levels, written, strict=True):
        say(
            f"  {one.gaussians:>12,}  {size_text(one.bytes):>9}  {one.files:>6,}  "
            f"{level.geometric_error:>9.3g}"
        )


def _score(
    options: argparse.Namespace,
    scene: "GaussianScene",
    levels: "Mapping[str, GaussianScene]",
    listener: "ProgressListener",
) -> "Evaluation":
    from cvtgs.devices import chosen_device

    device = chosen_device(options.device)
    full = scene.select(cvtgs.validity.valid_rows(scene)).to(device)
    return cvtgs.evaluate(
        full,
        {name: level.to(device) for name, level in levels.items()},
        choose_cameras(options, full),
        settings=evaluation_settings(options),
        listener=listener,
    )


def _print_index(index: "LevelsIndex") -> None:
    width = max(len(level.file) for level in index.levels)
    say(f"{index.source}, {index.source_count:,} Gaussians:")
    say(
        f"  {'':{width}}  {'Gaussians':>12}  {'size':>9}  {'error':>9}  {'PSNR':>6}  "
        f"{'alpha':>6}  seconds"
    )
    for level in index.levels:
        psnr = "-" if level.psnr is None else f"{level.psnr:.2f}"
        alpha = "-" if level.alpha_error is None else f"{level.alpha_error:.4f}"
        say(
            f"  {level.file:{width}}  {level.count:>12,}  {size_text(level.bytes):>9}  "
            f"{level.geometric_error:>9.3g}  {psnr:>6}  {alpha:>6}  {level.seconds:.2f}"
        )
