"""``cvtgs simplify``: simplify scenes to a size, quality or time, in memory or in blocks."""

import argparse
import json
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import cvtgs
from cvtgs.cli.blocks import (
    add_block_options,
    block_memory,
    memory_of,
    needs_blocks,
    simplify_blocks,
    unused_block_options,
)
from cvtgs.cli.cameras import check_split, own_cameras, read_cameras
from cvtgs.cli.display import TIE, progress_bars, report_notes
from cvtgs.cli.goals import (
    STARTED,
    check_goals,
    choose_preset,
    has_target,
    search_target,
    views_of_search,
    with_limited_bands,
)
from cvtgs.cli.jobs import Outcome, add_paths, make_output_folder, open_jobs, run_jobs
from cvtgs.cli.options import (
    CAMERA_FILES,
    AddParser,
    add_options,
    checkpoint_of,
    count,
    ratio,
    read_config,
    read_scene,
    read_settings,
    seconds,
)
from cvtgs.cli.paths import any_path, check_written_files, new_file
from cvtgs.errors import InvalidArgumentError, OutputError, OutputExistsError, warn
from cvtgs.io.atomic import write_atomically
from cvtgs.progress import ProgressListener, silent
from cvtgs.text import counted


def add_simplify(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "simplify",
        help="simplify scenes",
        description="Write a scene with exactly ceil(rho * N) of the N Gaussians of IN.",
    )
    parser.set_defaults(run=simplify)
    add_paths(parser, options="--rho R|--count M|... ")
    size = parser.add_mutually_exclusive_group(required=True)
    size.add_argument(
        "--rho",
        type=ratio,
        metavar="R",
        help="ratio of Gaussians to keep, above 0 and at most 1, for example 0.05 or 5%%",
    )
    size.add_argument(
        "--count",
        type=count,
        metavar="M",
        help="number of Gaussians to keep, for example 50000, 50,000, 5e4, 50k or 1.5M",
    )
    size.add_argument(
        "--max-count",
        type=count,
        metavar="M",
        help="largest number of Gaussians to keep; a smaller scene stays as it is",
    )
    size.add_argument(
        "--target-psnr",
        type=float,
        metavar="DB",
        help="PSNR (at most 60) that OUT is to reach with as few Gaussians as possible, over "
        "--cameras, those beside IN or the automatic views of cvtgs evaluate; presets that use "
        "images are fitted to the training split of these cameras and scored over the test split, "
        "or over other automatic views if it has fewer than four; every try is written and read, "
        "which takes long for .sog",
    )
    size.add_argument(
        "--target-ssim",
        type=float,
        metavar="S",
        help="SSIM to reach in the same way, for example 0.9",
    )
    parser.add_argument(
        "--time-budget",
        type=seconds,
        metavar="TIME",
        help="use the best preset that is predicted to take at most this time for a scene, for "
        "example 20s or 2m; the first use measures this machine, which takes about 10 seconds and "
        "does not count",
    )
    rates = parser.add_mutually_exclusive_group()
    rates.add_argument(
        "--shipped-rates",
        action="store_true",
        help="choose the preset for --time-budget by the timings of another machine, shipped with "
        "cvtgs, instead of measuring this one",
    )
    rates.add_argument(
        "--recalibrate", action="store_true", help="measure this machine again for --time-budget"
    )
    add_options(parser, "--preset", "--ckpt", "--config", "--set", "--effects")
    parser.add_argument(
        "--refine",
        type=seconds,
        metavar="TIME",
        help="time limit, for example 30s, of refining the result against images of IN, as long as "
        "held-out views improve; finding views and rendering the first images counts, and takes "
        "seconds on a CPU, even if TIME is less; 0 turns off the refinement of a preset",
    )
    parser.add_argument(
        "--refine-steps", type=int, metavar="N", help="step limit of refining the result"
    )
    add_options(
        parser,
        "--cameras",
        "--split",
        cameras="cameras to render from, for --refine and for presets that render: "
        f"{CAMERA_FILES} (default: those beside IN or in its folder, if they show the scene, "
        "else automatic views)",
    )
    parser.add_argument(
        "--keep",
        type=any_path,
        metavar="BOX.json",
        help="boxes whose Gaussians stay unchanged; they come first in a .ply OUT and count "
        'towards its size: {"min": [x, y, z], "max": [x, y, z]}, or a list of these',
    )
    add_block_options(parser)
    parser.add_argument(
        "--report",
        type=partial(new_file, kind=".json"),
        metavar="R.json",
        help="file for a JSON report of the run; with -o DIR, a list of the input, output, error "
        "and report of each scene",
    )
    add_options(parser, "--sh-degree", "--axes", "--lod", "--device", "--trust-sizes")
    add_options(parser, "--overwrite", "--quiet")


