"""``cvtgs convert``: a scene in another format."""

import argparse
from pathlib import Path

from cvtgs.cli.display import READABLE, WRITABLE, file_size


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Describe the command."""
    parser = commands.add_parser(
        "convert",
        help="write a scene in another format",
        description="Read IN and write it as OUT; the ends of their names say the formats. What "
        "the format of OUT cannot hold is said before it is written.",
    )
    parser.add_argument("input", metavar="IN", type=Path, help=f"scene to read ({READABLE})")
    parser.add_argument("output", metavar="OUT", type=Path, help=f"scene to write ({WRITABLE})")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT")
    parser.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from cvtgs.io import check_save, load, losses, save  # noqa: PLC0415 (keeps --help fast)

    check_save(options.output, overwrite=options.overwrite)
    scene = load(options.input)
    lost = losses(scene, options.output)
    if not options.quiet:
        print(f"{options.input}: {len(scene):,} Gaussians of SH degree {scene.sh_degree}")
        if lost.changed:
            print(f"Files like {options.output.name} hold:")
        for phrase in lost.changed:
            print(f"  {phrase}", flush=True)
    save(scene, options.output, overwrite=options.overwrite)  # warns of what is dropped, first
    if not options.quiet:
        print(
            f"{options.output}: {lost.count:,} Gaussians of SH degree {lost.sh_degree}, "
            f"{file_size(options.input)} -> {file_size(options.output)}"
        )
        rest = "nothing but precision" if lost.changed else "nothing"
        print(f"Lost: {'; '.join(lost.dropped) or rest}.")
