"""``cvtgs info`` and ``cvtgs convert``: facts about a scene, conversion between formats, edits."""

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Literal

import cvtgs
from cvtgs.cli.display import say, say_wrapped
from cvtgs.cli.jobs import (
    STANDARD_INPUT,
    STREAM,
    Outcome,
    add_paths,
    input_file,
    make_output_folder,
    open_jobs,
    run_jobs,
)
from cvtgs.cli.options import AddParser, add_options, read_numbers, read_scene, read_settings
from cvtgs.cli.paths import any_path
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, warn, without_warnings
from cvtgs.tags import TWO_SCALES, described_tags
from cvtgs.text import counted, first_of, size_text


def add_edit_options(parser: argparse.ArgumentParser) -> None:
    """Add the options, in the order in which they are applied."""
    group = parser.add_argument_group(
        "edits", "applied in this order, in PLY coordinates; rows that are kept do not change"
    )
    group.add_argument(
        "--merge",
        metavar="FILE",
        type=any_path,
        action="append",
        default=[],
        help="scene to add to IN, in any format; can be repeated",
    )
    group.add_argument(
        "--crop-box",
        metavar="X,Y,Z,X,Y,Z",
        action="append",
        default=[],
        help="box to keep, by its minimum and maximum corner; with more than one region, "
        "Gaussians in any of them are kept",
    )
    group.add_argument(
        "--crop-sphere",
        metavar="X,Y,Z,R",
        action="append",
        default=[],
        help="sphere to keep, by its centre and radius",
    )
    group.add_argument(
        "--min-opacity", metavar="A", type=float, help="lowest opacity to keep, 0 to 1"
    )
    group.add_argument(
        "--max-size",
        metavar="S",
        type=float,
        help="largest standard deviation of a Gaussian to keep, scene units",
    )
    group.add_argument("--scale", metavar="F", type=float, help="scale factor of all lengths")
    group.add_argument(
        "--rotate",
        metavar="X,Y,Z",
        help="rotation in degrees about x, then y, then z, which also rotates the SH",
    )
    group.add_argument(
        "--translate", metavar="X,Y,Z", help="translation, after rotation and scaling"
    )


Edit = Callable[["cvtgs.GaussianScene"], "cvtgs.GaussianScene"]


def read_edits(options: argparse.Namespace) -> list[tuple[str, Edit]]:
    """Read the edits in their order, each after words for the Gaussians that it drops."""
    edit, edits, boxes = cvtgs.edit, list[tuple[str, Edit]](), cvtgs.boxes
    regions = list[boxes.Box | boxes.Sphere]()
    for text in options.crop_box:
        of = "x,y,z,X,Y,Z, the minimum and maximum coordinates"
        x0, y0, z0, x1, y1, z1 = read_numbers("--crop-box", text, 6, of=of)
        regions.append(boxes.Box(min=(x0, y0, z0), max=(x1, y1, z1)))
    for text in options.crop_sphere:
        x, y, z, radius = read_numbers("--crop-sphere", text, 4, of="x,y,z,r, centre and radius")
        regions.append(boxes.Sphere(center=(x, y, z), radius=radius))
    if regions:
        given = {"--crop-box": options.crop_box, "--crop-sphere": options.crop_sphere}
        words = f"outside {' and '.join(name for name, texts in given.items() if texts)}"
        edits.append((words, lambda scene: edit.crop(scene, regions)))
    if options.min_opacity is not None:
        words = "below --min-opacity"
        edits.append((words, lambda scene: edit.drop_faint(scene, options.min_opacity)))
    if options.max_size is not None:
        words = "above --max-size"
        edits.append((words, lambda scene: edit.drop_large(scene, options.max_size)))
    if (options.scale, options.rotate, options.translate) != (None, None, None):
        scale = 1.0 if options.scale is None else options.scale
        if not 0 < scale < math.inf:
            raise InvalidArgumentError(f"--scale must be above 0 and finite, found {scale}.")
        a, b, c = x, y, z = 0.0, 0.0, 0.0
        if options.rotate is not None:
            of = "x,y,z, degrees about each axis"
            a, b, c = read_numbers("--rotate", options.rotate, 3, of=of)
        if options.translate is not None:
            x, y, z = read_numbers("--translate", options.translate, 3, of="x,y,z")
        motion = edit.Motion.of_angles((a, b, c), scale=scale, shift=(x, y, z))
        edits.append(("moved", lambda scene: edit.move(scene, motion)))
    return edits


