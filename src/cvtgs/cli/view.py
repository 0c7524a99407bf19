"""``cvtgs view``: choose the size of a scene in the browser."""

import argparse
import webbrowser
from collections.abc import Mapping
from contextlib import suppress
from functools import partial

import cvtgs
from cvtgs.cli.display import say
from cvtgs.cli.jobs import expanded
from cvtgs.cli.options import PRESET_NAMES, AddParser, add_options, ratio
from cvtgs.cli.paths import any_path, is_same_file, new_file
from cvtgs.errors import InvalidArgumentError
from cvtgs.io.atomic import write_atomically
from cvtgs.text import printable_name

PAGE = "viewer.html"
HOST, PORT = "127.0.0.1", 8080


def add_view(add_parser: AddParser) -> None:
    """Add the command and its options."""
    parser = add_parser(
        "view",
        help="choose the size of a scene in the browser",
        description="Serve a page that shows IN, and IN simplified to the ratio of a slider (needs "
        "the extra view). The page switches between scenes, scores the current view and saves "
        "scenes. Colours are those of SH degree 0.",
    )
    parser.set_defaults(run=view)
    add_options(parser, "input")
    parser.add_argument(
        "small",
        metavar="SMALL",
        type=any_path,
        nargs="*",
        help="scenes to switch to, in any format",
    )
    add_options(
        parser,
        "--preset",
        preset=f"preset to start with: {PRESET_NAMES} (default draft, for a responsive slider)",
    )
    parser.add_argument(
        "--rho", type=ratio, metavar="R", default=0.1, help="ratio to start with (default 0.1)"
    )
    parser.add_argument(
        "--page",
        type=partial(new_file, kind=".html"),
        metavar="F.html",
        help="write the page to a file that needs no server, instead of serving it; its time line "
        "switches between the scenes",
    )
    parser.add_argument(
        "--host", default=HOST, help=f"address to listen on (default {HOST}: this machine only)"
    )
    parser.add_argument(
        "--port",
        type=int,
        metavar="N",
        default=PORT,
        help=f"port to listen on; if it is taken, the next free one (default {PORT})",
    )
    parser.add_argument("--no-browser", action="store_true", help="do not open a browser")
    add_options(
        parser, "--device", "--trust-sizes", "--overwrite", "--quiet",
        overwrite="replace the file of --page; the page itself replaces none",
    )  # fmt: skip


def check_page(options: argparse.Namespace) -> None:
    """Check that the page of ``--viewer`` can be written, before the long work starts."""
    from cvtgs.viewer import check_viewer

    if options.viewer:
        check_viewer()
        if options.output.exists():
            cvtgs.io.check_output(options.output / PAGE, overwrite=options.overwrite)


def write_page(options: argparse.Namespace, scenes: Mapping[str, "cvtgs.GaussianScene"]) -> None:
    """Write the page of ``--viewer`` beside the other files of a command, and print its path."""
    from cvtgs.viewer import scene_page

    if not options.viewer:
        return
    path = options.output / PAGE
    write_atomically(path, scene_page(scenes).encode(), overwrite=options.overwrite)
    if not options.quiet:
        say(f"{path}: {len(scenes)} scenes in 3D, in one file that works offline.")


def view(options: argparse.Namespace) -> None:
    """Run ``cvtgs view``."""
    from cvtgs.viewer import SceneViewer, ViewerServer, check_viewer

    preset = options.preset or "draft"
    cvtgs.SimplifyConfig.compose(preset=preset)
    if not 0 < options.port < 1 << 16:
        raise InvalidArgumentError(f"--port must be from 1 to 65535, found {options.port}.")
    if options.page is not None and (
        options.no_browser or (options.host, options.port) != (HOST, PORT)
    ):
        raise InvalidArgumentError(
            "--host, --port and --no-browser are for serving the page, and cannot be used with "
            "--page."
        )
    small = expanded(options.small)
    names = [options.input, *small]
    if options.page is not None:
        cvtgs.io.check_output(options.page, overwrite=options.overwrite)
        if any(is_same_file(options.page, path) for path in names):
            raise InvalidArgumentError(
                f"--page and the scenes must be different files, found {options.page} for both."
            )
    check_viewer()
    scene, *others = (cvtgs.load(path, trust_sizes=options.trust_sizes) for path in names)
    named = {printable_name(str(path)): other for path, other in zip(small, others, strict=True)}
    viewer = SceneViewer(scene, named, device=options.device)
    server = ViewerServer(
        viewer, host=options.host, port=options.port, preset=preset, rho=options.rho
    )
    try:
        if options.page is not None:
            server.finish()
            write_atomically(options.page, server.page().encode(), overwrite=options.overwrite)
            if not options.quiet:
                say(f"{options.page}: {len(viewer.scenes)} scenes; open it in a browser.")
            return
        if not options.quiet:
            say(f"{server.address} (end with Ctrl+C)", flush=True)
        if not options.no_browser:
            webbrowser.open(server.address)
        with suppress(KeyboardInterrupt):  # the usual end
            server.wait()
    finally:
        server.close()
