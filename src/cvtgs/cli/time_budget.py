"""``--time-budget``: choose the best preset that finishes in time."""

import argparse
import math
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import cvtgs
from cvtgs.cli.display import say
from cvtgs.errors import GoalError, InvalidArgumentError

if TYPE_CHECKING:
    from cvtgs.progress import ProgressListener
    from cvtgs.scene import GaussianScene

STARTED = time.perf_counter()
"""Approximate start of this process, from which a time budget counts."""

UNITS = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


class ChosenPreset(NamedTuple):
    """A preset, the sentence that explains the choice, and the time that is left for the run."""

    name: str
    reason: str
    left: float
    is_measured: bool
    """Whether the choice is by timings of this machine."""

    def late_note(self, seconds: float) -> list[str]:
        """Return a sentence if a run took longer than the time that was left."""
        if seconds <= self.left:
            return []
        advice = (
            "--recalibrate measures this machine again"
            if self.is_measured
            else "without --shipped-rates, cvtgs measures this machine"
        )
        return [f"The run took {seconds:.1f} s, where {self.left:.1f} s were left; {advice}."]


def check_time_budget(options: argparse.Namespace, *, has_target: bool) -> None:
    """Check ``--time-budget``, and raise for options that exclude it or need it."""
    if options.time_budget is None:
        for name in ("recalibrate", "shipped_rates"):
            if getattr(options, name):
                option = name.replace("_", "-")
                raise InvalidArgumentError(f"--{option} needs --time-budget.")
        return
    if options.recalibrate and options.shipped_rates:
        raise InvalidArgumentError("give either --recalibrate or --shipped-rates, found both.")
    read_seconds(options.time_budget)
    excluded = {
        "--preset": options.preset is not None,
        "--config": options.config is not None,
        "--ckpt": options.ckpt not in ("auto", "none"),
        "--refine": options.refine is not None or options.refine_steps is not None,
        "--target-psnr and --target-ssim": has_target,
    }
    wrong = [name for name, is_given in excluded.items() if is_given]
    if wrong:
        raise InvalidArgumentError(
            f"--time-budget chooses the preset and cannot be used with {', '.join(wrong)}."
        )


def read_seconds(text: str) -> float:
    """Read ``--time-budget``, in seconds."""
    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyz")
    unit = text.strip()[len(number) :] or "s"
    try:
        seconds = float(number) * UNITS[unit]
    except (ValueError, KeyError):
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise InvalidArgumentError(
            f"--time-budget must be a time above 0, for example 20s or 2m; found {text!r}."
        )
    return seconds


def choose_preset(
    options: argparse.Namespace,
    scene: "GaussianScene",
    settings: Mapping[str, str],
    listener: "ProgressListener",
) -> ChosenPreset:
    """Choose the best preset that fits into the remaining time budget."""
    from cvtgs.budget.calibrate import is_calibrated

    budget, spent = read_seconds(options.time_budget), time.perf_counter() - options.begun
    if budget <= spent:
        raise GoalError(
            f"no preset fits into {budget:g} s: starting and reading took {spent:.1f} s."
        )
    target = cvtgs.target_count(
        len(scene), options.rho, count=options.count, max_count=options.max_count
    )
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
    work = cvtgs.budget.Work.of(scene, target)
    try:
        choice = cvtgs.budget.choose_preset(work, budget - spent, settings=settings, model=model)
    except GoalError as error:
        raise GoalError(
            f"{error} Starting and reading took {spent:.1f} of {budget:g} s."
        ) from error
    reason = (
        f"Preset {choice.preset}, the best that fits into {budget:g} s: expected to take "
        f"{choice.seconds:.1f} s after {spent:.1f} s of starting and reading."
    )
    return ChosenPreset(choice.preset, reason, budget - spent, not options.shipped_rates)
