"""Goals of ``cvtgs simplify``: a time to keep, or a quality to reach."""

import argparse
import math
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from cvtgs.cli.large import keep_mask
from cvtgs.errors import GoalError, InvalidArgumentError
from cvtgs.progress import ProgressListener, silent

if TYPE_CHECKING:
    from cvtgs.cameras import Cameras
    from cvtgs.scene import GaussianScene
    from cvtgs.simplify import Simplified, Simplifier

STARTED = time.perf_counter()
"""When this process was young: a time budget counts from here."""

UNITS = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def add_goal_options(
    parser: argparse.ArgumentParser, size: "argparse._MutuallyExclusiveGroup"
) -> None:
    """Describe the options."""
    size.add_argument(
        "--target-psnr",
        type=float,
        metavar="DB",
        help="keep as few Gaussians as reach this PSNR over views that are held out",
    )
    size.add_argument(
        "--target-ssim", type=float, metavar="S", help="the same for SSIM, for example 0.9"
    )
    parser.add_argument(
        "--time-budget",
        metavar="TIME",
        help="instead of --preset: the best one that is done in this time, for example 20s or 2m; "
        "the first use measures this machine, which takes about a minute and is not counted",
    )
    parser.add_argument(
        "--recalibrate", action="store_true", help="measure this machine anew for --time-budget"
    )


class Goals:
    """What the options of one call ask for, and what came of it."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self.has_target = options.target_psnr is not None or options.target_ssim is not None
        self.seconds = None if options.time_budget is None else seconds_of(options.time_budget)
        self.said: list[str] = []
        if self.has_target and options.keep is not None:
            raise InvalidArgumentError("--keep needs --rho or --count.")
        if self.has_target:
            from cvtgs.budget.goal import check_target  # noqa: PLC0415 (only for those who ask)

            check_target(options.target_psnr, ssim=options.target_ssim)
        if self.seconds is not None:
            self._check_budget()
        elif options.recalibrate:
            raise InvalidArgumentError("--recalibrate goes with --time-budget.")

    def _check_budget(self) -> None:
        options = self._options
        others = {
            "--preset": options.preset is not None,
            "--config": options.config is not None,
            "--ckpt": options.ckpt not in ("auto", "none"),
            "--refine": options.refine is not None or options.refine_steps is not None,
            "--target-psnr and --target-ssim": self.has_target,
        }
        wrong = [name for name, is_given in others.items() if is_given]
        if wrong:
            raise InvalidArgumentError(
                f"--time-budget chooses the preset and cannot go with {', '.join(wrong)}."
            )

    def stage_listener(self, listener: ProgressListener) -> ProgressListener:
        """Return what hears of the stages: nobody if they run again and again."""
        return silent if self.has_target else listener

    def preset(
        self, scene: "GaussianScene", settings: Mapping[str, str], listener: ProgressListener
    ) -> str | None:
        """Choose the preset that fits into the time, if a time is given."""
        if self.seconds is None:
            return None
        from cvtgs.budget import Work, choose_preset, cost_model  # noqa: PLC0415
        from cvtgs.budget.remember import is_known  # noqa: PLC0415
        from cvtgs.simplify import target_count  # noqa: PLC0415

        options, spent = self._options, time.perf_counter() - STARTED
        left = self.seconds - spent
        if left <= 0:
            raise GoalError(
                f"no preset fits into {self.seconds:g} s: starting and reading took {spent:.1f} s."
            )
        target = target_count(len(scene), options.rho, count=options.count)
        again = options.recalibrate or not is_known(options.device)
        if again and not options.quiet:
            print("cvtgs: measuring this machine once, about a minute", file=sys.stderr)
        model = cost_model(options.device, recalibrate=again, listener=listener)
        if options.ckpt == "none":
            settings = {**settings, "merge.network": "false"}
        choice = choose_preset(Work.of(scene, target), left, settings=settings, model=model)
        self.said.append(
            f"Preset {choice.preset}, the best that fits into {self.seconds:g} s: expected to take "
            f"{choice.seconds:.1f} s after {spent:.1f} s of starting and reading."
        )
        return choice.preset

    def run(
        self,
        simplifier: "Simplifier",
        scene: "GaussianScene",
        *,
        cameras: "Cameras | None" = None,
        listener: ProgressListener = silent,
    ) -> "Simplified":
        """Simplify to the ratio or count that is asked for, or to the quality."""
        options = self._options
        if not self.has_target:
            keep = keep_mask(options, scene)
            return simplifier.run(
                scene, options.rho, count=options.count, cameras=cameras, keep=keep
            )
        from cvtgs.budget import find_count  # noqa: PLC0415
        from cvtgs.simplify import Simplified  # noqa: PLC0415

        found = find_count(
            scene,
            psnr=options.target_psnr,
            ssim=options.target_ssim,
            simplifier=simplifier,
            cameras=cameras,
            listener=listener,
        )
        self.said.append(
            f"PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.4f} over views that were held out; "
            f"found in {len(found.tried)} tries."
        )
        return Simplified(found.scene, found.report)


def seconds_of(text: str) -> float:
    """Read a time."""
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
