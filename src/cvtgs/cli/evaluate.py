"""``cvtgs render``, ``evaluate``, ``compare`` and ``tradeoff``: images and scores of scenes."""

import argparse
import re
from collections.abc import Sequence
from functools import partial
from pathlib import PurePosixPath, PureWindowsPath

import cvtgs
from cvtgs.cli.cameras import (
    SCORED_SIZE,
    add_view_options,
    choose_cameras,
    evaluation_settings,
    say_views,
)
from cvtgs.cli.display import progress_bars, say, say_table, say_wrapped, shortfall_note
from cvtgs.cli.jobs import expanded
from cvtgs.cli.options import CAMERA_FILES, AddParser, add_options, read_words
from cvtgs.cli.view import PAGE, check_page, write_page
from cvtgs.errors import InvalidArgumentError, RunError, warn
from cvtgs.io.atomic import make_folder, windows_fault, write_atomically
from cvtgs.progress import ProgressEvent
from cvtgs.text import MOST_LETTERS, counted, printable_name, size_text

MOST_CAMERAS = 8  # that a page shows, and that ``tradeoff`` scores from, by default
ALPHA_MEANS = "alpha: mean |difference| of coverage; bias < 0: more of the background shows"


def add_render(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "render",
        help="write images of a scene",
        description="Write one PNG per view into DIR, named after the cameras.",
    )
    parser.set_defaults(run=render)
    add_options(parser, "input", "-o/--output", "--trust-sizes", "--overwrite")
    add_view_options(parser, size=800)


def render(options: argparse.Namespace) -> None:
    """Run ``cvtgs render``."""
    import torch

    from cvtgs.devices import chosen_device
    from cvtgs.evaluation.images import as_bytes, encode
    from cvtgs.rendering.render import LEAST_COVER

    settings = evaluation_settings(options)
    scene = cvtgs.io.load(options.input, trust_sizes=options.trust_sizes)
    scene = scene.to(chosen_device(options.device))
    cameras = choose_cameras(options, scene)
    make_folder(options.output)
    paths = [options.output / name for name in file_names(cameras.view_names)]
    for path in paths:
        cvtgs.io.check_output(path, overwrite=options.overwrite)
    most_seen = 0.0
    with progress_bars(quiet=options.quiet) as listener, torch.no_grad():
        for number, (path, camera) in enumerate(zip(paths, cameras.singles(), strict=True)):
            listener(ProgressEvent(stage="render", done=number, total=len(paths)))
            found = cvtgs.render(
                scene, camera, backend=settings.backend, background=settings.background
            )
            most_seen = max(most_seen, float(found.alpha.mean()))
            png = encode(as_bytes(found.rgb[0]), "png")
            write_atomically(path, png, overwrite=options.overwrite)
        listener(ProgressEvent(stage="render", done=len(paths), total=len(paths)))
    if most_seen < LEAST_COVER:
        warn(
            f"no image shows anything of {options.input.name}; are these cameras of this scene, in "
            f"its axes and units?"
        )
    if not options.quiet:
        images = counted(len(paths), "image")
        say(f"{images} of {cameras.width} x {cameras.height} pixels in {options.output}")


def file_names(views: Sequence[str]) -> list[str]:
    """Return a PNG file name for every view; number all if two views have the same name."""
    stems = []
    for view in views:
        name = PurePosixPath(view.replace("\\", "/")).name
        bare = re.sub(r"\.(png|jpe?g|webp|tiff?|bmp)$", "", name, flags=re.IGNORECASE)
        stem = re.sub(r"[^\w.-]+", "_", bare).strip("._")[:MOST_LETTERS] or "view"
        is_device = windows_fault(PureWindowsPath(stem)) is not None
        stems.append(f"view_{stem}" if is_device else stem)
    if len({stem.lower() for stem in stems}) == len(stems):
        return [f"{stem}.png" for stem in stems]
    return [f"{number:03d}_{stem}.png" for number, stem in enumerate(stems, start=1)]


