"""Options of ``cvtgs simplify`` for large scenes: protected regions, memory, many machines."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cvtgs.errors import FileFormatError, InputError, InvalidArgumentError
from cvtgs.progress import ProgressListener

if TYPE_CHECKING:
    from torch import Tensor

    from cvtgs.config import SimplifyConfig
    from cvtgs.report import SimplifyReport
    from cvtgs.scene import GaussianScene


def add_large_options(parser: argparse.ArgumentParser) -> None:
    """Describe the options."""
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="BOX.json",
        help='keep Gaussians in boxes as they are: {"min": [x, y, z], "max": [x, y, z]}, or a '
        "list of these; they count, and come first",
    )
    parser.add_argument(
        "--memory",
        metavar="AMOUNT",
        help="memory to use, for example 4GB (default: what is free); a larger scene, a binary "
        ".ply, is simplified block by block, and an interrupted run goes on where it was",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the blocks with a Dask cluster whose workers see IN and OUT; --memory is "
        "that of each task",
    )


def keep_mask(options: argparse.Namespace, scene: "GaussianScene") -> "Tensor | None":
    """Find the protected Gaussians."""
    if options.keep is None:
        return None
    from cvtgs.boxes import inside, read_boxes  # noqa: PLC0415 (keeps --help fast)

    return inside(read_boxes(options.keep), scene.means)


def block_memory(options: argparse.Namespace, config: "SimplifyConfig") -> int | None:
    """Decide whether a scene is simplified block by block."""
    from cvtgs.errors import ConfigError  # noqa: PLC0415
    from cvtgs.io.ply import open_rows  # noqa: PLC0415
    from cvtgs.outofcore.memory import available_memory, block_count, read_bytes  # noqa: PLC0415
    from cvtgs.outofcore.run import check_config  # noqa: PLC0415

    goals = ("target_psnr", "target_ssim", "time_budget", "cameras")
    given = [name for name in goals if getattr(options, name, None) is not None]
    memory = available_memory() if options.memory is None else read_bytes(options.memory)
    if options.memory is None and options.scheduler is None:
        try:
            if given or block_count(open_rows(options.input), memory) == 1:
                return None
            check_config(config)
        except (InputError, FileFormatError, ConfigError):
            return None
        return memory
    if options.scheduler is None and block_count(open_rows(options.input), memory) == 1:
        return None
    if given:
        words = ", ".join("--" + name.replace("_", "-") for name in given)
        raise InvalidArgumentError(f"blocks cannot go with {words}, which need the whole scene.")
    check_config(config)
    return memory


def run_by_blocks(
    options: argparse.Namespace,
    checkpoint: str | None,
    config: "SimplifyConfig",
    *,
    memory: int,
    listener: ProgressListener,
) -> "SimplifyReport":
    """Simplify a file block by block, here or on a cluster."""
    from cvtgs.boxes import read_boxes  # noqa: PLC0415
    from cvtgs.outofcore import simplify_file  # noqa: PLC0415 (keeps --help fast)
    from cvtgs.outofcore.distributed import connect, workers_of  # noqa: PLC0415
    from cvtgs.outofcore.turns import this_process  # noqa: PLC0415
    from cvtgs.simplify import Simplifier  # noqa: PLC0415

    client = None if options.scheduler is None else connect(options.scheduler)
    try:
        return simplify_file(
            options.input,
            options.output,
            options.rho,
            count=options.count,
            memory=memory,
            boxes=() if options.keep is None else read_boxes(options.keep),
            simplifier=Simplifier(checkpoint, config=config, device="cpu"),
            workers=this_process if client is None else workers_of(client),
            overwrite=options.overwrite,
            listener=listener,
        )
    finally:
        if client is not None:
            client.close()
