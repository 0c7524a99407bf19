"""The smallest number of Gaussians that looks as good as asked."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from cvtgs.budget.bisect import smallest_enough
from cvtgs.budget.goal import Goal, check_target
from cvtgs.budget.judge import Judge, Quality
from cvtgs.cameras import Cameras
from cvtgs.errors import GoalError
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import Simplified, SimplifyReport
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier

STAGE = "search"

MOST_SHARE = 0.9
"""Scenes that keep more are not worth their loss: the full scene is hardly larger."""

MOST_TRIES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """A number of Gaussians that was tried.

    Attributes:
        count: The number.
        psnr: What it reached, dB, at most 60.
        ssim: What it reached.
    """

    count: int
    psnr: float
    ssim: float


class Found(NamedTuple):
    """The smallest scene that is good enough.

    Attributes:
        scene: The scene.
        report: How it came about.
        psnr: Its mean PSNR over the held-out views, dB, at most 60 each.
        ssim: Its mean SSIM over them.
        tried: Everything that was tried, in that order.
    """

    scene: GaussianScene
    report: SimplifyReport
    psnr: float
    ssim: float
    tried: tuple[Tried, ...]


def find_count(
    scene: GaussianScene,
    *,
    psnr: float | None = None,
    ssim: float | None = None,
    simplifier: Simplifier | None = None,
    cameras: Cameras | None = None,
    heldout: Cameras | None = None,
    listener: ProgressListener = silent,
) -> Found:
    """Find the smallest number of Gaussians that reaches a quality, to 3 %.

    Quality is measured over eight automatic views that no preset looks at. The full scene is
    rendered, checked and looked at once; a search takes six to ten simplifications. Where
    quality does not rise with every Gaussian, a smaller number than the one that is found may
    do by chance.

    Memory: that of a simplification, one small scene, and ``12 c h w`` bytes of images.

    Args:
        scene: The full scene; it is not changed.
        psnr: Mean PSNR to reach, dB, above 0 and at most 60.
        ssim: Mean SSIM to reach instead, above 0 and below 1.
        simplifier: Makes the small scenes; None for the standard one.
        cameras: From where presets that look at the scene do so; None finds views.
        heldout: Other views to measure over.
        listener: Told about every try.

    Returns:
        The scene, and what was tried.

    Raises:
        GoalError: Not even nine tenths of the Gaussians reach it; the text says what they reach.
        InvalidArgumentError: Both or neither are given, or one is out of range.
        InvalidSceneError: The scene has no valid row.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> full = make("object", 400, sh_degree=0)
        >>> few = automatic_views(full, 2, width=32, height=24, seed=9)
        >>> found = find_count(full, psnr=18.0, heldout=few)
        >>> found.psnr >= 18 and len(found.scene) < 400
        True
    """
    goal = check_target(psnr, ssim=ssim)
    judge = Judge(scene, heldout, listener=listener)
    prepared = (simplifier or Simplifier()).prepare(scene, cameras=cameras)

    def make(count: int) -> Simplified:
        return prepared.run(count=count)

    search = _Search(make, judge, goal, total=len(scene))
    most = max(1, math.floor(MOST_SHARE * len(scene)))
    listener(ProgressEvent(stage=STAGE, done=0, total=MOST_TRIES))
    tries = smallest_enough(search.reach, goal.wanted, most=most)
    for done, (count, value) in enumerate(islice(tries, MOST_TRIES), start=1):
        note = f"{count:,}: {goal.text(value)}"
        listener(ProgressEvent(stage=STAGE, done=done, total=MOST_TRIES, note=note))
    listener(ProgressEvent(stage=STAGE, done=MOST_TRIES, total=MOST_TRIES))
    return search.answer()


class _Search:
    """What was tried, and the best of it."""

    def __init__(
        self, make: Callable[[int], Simplified], judge: Judge, goal: Goal, *, total: int
    ) -> None:
        self._make, self._judge, self._goal, self._total = make, judge, goal, total
        self._tried: list[Tried] = []
        self._best: tuple[Simplified, Quality] | None = None

    def reach(self, count: int) -> float:
        """Try a number of Gaussians."""
        made = self._make(count)
        quality = self._judge.score(made.scene)
        self._tried.append(Tried(count=count, psnr=quality.psnr, ssim=quality.ssim))
        value = self._goal.of(quality)
        fewest = len(self._best[0].scene) if self._best else math.inf
        if value >= self._goal.wanted and len(made.scene) < fewest:
            self._best = made, quality
        return value

    def answer(self) -> Found:
        """Return the smallest scene that is good enough."""
        if self._best is None:
            best = max(self._tried, key=self._value)
            reached = self._goal.text(self._value(best))
            raise GoalError(
                f"no smaller scene reaches {self._goal.text(self._goal.wanted)}: the best that "
                f"was tried, {best.count:,} of {self._total:,} Gaussians, reaches {reached}."
            )
        made, quality = self._best
        return Found(made.scene, made.report, quality.psnr, quality.ssim, tuple(self._tried))

    def _value(self, tried: Tried) -> float:
        return self._goal.of(Quality(tried.psnr, tried.ssim))