def _read_scenes(
    options: argparse.Namespace,
) -> "tuple[dict[str, cvtgs.GaussianScene], dict[str, int]]":
    """Read REF and every SMALL, in this order; return scenes and file sizes by name."""
    from cvtgs.devices import chosen_device

    paths = [options.reference, *expanded(options.small)]
    names = [printable_name(path.name) for path in paths]
    names = [
        name if names.count(name) == 1 else printable_name(str(path))
        for name, path in zip(names, paths, strict=True)
    ]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InvalidArgumentError(f"every scene must be given once, found {twice[0]} twice.")
    device = chosen_device(options.device)
    trust = options.trust_sizes
    scenes = [cvtgs.io.load(path, trust_sizes=trust).to(device) for path in paths]
    sizes = [cvtgs.io.scene_size(path) for path in paths]
    return dict(zip(names, scenes, strict=True)), dict(zip(names, sizes, strict=True))


def add_evaluate(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "evaluate",
        help="score simplified scenes against the full one",
        description="Render REF and every SMALL from the same views and print PSNR, SSIM and, if "
        "its weights are installed, LPIPS against the images of REF; with --images also against "
        "photographs.",
    )
    parser.set_defaults(run=evaluate)
    add_options(parser, "reference", "small", "--lpips")
    add_options(parser, "--images", "--json", "--trust-sizes")
    add_view_options(parser, size=SCORED_SIZE)


def evaluate(options: argparse.Namespace) -> None:
    """Run ``cvtgs evaluate``."""
    from cvtgs.evaluation.images import Photographs

    settings = evaluation_settings(options)
    scenes, sizes = _read_scenes(options)
    (name, reference), *others = scenes.items()
    with progress_bars(quiet=options.quiet) as listener:
        cameras = choose_cameras(options, reference)
        photographs = None
        if options.images is not None:
            photographs = Photographs(options.images, cameras, background=settings.background)
        evaluation = cvtgs.evaluate(
            reference,
            dict(others),
            cameras,
            reference_name=name,
            photographs=photographs,
            settings=settings,
            listener=listener,
        )
    if options.json:
        say(evaluation.to_json(), end="")
    elif not options.quiet:
        _print_scores(evaluation, sizes)


def _print_scores(evaluation: "cvtgs.evaluation.Evaluation", sizes: dict[str, int]) -> None:
    say_views(evaluation)
    say(f"against {evaluation.reference}, {counted(evaluation.reference_count, 'Gaussian')}:")
    _print_score_table(evaluation.scenes, sizes)
    say(ALPHA_MEANS)
    if evaluation.photographs:
        say("against photographs:")
        _print_score_table(evaluation.photographs, sizes)
    if evaluation.lpips_sentence:
        say_wrapped(evaluation.lpips_sentence)


def _print_score_table(
    scenes: "tuple[cvtgs.evaluation.SceneScores, ...]", sizes: dict[str, int]
) -> None:
    rows = [["", "Gaussians", "size", "PSNR", "SSIM", "LPIPS"]]
    if scenes[0].alpha_error:
        rows[0] += ["alpha", "bias"]
    for scene in scenes:
        size, lpips = size_text(sizes[scene.name]), scene.lpips
        row = [scene.name, f"{scene.count:,}", size, f"{scene.psnr.mean:.2f}"]
        row += [f"{scene.ssim.mean:.4f}", f"{lpips.mean:.4f}" if lpips else "-"]
        if scene.alpha_error and scene.alpha_bias:
            row += [f"{scene.alpha_error.mean:.4f}", f"{scene.alpha_bias.mean:+z.4f}"]
        rows.append(row)
    say_table(rows)


def add_compare(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "compare",
        help="write a page that shows the full scene and simplified ones side by side",
        description="Write index.html, a single file that works offline, with a divider between "
        "REF and each SMALL; sheet.png, all images with their scores; and errors.png, maps of "
        f"the colour and alpha errors. Scores are those of cvtgs evaluate; at most {MOST_CAMERAS} "
        f"of the --cameras are shown, unless --views sets another number.",
    )
    parser.set_defaults(run=compare)
    add_options(parser, "reference", "small", "--lpips", "-o/--output")
    add_options(parser, "--viewer", "--trust-sizes", "--overwrite")
    add_view_options(parser, size=SCORED_SIZE)


