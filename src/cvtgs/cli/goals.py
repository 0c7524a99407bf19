"""Goals of ``cvtgs simplify`` besides a count: a time budget, or a quality to reach."""

import argparse
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cvtgs
from cvtgs.cli.cameras import AUTOMATIC_VIEWS, SCORED_SIZE
from cvtgs.cli.display import say, target_note
from cvtgs.errors import (
    CvtgsError,
    DroppedDataWarning,
    GoalError,
    InvalidArgumentError,
    without_warnings,
)
from cvtgs.text import counted

STARTED = time.perf_counter()  # approximate start of this process, from which a time budget counts
SAMPLED = 1 << 13  # Gaussians that tell how long the output file takes


class ChosenPreset(NamedTuple):
    """A preset, why it was chosen, the time left for the run, and advice if it takes longer."""

    name: str
    reason: str
    left: float  # seconds
    advice: str


def has_target(options: argparse.Namespace) -> bool:
    """Return whether a quality is to be reached."""
    return options.target_psnr is not None or options.target_ssim is not None


def check_goals(options: argparse.Namespace) -> None:
    """Check the goals, and raise for options that exclude them or need them."""
    if has_target(options) and options.keep is not None:
        raise InvalidArgumentError("--keep needs --rho, --count or --max-count.")
    if options.time_budget is None:
        for option in ("recalibrate", "shipped-rates"):
            if getattr(options, option.replace("-", "_")):
                raise InvalidArgumentError(f"--{option} needs --time-budget.")
        return
    if not 0 < options.time_budget < math.inf:
        raise InvalidArgumentError(
            f"--time-budget must be above 0 and finite, found {options.time_budget:g} s."
        )
    excluded = ("preset", "config", "refine", "refine_steps", "target_psnr", "target_ssim")
    wrong = [
        f"--{name.replace('_', '-')}" for name in excluded if getattr(options, name) is not None
    ]
    if options.ckpt not in ("auto", "none"):
        wrong.append("--ckpt")
    if wrong:
        raise InvalidArgumentError(
            f"--time-budget chooses the preset and cannot be used with {', '.join(wrong)}."
        )


def with_limited_bands(
    config: "cvtgs.SimplifyConfig", degree: int | None
) -> "cvtgs.SimplifyConfig":
    """Return a configuration that drops the SH bands above a degree."""
    own = config.effects.sh
    if degree is None or own == "off" or (isinstance(own, int) and own <= degree):
        return config
    effects = config.effects.model_copy(update={"sh": degree})
    return config.model_copy(update={"effects": effects})


def choose_preset(
    options: argparse.Namespace,
    scene: "cvtgs.GaussianScene",
    settings: Mapping[str, str],
    listener: "cvtgs.ProgressListener",
    *,
    cameras: "cvtgs.Cameras | None" = None,
    with_images: bool = True,
) -> ChosenPreset:
    """Choose the best preset that fits into the remaining time budget, and into memory."""
    from cvtgs.budget.calibrate import is_calibrated

    target = cvtgs.target_count(
        len(scene), options.rho, count=options.count, max_count=options.max_count
    )
    budget, writing = options.time_budget, _seconds_to_write(options, scene, target)
    spent = time.perf_counter() - options.begun
    parts = f"starting and reading took {spent:.1f} s, and writing takes about {writing:.1f} s"
    if budget <= spent + writing:
        raise GoalError(f"no preset fits into {budget:g} s: {parts}.")
    if options.shipped_rates:
        model = cvtgs.budget.shipped_model()
    else:
        again = options.recalibrate or not is_calibrated(options.device)
        if again and not options.quiet:
            say(
                "cvtgs: measuring this machine once, about 10 seconds (--shipped-rates skips this)",
                file=sys.stderr,
            )
        model = cvtgs.budget.cost_model(options.device, recalibrate=again, listener=listener)
    if options.ckpt == "none":
        settings = {**settings, "merge.network": "false"}
    work, left = cvtgs.budget.Work.of(scene, target), budget - spent - writing
    try:
        choice = cvtgs.budget.choose_preset(
            work, left, settings=settings, model=model, cameras=cameras, with_images=with_images
        )
    except GoalError as error:
        raise GoalError(f"{error} Of {budget:g} s, {parts}.") from error
    room = "" if with_images else f" and, without images, into {options.memory}"
    reason = (
        f"Preset {choice.preset}, the best that fits into {budget:g} s{room}: expected to take "
        f"{choice.seconds:.1f} s; {parts}."
    )
    advice = "--recalibrate measures this machine again"
    if options.shipped_rates:
        advice = "without --shipped-rates, this machine is measured"
    return ChosenPreset(choice.preset, reason, budget - spent, advice)