def simplify(options: argparse.Namespace) -> None:
    """Run ``cvtgs simplify``."""
    check_split(options)
    check_goals(options)
    settings = _refine_settings(options) | read_settings(options.settings, options.effects)
    config = read_config(options, settings)
    with open_jobs(options) as jobs:
        for job in jobs:
            check_written_files(job)
            cvtgs.io.check_save(job.output, overwrite=options.overwrite)
        if options.report is not None:
            cvtgs.io.check_output(options.report, overwrite=options.overwrite)
        entries: list[dict[str, Any]] = []  # of many scenes

        def keep(
            job: argparse.Namespace, *, error: str | None = None, report: object = None
        ) -> None:
            paths = {"input": str(job.input), "output": str(job.output)}
            entries.append({**paths, "error": error, "report": report})

        def work(job: argparse.Namespace) -> Outcome:
            outcome, report = _simplify_one(job, config, settings)
            for other in jobs:
                other.recalibrate = False  # once is enough
            if job.folder is None:
                _write_report(options, report.to_json(), f"the scene {job.output} was")
            else:
                keep(job, report=json.loads(report.to_json()))
            return outcome

        def write_entries() -> None:
            if entries:
                text = json.dumps(entries, indent=2) + "\n"
                done = sum(entry["error"] is None for entry in entries)
                scenes = f"{done} of {len(entries)} scenes in {options.folder}"
                _write_report(options, text, f"{scenes} were")

        try:
            run_jobs(jobs, work, failed=lambda job, error: keep(job, error=str(error)))
        except BaseException:  # some of many scenes failed, or an interrupt
            try:
                write_entries()
            except OutputError as error:
                warn(str(error))  # the first error is the one to report
            raise
        write_entries()


def _write_report(options: argparse.Namespace, text: str, written: str) -> None:
    """Write the file of ``--report``, if it was asked for."""
    if options.report is None:
        return
    try:
        write_atomically(options.report, text.encode(), overwrite=options.overwrite)
    except (OutputError, OutputExistsError) as error:
        reason = str(error).removesuffix("; nothing was written.").rstrip(".")
        raise OutputError(f"{reason}; {written} written, the report was not.") from error


def _simplify_one(
    options: argparse.Namespace, config: "cvtgs.SimplifyConfig", settings: Mapping[str, str]
) -> "tuple[Outcome, cvtgs.SimplifyReport]":
    """Simplify one scene, in memory or block by block; return the result to print and report."""
    notes, is_one_of_many = list[str](), options.folder is not None
    options.begun = time.perf_counter() if is_one_of_many else STARTED
    with progress_bars(quiet=options.quiet, transient=is_one_of_many) as listener:
        memory = block_memory(options, config)
        if memory is not None:
            report = simplify_blocks(options, config, memory, listener)
            if options.cameras is None and report.views not in ("found", "none"):
                notes.append(f"Rendered from {report.views} found beside {options.input}.")
        else:
            report, notes = _simplify_in_memory(options, config, settings, listener)
        used = report.config
        if options.cameras is not None and not (has_target(options) or used.uses_images):
            notes.append(f"--cameras was not used: {used.preset} renders no images.")
        if unused := _unused(settings, used):
            notes.append(
                f"--set {' '.join(unused)} had no effect: {used.preset} uses no such images."
            )
    searched = has_target(options)
    if not is_one_of_many and report.stages:
        seconds = (f"{stage.stage}{TIE}{stage.seconds:.2f}" for stage in report.stages)
        of_what = " of all tries" if searched else ""
        notes.insert(0, f"Seconds{of_what}: {', '.join(seconds)}.")
    if memory is None:
        notes += unused_block_options(options)
    if report.kept_count:
        notes.append(f"{counted(report.kept_count, 'Gaussian')} in the boxes of --keep.")
        name = options.output.name.lower()
        if name.endswith(".compressed.ply") or not name.endswith(".ply"):
            notes.append("Only a plain .ply has them first, and bit for bit as they were.")
    elif options.keep is not None:
        warn(f"{options.keep}: no Gaussian is in the boxes of --keep, so none is protected.")
    total = time.perf_counter() - options.begun if searched else report.seconds
    outcome = Outcome(
        f"{report.input_count:,} -> {counted(report.output_count, 'Gaussian')}",
        f"{total:.2f} s",
        notes + report_notes(report),
    )
    return outcome, report