def compare(options: argparse.Namespace) -> None:
    """Run ``cvtgs compare``."""
    from cvtgs.evaluation.comparison_files import check_comparison_files

    settings = evaluation_settings(options)
    check_comparison_files(options.output, overwrite=options.overwrite)
    check_page(options)
    scenes, sizes = _read_scenes(options)
    (name, reference), *others = scenes.items()
    with progress_bars(quiet=options.quiet) as listener:
        comparison = cvtgs.evaluation.compare(
            reference,
            dict(others),
            choose_cameras(options, reference),
            reference_name=name,
            sizes=sizes,
            most_images=options.views or MOST_CAMERAS,
            settings=settings,
            listener=listener,
        )
        paths = cvtgs.evaluation.write_comparison(
            comparison,
            options.output,
            overwrite=options.overwrite,
            viewer=PAGE if options.viewer else "",
            listener=listener,
        )
    if not options.quiet:
        _print_scores(comparison.evaluation, sizes)
        say(f"Wrote {', '.join(path.name for path in paths)}. Open {paths[-1]} in a browser.")
    write_page(options, scenes)


def add_tradeoff(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "tradeoff",
        help="run all presets on a scene and show quality against time",
        description="Simplify IN with every preset, each run in its own process, score the results "
        "against IN, print a table, and write tradeoff.csv, tradeoff.json, tradeoff.png (needs the "
        "extra plots) and index.html, a single file that works offline. If the cameras beside IN "
        "have a test split (every eighth, for example), scores are from this split, and presets "
        "that use images are fitted to the other cameras.",
    )
    parser.set_defaults(run=tradeoff)
    add_options(parser, "input", "--rho")
    parser.add_argument("--presets", metavar="NAME,NAME", help="presets to run (default: all)")
    add_options(parser, "-o/--output")
    parser.add_argument(
        "--save", action="store_true", help="also write the simplified scenes to DIR"
    )
    add_options(parser, "--lpips", "--images", "--trust-sizes", "--overwrite")
    add_view_options(
        parser,
        size=SCORED_SIZE,
        cameras=f"cameras to score from: {CAMERA_FILES} (default: those beside IN or in its "
        "folder, if they show the scene, else automatic views); presets that use images are "
        "fitted to cameras beside IN, not to these",
        split="split of --cameras to score from (default: all of --cameras)",
        views=f"number of views to score from (default {MOST_CAMERAS}); they are spread evenly "
        "over the cameras, all of which are used if there are fewer",
    )


def tradeoff(options: argparse.Namespace) -> None:
    """Run ``cvtgs tradeoff``."""
    from cvtgs.tradeoff.files import check_tradeoff_files
    from cvtgs.tradeoff.measure import tasks_of

    settings = evaluation_settings(options)
    photographs = None
    if options.images is not None:
        read = cvtgs.evaluation.load_photographs
        photographs = partial(read, options.images, background=settings.background)
    presets = None if options.presets is None else read_words(options.presets)
    kept = tuple(task.file_name for task in tasks_of(presets, options.rho) if options.save)
    check_tradeoff_files(options.output, more=kept, overwrite=options.overwrite)
    with progress_bars(quiet=options.quiet) as listener:
        measured = cvtgs.tradeoff.measure_tradeoff(
            options.input,
            presets=presets,
            rhos=options.rho,
            cameras=lambda scene: choose_cameras(options, scene, most=MOST_CAMERAS, held_out=True),
            photographs=photographs,
            settings=settings,
            device=options.device,
            folder=options.output if options.save else None,
            trust_sizes=options.trust_sizes,
            listener=listener,
        )
        paths, note = cvtgs.tradeoff.write_tradeoff(
            measured, options.output, overwrite=options.overwrite, listener=listener
        )
    if not options.quiet:
        _print_tradeoff(measured.tradeoff)
        names = ", ".join(path.name for path in paths)
        say(f"Wrote {names}. Open {paths[-1]} in a browser.")
        if note:
            say(f"No plot was written: {note}")
    failed = len(measured.tradeoff.failures)
    if failed:
        runs = counted(failed + len(measured.tradeoff.results), "run")
        raise RunError(f"{failed} of {runs} failed; {options.output} has the others.")


def _print_tradeoff(tradeoff: "cvtgs.tradeoff.Tradeoff") -> None:
    from cvtgs.tradeoff.files import MARK_MEANS, cells, heading, how_measured

    for rho in tradeoff.rhos:
        say(heading(tradeoff, rho))
        runs = [cells(tradeoff, result) for result in tradeoff.results if result.rho == rho]
        say_table([[name, *(run[name] for run in runs)] for name in runs[0]])
        fewer = [one.report for one in tradeoff.results if one.rho == rho and one.report.shortfall]
        if fewer:
            say(shortfall_note(fewer[0]))
    say(MARK_MEANS)
    say_wrapped(how_measured(tradeoff))