def edited(
    scene: "cvtgs.GaussianScene", edits: Iterable[tuple[str, Edit]]
) -> "tuple[cvtgs.GaussianScene, list[str]]":
    """Return the edited scene, and one phrase for each kind of lost data."""
    from cvtgs.io.limits import LOST_DIGITS
    from cvtgs.validity import lost_step

    phrases = []
    for words, edit in edits:
        before, scene = scene, edit(scene)
        if len(scene) < len(before):
            phrases.append(f"{counted(len(before) - len(scene), 'Gaussian')} ({words})")
        elif (step := lost_step(scene)) > lost_step(before):
            phrases.append(f"{LOST_DIGITS} (steps of {step:.3g} so far from the origin)")
        if len(scene) == 0:
            raise InvalidArgumentError(
                f"at least one Gaussian must be left to write, found none: {'; '.join(phrases)}."
            )
    return scene, phrases


def add_info(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "info",
        help="show facts about a scene or a checkpoint",
        description="Show counts, sizes and statistics of a scene, and which effects simplify "
        "would compute for it (- is standard input); or how a checkpoint (standard, paper or a "
        ".safetensors file) was trained.",
    )
    parser.set_defaults(run=show_info)
    add_options(parser, "input", "--json", "--effects", "--lod", "--trust-sizes")


def show_info(options: argparse.Namespace) -> None:
    """Run ``cvtgs info``."""
    path = options.input
    is_shipped = str(path) in cvtgs.mergenet.SHIPPED and not path.exists()
    if is_shipped or path.suffix == ".safetensors":
        for word in ("effects", "lod"):
            if getattr(options, word) is not None:
                raise InvalidArgumentError(f"--{word} applies to scenes, and cannot be used here.")
        checkpoint = cvtgs.mergenet.load_checkpoint(path)
        _show(options, checkpoint.info, checkpoint_rows(checkpoint))
        return
    settings = read_settings(effects=options.effects)
    config = cvtgs.SimplifyConfig.compose(settings=settings)
    with input_file(options.input) as path:
        read = argparse.Namespace(**{**vars(options), "input": path})
        facts = cvtgs.describe(read_scene(read, config), config)
        name = cvtgs.io.scene_file(path) if path == options.input else STANDARD_INPUT
        file = f"{name}, {size_text(cvtgs.io.scene_size(path))}"
    _show(options, facts, [("file", file), *_rows(facts)])


def _show(
    options: argparse.Namespace,
    facts: "cvtgs.SceneInfo | cvtgs.mergenet.CheckpointInfo",
    rows: Sequence[tuple[str, str]],
) -> None:
    """Print facts as JSON, or as rows of labels and texts."""
    if options.json:
        say(facts.model_dump_json(indent=2))
        return
    for label, text in rows:
        say(f"{label:<16} {text}")


def checkpoint_rows(checkpoint: "cvtgs.mergenet.Checkpoint") -> list[tuple[str, str]]:
    """Return how a checkpoint was trained, by label."""
    info, unknown = checkpoint.info, "unknown"
    rows = [
        ("checkpoint", checkpoint.name),
        ("digest", checkpoint.digest),
        ("preset", info.preset),
        ("training", info.training or unknown),
        ("seed, steps", f"{info.seed}, {info.steps:,}"),
        ("cvtgs", info.version or unknown),
        ("architecture", info.architecture.model_dump_json()),
        ("started from", info.start or ("nothing" if info.config else unknown)),
        ("configuration", info.config or unknown),
    ]
    for scene in info.scenes:
        label = "validated on" if scene.is_validation else "trained on"
        rows.append((label, f"{scene.name}, {scene.count:,}, {scene.sha256 or 'generated'}"))
    return rows