def _unused(settings: Mapping[str, str], config: "cvtgs.SimplifyConfig") -> list[str]:
    """Return the names of settings of images that a configuration does not render."""
    switches = {"visibility.views", "refine.steps", "refine.seconds"}  # may have said so
    rendered = {"visibility": config.uses_renders, "match": config.uses_renders}
    rendered["refine"] = config.refine.enabled
    return [
        name
        for name in settings
        if not rendered.get(name.partition(".")[0], True) and name not in switches
    ]


def _simplify_in_memory(
    options: argparse.Namespace,
    config: "cvtgs.SimplifyConfig",
    settings: Mapping[str, str],
    listener: ProgressListener,
) -> "tuple[cvtgs.SimplifyReport, list[str]]":
    """Read, simplify and save a scene; return the report and notes to print with it."""
    from cvtgs.outofcore.folders import remove_job_files

    notes = []
    axes = options.axes
    search = has_target(options)  # results are scored against all of IN
    scene = read_scene(options, config, axes=axes.source, all_bands=search)
    if search:
        config = with_limited_bands(config, options.sh_degree)
    cameras, own, chosen = read_cameras(options), None, None
    if cameras is None and (search or config.uses_images or options.time_budget is not None):
        own = own_cameras(options, scene, options.input)
        cameras = None if own is None else own.cameras
    if options.time_budget is not None:
        rendering = cvtgs.SimplifyConfig(preset="matched")
        fits = options.memory is None or not needs_blocks(options, memory_of(options), rendering)
        chosen = choose_preset(
            options, scene, settings, listener, cameras=cameras, with_images=fits
        )
        config = cvtgs.SimplifyConfig.compose(preset=chosen.name, settings=settings)
        notes.append(chosen.reason)
    views = views_of_search(options, config, cameras, own) if search else None
    if views is not None:
        cameras = views.cameras
    if own is not None and cameras is not None and config.uses_images:
        many = counted(len(cameras), "camera")
        notes.append(f"Rendered from {many} found in {own.source.resolve()}.")
    simplifier = cvtgs.Simplifier(
        checkpoint_of(options),
        config=config,
        device=options.device,
        listener=silent if search else listener,
    )
    if views is not None:
        found, scores = search_target(
            options, scene, simplifier, views=views, axes=axes.target, listener=listener
        )
        small, report = found.scene, found.report
        if options.sh_degree is not None:
            small = small.with_sh_degree(options.sh_degree)
        notes.append(scores)
    else:
        keep = None
        if options.keep is not None:
            keep = cvtgs.boxes.inside(cvtgs.boxes.read_boxes(options.keep), scene.means)
        small, report = simplifier.run(
            scene,
            options.rho,
            count=options.count,
            max_count=options.max_count,
            cameras=cameras,
            keep=keep,
        )
    del scene  # its memory is enough for what most formats encode
    started = time.perf_counter()
    make_output_folder(options)
    cvtgs.io.save(small, options.output, overwrite=options.overwrite, axes=axes.target)
    took = report.seconds + time.perf_counter() - started
    if chosen is not None and took > chosen.left:
        notes.append(
            f"Simplifying and writing took {took:.1f} s, where {chosen.left:.1f} s were left; "
            f"{chosen.advice}."
        )
    remove_job_files(options.output)
    return report, notes


def _refine_settings(options: argparse.Namespace) -> dict[str, str]:
    """Return the settings of ``--refine`` and ``--refine-steps``; either option sets both."""
    limits = (options.refine, options.refine_steps)
    if limits == (None, None):
        return {}
    if options.refine_steps is not None and options.refine_steps < 0:
        raise InvalidArgumentError(f"--refine-steps must be at least 0, found {limits[1]}.")
    if None not in limits and 0 in limits and limits != (0, 0):
        raise InvalidArgumentError(
            "--refine and --refine-steps must both be above 0, or one of them be left out: 0 turns "
            f"refinement off; found {options.refine:g} and {options.refine_steps}."
        )
    steps, seconds = options.refine_steps or 0, options.refine or 0.0
    exact = {"refine.lengthening": "1"} if steps else {}
    return {"refine.steps": str(steps), "refine.seconds": str(seconds), **exact}
