"""``cvtgs levels --stream``: levels in chunks that viewers load progressively."""

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import zip_longest

import cvtgs
from cvtgs.cli.blocks import (
    add_block_options,
    block_workers,
    check_block_device,
    check_given_memory,
    memory_of,
    unused_block_options,
)
from cvtgs.cli.display import progress_bars, say, say_table, say_wrapped, shortfall_note
from cvtgs.cli.options import checkpoint_of, read_numbers
from cvtgs.errors import ConfigError, FileFormatError, InputError, InvalidArgumentError
from cvtgs.io.atomic import make_folder
from cvtgs.text import size_text

STREAMS = ("sog", "3dtiles")
OF_STREAMS = {  # kinds by option
    **dict.fromkeys(("chunk", "memory", "workers", "scheduler"), STREAMS),
    "environment": ("sog",),
    **dict.fromkeys(("place", "transform"), ("3dtiles",)),
}
OF_SCORES = {"views": None, "size": None, "background": "black", "backend": "auto"}  # defaults


def add_stream_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--stream`` and its related options."""
    parser.add_argument(
        "--stream",
        choices=STREAMS,
        help="write chunks that viewers load progressively, instead of whole scenes: sog "
        "(lod-meta.json, for PlayCanvas and SuperSplat) or 3dtiles (tileset.json, for CesiumJS)",
    )
    parser.add_argument(
        "--chunk",
        type=int,
        metavar="N",
        help="most Gaussians per chunk of a stream, at its finest level, where the coarsest "
        "level has more than one to divide (default 32768)",
    )
    parser.add_argument(
        "--environment",
        type=float,
        metavar="RADII",
        help="distance from the centre beyond which Gaussians are the environment of a streamed "
        "SOG, which all levels share; in robust radii, one of which holds 70 %% of the Gaussians, "
        "for example 10 for a sky",
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--place",
        metavar="LON,LAT[,H]",
        help="longitude, latitude (degrees) and height (metres) of the origin of 3D Tiles; the "
        "scene's right points east, its forward north (a PLY of x east, y north, z up needs "
        "--axes rfu)",
    )
    place.add_argument(
        "--transform",
        metavar="N,N,...",
        help="column-major transform of 3D Tiles instead of --place, from x left, y back and z "
        "up in the scene",
    )
    add_block_options(parser)


def check_stream_options(options: argparse.Namespace) -> None:
    """Check the options of streams before the long work starts."""
    from cvtgs.streams.files import check_stream

    scoring = [name for name, default in OF_SCORES.items() if getattr(options, name) != default]
    if options.no_scores and scoring:
        raise InvalidArgumentError(f"--{scoring[0]} cannot be used with --no-scores.")
    for name, kinds in OF_STREAMS.items():
        if getattr(options, name) is not None and options.stream not in kinds:
            kind = "" if kinds == STREAMS else f" {kinds[0]}"
            found = "" if options.stream is None else f", found {options.stream}"
            raise InvalidArgumentError(f"--{name} needs --stream{kind}{found}.")
    if options.stream is None:
        return
    given = (name for name in ("viewer", "suffix", "no_scores") if getattr(options, name))
    excluded = [name.replace("_", "-") for name in given] + scoring
    if excluded:
        raise InvalidArgumentError(
            f"--{excluded[0]} cannot be used with --stream, which sets the format, is for viewers "
            f"that load chunks, and is not scored."
        )
    if options.stream == "3dtiles" and options.axes.target is not None:
        raise InvalidArgumentError(
            "--axes IN:OUT cannot be used with --stream 3dtiles, whose axes are fixed (z up); give "
            "only those of IN."
        )
    if options.chunk is not None and options.chunk < 1:
        raise InvalidArgumentError(f"--chunk must be at least 1, found {options.chunk}.")
    far = options.environment
    if far is not None and not 0 < far < math.inf:
        raise InvalidArgumentError(f"--environment must be above 0, found {far:g}.")
    read_transform(options)
    make_folder(options.output.parent)
    check_stream(options.output, options.stream, overwrite=options.overwrite)


def read_transform(options: argparse.Namespace) -> tuple[float, ...] | None:
    """Read ``--place`` or ``--transform``; return None if neither is given."""
    from cvtgs.streams import geo_transform
    from cvtgs.streams.tiles import check_transform

    if options.place is None and options.transform is None:
        return None
    if options.transform is not None:
        return check_transform(read_numbers("--transform", options.transform, 16))
    longitude, latitude, *height = read_numbers("--place", options.place, 2, 3)
    try:
        return geo_transform(longitude, latitude, *height)
    except InvalidArgumentError as error:
        raise InvalidArgumentError(f"--place: {error}") from None


def stream_blocks(
    options: argparse.Namespace, config: "cvtgs.SimplifyConfig", rhos: Sequence[float]
) -> bool:
    """Write a stream in blocks if the scene does not fit into memory; return whether it did."""
    from cvtgs.io.axes import SCENE_AXES
    from cvtgs.io.ply import open_rows
    from cvtgs.outofcore.memory import IMAGE_BYTES, block_count, merging_in_levels
    from cvtgs.outofcore.run import check_config
    from cvtgs.streams import stream_file
    from cvtgs.streams.plan import CHUNK_GAUSSIANS

    memory, asked = memory_of(options), options.memory is not None
    try:
        if options.scheduler is None:
            rows = open_rows(options.input)
            targets = [cvtgs.target_count(rows.count, rho) for rho in rhos]
            merging = merging_in_levels(targets, rows, config.allocation)
            check_given_memory(options, memory, config)
            room = memory - IMAGE_BYTES if config.uses_images else memory
            if block_count(rows, room, merging=merging) == 1:
                return False
        check_block_device(options)
        check_config(config, with_images=False)
    except (InputError, FileFormatError, ConfigError, InvalidArgumentError):
        if options.scheduler is not None or (asked and options.input.suffix.lower() == ".ply"):
            raise
        return False
    if options.cameras is not None:
        raise InvalidArgumentError(
            "blocks cannot be used with --cameras, which need the whole scene."
        )
    if options.rho is None:
        total = open_rows(options.input).count
        rhos = of_different_sizes(rhos, total, total)
    with (
        progress_bars(quiet=options.quiet) as listener,
        block_workers(options, memory) as (workers, share),
    ):
        report = stream_file(
            options.input,
            options.output,
            rhos,
            kind=options.stream,
            memory=share,
            chunk_gaussians=options.chunk or CHUNK_GAUSSIANS,
            environment_radii=options.environment,
            transform=read_transform(options),
            axes=(options.axes.source or SCENE_AXES, options.axes.target or SCENE_AXES),
            sh_degree=options.sh_degree,
            simplifier=cvtgs.Simplifier(checkpoint_of(options), config=config, device="cpu"),
            workers=workers,
            overwrite=options.overwrite,
            listener=listener,
        )
    done = f", {report.resumed_blocks} of them from an earlier run" if report.resumed_blocks else ""
    _print_levels(options, report.chunks, report.levels, f" and {report.blocks} blocks{done}")
    return True


def of_different_sizes(rhos: Sequence[float], total: int, valid: int) -> list[float]:
    """Return descending ratios without those whose levels have the size of a larger one."""
    sizes = {min(cvtgs.target_count(total, rho), valid): rho for rho in sorted(rhos)}
    return sorted(sizes.values(), reverse=True)


def stream_levels(
    options: argparse.Namespace, made: "Sequence[cvtgs.Level]", listener: "cvtgs.ProgressListener"
) -> None:
    """Write levels that are in memory as a stream, and print its contents."""
    from cvtgs.outofcore.folders import remove_job_files
    from cvtgs.streams import plan_stream, write_sog_stream, write_tiles
    from cvtgs.streams.plan import CHUNK_GAUSSIANS

    if (target := options.axes.target) is not None:
        made = [
            level._replace(scene=cvtgs.io.change_axes(level.scene, "rdf", target)) for level in made
        ]
    plan = plan_stream(
        made,
        chunk_gaussians=options.chunk or CHUNK_GAUSSIANS,
        environment_radii=options.environment,
    )
    write: Callable[..., tuple[cvtgs.streams.StreamLevel, ...]] = write_sog_stream
    if options.stream == "3dtiles":
        write = partial(write_tiles, transform=read_transform(options))
    written = write(plan, options.output, overwrite=options.overwrite, listener=listener)
    remove_job_files(options.output, is_stream=True)
    errors = [level.geometric_error for level in plan.levels]
    if made[0].report.shortfall and not options.quiet:
        say(shortfall_note(made[0].report))
    if not options.quiet:
        for note in unused_block_options(options):
            say(note)
    _print_levels(options, len(plan.chunks), written, errors=errors)


def _print_levels(
    options: argparse.Namespace,
    chunks: int,
    levels: "Sequence[cvtgs.streams.StreamLevel]",
    more: str = "",
    *,
    errors: Sequence[float] = (),
) -> None:
    from cvtgs.streams.sog import ENVIRONMENT

    if options.quiet:
        return
    number = "one chunk" if chunks == 1 else f"{chunks:,} chunks"
    say(f"{options.input.name} in {number}{more}, the finest level first:")
    rows = [["", "Gaussians", "size", "files", "error" if errors else ""]]
    for one, error in zip_longest(levels, errors):
        last = "" if error is None else f"{error:.3g}"
        rows.append(["", f"{one.gaussians:,}", size_text(one.bytes), f"{one.files:,}", last])
    say_table(rows)
    if options.environment is not None and (options.output / ENVIRONMENT).exists():
        say_wrapped(
            f"Not counted: the environment beyond {options.environment:g} times the robust radius, "
            "which all levels share."
        )
    if any(one.gaussians == 0 for one in levels):
        say_wrapped(
            "Levels of 0 Gaussians are skipped: the tree of tiles is less deep than there are "
            "levels, since the tiles of a finer one are small enough."
        )