def _rows(facts: "cvtgs.SceneInfo") -> list[tuple[str, str]]:
    from cvtgs.info import HEAVIEST, QUANTILES

    invalid = ", ".join(f"{name} {number:,}" for name, number in facts.invalid_rows.items())
    step = facts.robust_radius / 1000
    center = _vector(facts.robust_center, step=step)
    opacities = zip(QUANTILES, facts.opacity_quantiles, strict=True)
    shares = [
        f"{mass:.1%} in {'the heaviest ' * (share == HEAVIEST[0])}{100 * share:g}%"
        for share, mass in zip(HEAVIEST, facts.mass_shares, strict=True)
    ]
    rows = [
        ("Gaussians", f"{facts.count:,}"),
        ("SH degree", f"{facts.sh_degree}"),
        ("bounds", " to ".join(_vector(corner, step=step) for corner in facts.bounds)),
        ("robust radius", f"{facts.robust_radius:.4g} around {center}"),
        ("opacity at", "   ".join(f"{share:.0%} {value:.3f}" for share, value in opacities)),
        ("mass", f"{facts.mass:.4g} square units"),
        ("mass shares", ", ".join(shares)),
        (
            "opacity < 0.1",
            f"{facts.faint_share:.1%} of the Gaussians, {facts.faint_mass_share:.1%} of the mass",
        ),
        ("invalid rows", f"{facts.invalid_count:,}" + (f" ({invalid})" if invalid else "")),
        ("tags", described_tags(facts.comments) or "none"),
        ("comments", first_of(facts.comments, between="; ", length=200) or "none"),
        ("extra columns", first_of(facts.extra_columns) or "none"),
    ]
    table = [("effect", ("state", "measured", "rule"))]
    table += [(name, _effect_cells(effect)) for name, effect in facts.plan]
    left, middle, _ = (max(map(len, column)) for column in zip(*dict(table).values(), strict=True))
    return rows + [
        (name, f"{state:{left}}  {figures:{middle}}  {rule}")
        for name, (state, figures, rule) in table
    ]


def _effect_cells(effect: "cvtgs.analysis.Effect") -> tuple[str, str, str]:
    """Return the state of an effect, the measured figures, and the rule that decides."""
    from cvtgs.analysis import BandsEffect

    state, figures = "on" if effect.active else "off", f"{effect.figure:.3g}"
    if isinstance(effect, BandsEffect) and effect.bands:
        state += f", to degree {effect.degree}" if effect.active else ""
        figures = ", ".join(f"{loss:.3g}" for loss in effect.bands)
    return state + (", by setting" if effect.forced else ""), figures, effect.meaning


def _vector(values: tuple[float, ...], *, step: float) -> str:
    """Write coordinates with four digits, or more far from the origin, to tell steps apart."""
    far = max(map(abs, values))
    digits = 4 if not 0 < step < far < math.inf else max(4, 1 + round(math.log10(far / step)))
    return "(" + ", ".join(f"{value:.{min(digits, 17)}g}" for value in values) + ")"


def add_convert(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "convert",
        help="write scenes in another format",
        description="Read IN and write it as OUT; the suffixes of the names set the formats. "
        "Before writing, print the data that the format of OUT cannot hold. Scenes can also be "
        "merged, cropped, filtered and moved.",
    )
    parser.set_defaults(run=convert)
    add_paths(parser, options="")
    add_options(parser, "--sh-degree", "--axes", "--lod", "--trust-sizes", "--overwrite", "--quiet")
    parser.add_argument(
        "--spz-version",
        metavar="V",
        type=int,
        choices=(2, 3, 4),
        help="version of a .spz to write: 3 (default), 4, which states its axes, or 2 for older "
        "readers",
    )
    add_edit_options(parser)


