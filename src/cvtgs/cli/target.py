"""``--target-psnr`` and ``--target-ssim``: find the smallest scene whose file reaches a quality."""

import argparse
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import cvtgs
from cvtgs.errors import DroppedDataWarning, GoalError, InvalidArgumentError

if TYPE_CHECKING:
    from cvtgs.budget import Found
    from cvtgs.cameras import Cameras
    from cvtgs.progress import ProgressListener
    from cvtgs.scene import GaussianScene
    from cvtgs.simplifier import Simplifier


def has_target(options: argparse.Namespace) -> bool:
    """Return whether a quality is to be reached."""
    return options.target_psnr is not None or options.target_ssim is not None


def check_target(options: argparse.Namespace) -> None:
    """Check the quality to reach, and raise for options that exclude it."""
    if has_target(options):
        from cvtgs.budget.count import checked_target

        if options.keep is not None:
            raise InvalidArgumentError("--keep needs --rho, --count or --max-count.")
        checked_target(options.target_psnr, ssim=options.target_ssim)


def search_target(
    options: argparse.Namespace,
    scene: "GaussianScene",
    simplifier: "Simplifier",
    *,
    cameras: "Cameras | None",
    axes: str | None,
    listener: "ProgressListener",
) -> "Found":
    """Search for the smallest scene whose file, with the given axes, reaches the quality."""
    is_rounded = rounds(options.output)
    try:
        return cvtgs.budget.find_count(
            scene,
            psnr=options.target_psnr,
            ssim=options.target_ssim,
            simplifier=simplifier,
            cameras=cameras,
            heldout=None if simplifier.config.uses_images else cameras,
            written=read_back(options.output, axes=axes) if is_rounded else lambda small: small,
            listener=listener,
        )
    except GoalError as error:
        if not is_rounded:
            raise
        raise GoalError(
            f"{error} These are scores of files of this format, which rounds; a plain .ply does "
            f"not."
        ) from error


def rounds(path: Path) -> bool:
    """Return whether a scene changes when it is written to a file and read again."""
    from cvtgs.io.formats import READABLE_SUFFIXES
    from cvtgs.io.limits import FORMAT_LIMITS

    limited = tuple(suffix for suffix in READABLE_SUFFIXES if suffix in FORMAT_LIMITS)
    return path.name.lower().endswith(limited)


def read_back(path: Path, *, axes: str | None = None) -> "Callable[[GaussianScene], GaussianScene]":
    """Return a function that writes a scene to a temporary file of this name and reads it again."""

    def read(scene: "GaussianScene") -> "GaussianScene":
        with TemporaryDirectory() as folder:
            file = Path(folder) / path.name
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DroppedDataWarning)  # the output file warns
                cvtgs.io.save(scene, file, axes=axes)
            return cvtgs.io.load(file, device=scene.device, axes=axes, trust_sizes=True)

    return read