def _seconds_to_write(
    options: argparse.Namespace, scene: "cvtgs.GaussianScene", count: int
) -> float:
    """Estimate the seconds that writing OUT takes; 0 if no sample of the scene can be written."""
    some = scene[: min(count, SAMPLED)]
    some, seconds = some[cvtgs.validity.writable_rows(some)], list[float]()
    try:
        with TemporaryDirectory() as folder, without_warnings(DroppedDataWarning):
            for sample in (some[:1], some[:1], some, some):  # the first loads libraries
                started = time.perf_counter()
                cvtgs.io.save(sample, Path(folder) / options.output.name, overwrite=True)
                seconds.append(time.perf_counter() - started)
    except (OSError, CvtgsError):
        return 0.0
    _, fixed, *whole = seconds
    return fixed + max(0.0, min(whole) - fixed) * count / len(some)


class SearchViews(NamedTuple):
    """Cameras to fit presets to and to score over, None for automatic views; and their name."""

    cameras: "cvtgs.Cameras | None"
    heldout: "cvtgs.Cameras | None"
    name: str


def views_of_search(
    options: argparse.Namespace,
    config: "cvtgs.SimplifyConfig",
    cameras: "cvtgs.Cameras | None",
    own: "cvtgs.views.OwnCameras | None",
) -> SearchViews:
    """Choose the views of a search; presets that use images are fitted to others than score."""
    if not config.uses_images:
        if own is None:
            name = "automatic views" if cameras is None else "the given cameras"
            return SearchViews(cameras, cameras, name)
        scored = own.cameras.spread(AUTOMATIC_VIEWS).fitted(SCORED_SIZE)
        name = f"{counted(len(scored), 'camera')} found in {own.source.resolve()}"
        return SearchViews(cameras, scored, name)
    known = own
    if cameras is not None and own is None and options.split != "test":
        known = cvtgs.views.OwnCameras(cameras, options.cameras)
    with without_warnings(DroppedDataWarning):  # reading all cameras has warned
        test = None if known is None else known.test_cameras()
        if known is None or test is None:
            return SearchViews(cameras, None, "automatic views that it was not fitted to")
        training = cvtgs.load_cameras(known.source, split="train")
    if own is not None:
        test = test.spread(AUTOMATIC_VIEWS).fitted(SCORED_SIZE)
    name = f"{counted(len(test), 'test camera')} of {known.source.resolve()}"
    return SearchViews(training, test, f"{name}, which it was not fitted to")


def search_target(
    options: argparse.Namespace,
    scene: "cvtgs.GaussianScene",
    simplifier: "cvtgs.Simplifier",
    *,
    views: SearchViews,
    axes: str | None,
    listener: "cvtgs.ProgressListener",
) -> tuple["cvtgs.budget.Found", str]:
    """Search for the smallest scene whose file reaches the quality; return it, and a sentence."""
    is_rounded = rounds(options.output)

    def read_back(small: "cvtgs.GaussianScene") -> "cvtgs.GaussianScene":
        """Write a scene to a temporary file of the format of OUT, and read it again."""
        with TemporaryDirectory() as folder:
            file = Path(folder) / options.output.name
            with without_warnings(DroppedDataWarning):  # the output file warns
                cvtgs.io.save(small, file, axes=axes)
            return cvtgs.io.load(file, device=small.device, axes=axes, trust_sizes=True)

    try:
        found = cvtgs.budget.find_count(
            scene,
            psnr=options.target_psnr,
            ssim=options.target_ssim,
            simplifier=simplifier,
            cameras=views.cameras,
            heldout=views.heldout,
            written=read_back if is_rounded else lambda small: small,
            listener=listener,
        )
    except GoalError as error:
        if not is_rounded:
            raise
        raise GoalError(
            f"{error} These are scores of files of this format, which rounds; a plain .ply does "
            f"not."
        ) from error
    return found, target_note(found, views.name)


def rounds(path: Path) -> bool:
    """Return whether a scene changes when it is written to a file and read again."""
    from cvtgs.io.formats import READABLE_SUFFIXES
    from cvtgs.io.limits import FORMAT_LIMITS

    limited = tuple(suffix for suffix in READABLE_SUFFIXES if suffix in FORMAT_LIMITS)
    return path.name.lower().endswith(limited)
