"""``cvtgs render``: images of a scene."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from cvtgs.cli.display import READABLE, progress_bars
from cvtgs.cli.looking import (
    add_looking_options,
    background_color,
    check_looking_options,
    chosen_cameras,
    looking_device,
)

SIZE = 800


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "render",
        help="write images of a scene",
        description="Write one PNG per view into DIR, named after the cameras.",
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"scene to read ({READABLE})")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="directory to write to"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing images")
    add_looking_options(parser, size=SIZE)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    import torch  # noqa: PLC0415 (keeps --help fast)

    from cvtgs.evaluation.compare import as_bytes  # noqa: PLC0415
    from cvtgs.evaluation.comparison_files import make_folder  # noqa: PLC0415
    from cvtgs.evaluation.images import encode  # noqa: PLC0415
    from cvtgs.io import atomic_output, check_output, load  # noqa: PLC0415
    from cvtgs.progress import ProgressEvent  # noqa: PLC0415
    from cvtgs.rendering import render  # noqa: PLC0415

    check_looking_options(options)
    scene = load(options.input).to(looking_device(options))
    cameras = chosen_cameras(options, scene)
    make_folder(options.output)
    paths = [options.output / name for name in file_names(cameras.view_names)]
    for path in paths:
        check_output(path, options.overwrite)
    background = torch.tensor(background_color(options))
    with progress_bars(quiet=options.quiet) as listener, torch.no_grad():
        for number, path in enumerate(paths):
            listener(ProgressEvent(stage="render", done=number, total=len(paths)))
            camera = cameras.select(torch.tensor([number]))
            image = render(scene, camera, backend=options.backend, background=background).rgb[0]
            with atomic_output(path, overwrite=options.overwrite) as file:
                file.write(encode(as_bytes(image), "png"))
        listener(ProgressEvent(stage="render", done=len(paths), total=len(paths)))
    if not options.quiet:
        print(
            f"{len(paths)} images of {cameras.width} x {cameras.height} pixels in {options.output}"
        )


def file_names(views: Sequence[str]) -> list[str]:
    """Make file names of the names of views."""
    stems = []
    for view in views:
        name = PurePosixPath(view.replace("\\", "/")).name
        bare = re.sub(r"\.(png|jpe?g|webp|tiff?|bmp)$", "", name, flags=re.IGNORECASE)
        stems.append(re.sub(r"[^\w.-]+", "_", bare).strip("._") or "view")
    if len({stem.lower() for stem in stems}) == len(stems):
        return [f"{stem}.png" for stem in stems]
    return [f"{number:03d}_{stem}.png" for number, stem in enumerate(stems, start=1)]
