"""Options for cameras, images and scores, and functions that read their values."""

import argparse
import sys
from pathlib import Path

import cvtgs
from cvtgs.cli.display import say
from cvtgs.cli.options import add_options, read_numbers
from cvtgs.errors import InvalidArgumentError
from cvtgs.text import counted

COLORS = {"black": [0.0, 0.0, 0.0], "gray": [0.5, 0.5, 0.5], "white": [1.0, 1.0, 1.0]}
AUTOMATIC_VIEWS = 8
SCORED_SIZE = 640  # longer side of images, pixels; shared, so all commands print the same scores


def say_views(evaluation: "cvtgs.evaluation.Evaluation") -> None:
    """Print the number, size and renderer of the images that scores are means over."""
    say(
        f"{counted(evaluation.view_count, 'view')} "
        f"of {evaluation.width} x {evaluation.height} pixels, rendered by {evaluation.backend}"
    )


def add_view_options(parser: argparse.ArgumentParser, *, size: int, **helps: str) -> None:
    """Add the options of cameras and images; ``size`` is in pixels, ``helps`` other help texts."""
    add_options(parser, "--cameras", "--split", "--views", **helps)
    parser.add_argument(
        "--size",
        type=int,
        metavar="N",
        help=f"longer side of the images in pixels (default {size}, or that of --cameras)",
    )
    add_options(parser, "--background", "--backend", "--device", "--quiet")
    parser.set_defaults(default_size=size)


def evaluation_settings(options: argparse.Namespace) -> "cvtgs.evaluation.EvaluationSettings":
    """Check the options of :func:`add_view_options`; return settings of images and scores."""
    for name, most in (("views", 10_000), ("size", 1 << 14)):  # larger images take gigabytes
        value = getattr(options, name)
        if value is not None and not 1 <= value <= most:
            raise InvalidArgumentError(f"--{name} must be from 1 to {most:,}, found {value:,}.")
    check_split(options)
    if getattr(options, "images", None) is not None and options.cameras is None:
        raise InvalidArgumentError("--images needs the cameras of the photographs: --cameras.")
    word = options.background.strip().lower()
    of = f"red,green,blue from 0 to 1, or {', '.join(COLORS)}"
    red, green, blue = COLORS.get(word) or read_numbers("--background", word, 3, of=of)
    if min(red, green, blue) < 0.0 or max(red, green, blue) > 1.0:
        raise InvalidArgumentError(f"--background must be {of}, found {options.background!r}.")
    return cvtgs.evaluation.EvaluationSettings(
        background=(red, green, blue),
        lpips=getattr(options, "lpips", "auto"),
        backend=options.backend,
    )


def check_split(options: argparse.Namespace) -> None:
    """Check that ``--split`` has cameras to choose from."""
    if options.split is not None and options.cameras is None:
        raise InvalidArgumentError("--split chooses among cameras and needs --cameras.")


def read_cameras(options: argparse.Namespace) -> "cvtgs.Cameras | None":
    """Read ``--cameras`` and ``--split``; None if not given."""
    if options.cameras is None:
        return None
    return cvtgs.load_cameras(options.cameras, split=options.split)


def choose_cameras(
    options: argparse.Namespace,
    scene: "cvtgs.GaussianScene",
    *,
    most: int | None = None,
    held_out: bool = False,
) -> "cvtgs.Cameras":
    """Read ``--cameras``, or those beside the scene (of the test split), or choose views."""
    size, views = options.size or options.default_size, options.views or AUTOMATIC_VIEWS
    cameras = read_cameras(options)
    if cameras is not None:
        cameras = cameras.spread(options.views or most or len(cameras))
        images = getattr(options, "images", None)
        if images is not None:  # also checks their aspect ratio
            cameras = cvtgs.evaluation.fit_cameras(cameras, images)
        return cameras if options.size is None else cameras.fitted(size)
    path = options.reference if "reference" in options else options.input
    own = own_cameras(options, scene, path)
    if own is not None:
        test = own.test_cameras() if held_out else None
        if not options.quiet:
            of_what = "cameras" if test is None else "test cameras"
            say(f"Views: {of_what} found in {own.source.resolve()}.", file=sys.stderr)
        return (test or own.cameras).spread(views).fitted(size)
    height = max(1, round(0.75 * size))
    return cvtgs.views.automatic_views(scene, views, width=size, height=height)


def own_cameras(
    options: argparse.Namespace, scene: "cvtgs.GaussianScene", path: Path
) -> "cvtgs.views.OwnCameras | None":
    """Find the cameras beside a scene, unless ``--axes`` turns the scene away from them."""
    from cvtgs.io.axes import SCENE_AXES

    axes = getattr(options, "axes", None)
    if axes is not None and axes.source not in (None, SCENE_AXES):
        return None
    return cvtgs.views.find_own_cameras(scene, path)