def convert(options: argparse.Namespace) -> None:
    """Run ``cvtgs convert``."""
    edits = read_edits(options)
    with open_jobs(options) as jobs:
        for job in jobs:
            cvtgs.io.check_save(job.output, overwrite=options.overwrite)
            if options.spz_version and not job.output.name.lower().endswith(".spz"):
                stream = "standard output without --suffix .spz"
                found = stream if job.to_stream else job.output.name
                raise InvalidArgumentError(f"--spz-version needs a .spz to write, found {found}.")
        run_jobs(jobs, lambda job: _convert_one(job, edits))


def _format_of(path: Path) -> str:
    suffix = cvtgs.io.scene_file(path).suffix.lower()
    return ".sog" if suffix == ".json" else suffix  # a .sog is a packed meta.json


def _convert_one(options: argparse.Namespace, edits: Sequence[tuple[str, Edit]]) -> Outcome:
    """Convert one scene, and report the data that is lost."""
    from cvtgs.io.limits import LOST_DIGITS

    axes, trust = options.axes, options.trust_sizes
    scenes = [cvtgs.io.load(options.input, axes=axes.source, trust_sizes=trust, lod=options.lod)]
    for path in options.merge:
        if str(path) == STREAM:
            raise InvalidArgumentError("--merge takes files; only IN may be - for standard input.")
        alike = _format_of(path) == _format_of(options.input)
        source = axes.source if alike else None  # other formats have axes of their own
        scenes.append(cvtgs.io.load(path, axes=source, trust_sizes=trust))
    # What is dropped is printed below instead.
    with nullcontext() if options.quiet else without_warnings(DroppedDataWarning):
        scene = cvtgs.concatenate(scenes, fill=True)
    left = sorted({name for one in scenes for name in one.extras} - set(scene.extras))
    scene, phrases = edited(scene, edits)
    if any(one.has_two_scales for one in scenes) and not scene.has_two_scales:
        phrases.append(f"the tag '{TWO_SCALES.text}', since not all scenes have two scales")
    if left:
        phrases.append(f"columns that not all scenes have ({first_of(left)})")
    if options.sh_degree is not None and options.sh_degree < scene.sh_degree:
        scene = scene.with_sh_degree(options.sh_degree)
        phrases += [f"SH bands above degree {options.sh_degree} (--sh-degree)"]
    version: Literal[2, 3, 4] = options.spz_version or 3
    lost = cvtgs.io.losses(scene, options.output, spz_version=version)
    if any(phrase.startswith(LOST_DIGITS) for phrase in lost.dropped):  # of edits and of the file
        phrases = [phrase for phrase in phrases if not phrase.startswith(LOST_DIGITS)]
    lines = [*phrases, *lost.dropped]
    if not options.quiet and options.folder is None:
        stream, files = sys.stdout, f"files like {options.output.name}"
        if options.to_stream:
            stream, files = sys.stderr, f"{options.suffix} files"
        if lost.changed:
            say(f"In {files}:", file=stream)
        for phrase in lost.changed:
            say_wrapped(phrase, indent=2, file=stream)
        rest = "nothing else" if lost.changed else "nothing"
        say_wrapped(f"Lost: {'; '.join(lines) or rest}.", file=stream)
    unasked = [phrase for phrase in phrases if phrase.startswith((LOST_DIGITS, "the tag"))]
    if options.quiet and unasked:  # columns and what the format cannot hold have warnings already
        warn(f"{options.input}: lost {'; '.join(unasked)}.", DroppedDataWarning)
    make_output_folder(options)
    with nullcontext() if options.quiet else without_warnings(DroppedDataWarning):
        cvtgs.io.save(
            scene,
            options.output,
            overwrite=options.overwrite,
            axes=axes.target,
            spz_version=version,
        )
    notes = [f"Lost: {'; '.join(lines)}."] if options.folder is not None and lines else []
    return Outcome(f"{counted(lost.count, 'Gaussian')} of SH degree {lost.sh_degree}", notes=notes)
