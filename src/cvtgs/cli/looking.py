"""What the commands that render share: scenes by name, cameras, sizes, background."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cvtgs.cli.display import READABLE
from cvtgs.errors import InvalidArgumentError

if TYPE_CHECKING:
    import torch

    from cvtgs.cameras import Cameras
    from cvtgs.scene import GaussianScene

AUTOMATIC_VIEWS = 8

Color = tuple[float, float, float]

_COLORS: dict[str, Color] = {
    "black": (0.0, 0.0, 0.0),
    "gray": (0.5, 0.5, 0.5),
    "white": (1.0, 1.0, 1.0),
}


class Scenes(NamedTuple):
    """Scenes by name, and the bytes of their files.

    Attributes:
        scenes: The scenes.
        sizes: Bytes.
    """

    scenes: "dict[str, GaussianScene]"
    sizes: dict[str, int]


def add_scoring_options(parser: argparse.ArgumentParser) -> None:
    """Add the scenes to compare, and which LPIPS to measure."""
    parser.add_argument("reference", metavar="REF", type=Path, help=f"the full scene ({READABLE})")
    parser.add_argument("small", metavar="SMALL", type=Path, nargs="+", help="simplified scenes")
    add_lpips_option(parser)


def add_lpips_option(parser: argparse.ArgumentParser) -> None:
    """Let the user choose which LPIPS to measure."""
    parser.add_argument(
        "--lpips",
        default="auto",
        choices=("auto", "vgg", "alex", "off"),
        help="which LPIPS to measure (default: VGG or Alex if there are weights)",
    )


def add_looking_options(parser: argparse.ArgumentParser, *, size: int) -> None:
    """Describe the options."""
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="F",
        help="cameras to use: transforms.json, a COLMAP model, cameras.json, or a folder of these "
        "(default: those in the folder that REF or IN is, if it is a model of INRIA's code, else "
        "automatic views)",
    )
    parser.add_argument(
        "--split", choices=("train", "test"), help="only these of the cameras of --cameras"
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views; of given cameras, N spread evenly "
        "(default 8, or all that are given)",
    )
    parser.add_argument(
        "--size",
        type=int,
        metavar="N",
        help=f"longer side of the images in pixels (default {size}, or that of the cameras)",
    )
    parser.add_argument(
        "--background",
        default="black",
        metavar="COLOR",
        help="black (default), gray, white, or red,green,blue from 0 to 1",
    )
    parser.add_argument(
        "--backend",
        default="auto",
        choices=("auto", "torch", "numba", "gsplat"),
        help="what renders (default: the fastest there is)",
    )
    parser.add_argument(
        "--device", default="auto", metavar="DEVICE", help="auto (default), cpu or cuda"
    )
    parser.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    parser.set_defaults(default_size=size)


def load_scenes(paths: Sequence[Path], device: "torch.device") -> Scenes:
    """Read scenes and name them after their files."""
    from cvtgs.io import load, scene_size  # noqa: PLC0415 (keeps --help fast)

    names = [path.name for path in paths]
    names = [
        name if names.count(name) == 1 else str(path)
        for name, path in zip(names, paths, strict=True)
    ]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InvalidArgumentError(f"every scene must be given once, found {twice[0]} twice.")
    scenes = {name: load(path).to(device) for name, path in zip(names, paths, strict=True)}
    sizes = {name: scene_size(path) for name, path in zip(names, paths, strict=True)}
    return Scenes(scenes, sizes)


def looking_device(options: argparse.Namespace) -> "torch.device":
    """Report where to render: CUDA if there is one, unless asked otherwise."""
    from cvtgs.devices import chosen_device  # noqa: PLC0415 (keeps --help fast)

    return chosen_device(options.device)


def check_looking_options(options: argparse.Namespace) -> None:
    """Refuse numbers that no image can have, before any file is read."""
    for name in ("views", "size"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InvalidArgumentError(f"--{name} must be at least 1, found {value}.")
    if options.split is not None and options.cameras is None:
        raise InvalidArgumentError("--split chooses among cameras and needs --cameras.")
    background_color(options)


def background_color(options: argparse.Namespace) -> Color:
    """Read the colour behind the scenes."""
    word = options.background.strip().lower()
    if word in _COLORS:
        return _COLORS[word]
    try:
        red, green, blue = (float(part) for part in word.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not all(0 <= part <= 1 for part in (red, green, blue)):
        raise InvalidArgumentError(
            f"--background must be {', '.join(_COLORS)} or red,green,blue from 0 to 1, "
            f"found {options.background!r}."
        )
    return red, green, blue


def chosen_cameras(
    options: argparse.Namespace, scene: "GaussianScene", *, most: int | None = None
) -> "Cameras":
    """Read cameras, or find views of the scene."""
    from cvtgs.io import load_cameras  # noqa: PLC0415
    from cvtgs.views import automatic_views  # noqa: PLC0415 (keeps --help fast)

    size = options.size or options.default_size
    if options.cameras is not None:
        cameras = load_cameras(options.cameras, split=options.split)
        cameras = cameras.spread(options.views or most or len(cameras))
        return cameras if options.size is None else cameras.fitted(size)
    beside = _cameras_of_model(options)
    if beside is not None:
        return load_cameras(beside).spread(options.views or AUTOMATIC_VIEWS).fitted(size)
    height = max(1, round(0.75 * size))
    return automatic_views(scene, options.views or AUTOMATIC_VIEWS, width=size, height=height)


def _cameras_of_model(options: argparse.Namespace) -> Path | None:
    """Find the cameras that lie in the folder of the scene, as INRIA's code writes them."""
    path = getattr(options, "reference", None) or getattr(options, "input", None)
    beside = path / "cameras.json" if path is not None else None
    return beside if beside is not None and beside.is_file() else None
