"""Choice of a preset that fits a time, and search for a count that reaches a quality."""

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Literal, NamedTuple

from cvtgs.budget.calibrate import CANDIDATES, cost_model
from cvtgs.budget.costs import CostModel, Work
from cvtgs.cameras import Cameras
from cvtgs.checks import checked
from cvtgs.clock import StageClock, StageCost, check_listener, join_costs
from cvtgs.config import SimplifyConfig
from cvtgs.counts import real_number, target_count
from cvtgs.errors import GoalError, InvalidArgumentError, InvalidSceneError, warn
from cvtgs.evaluation.blind_views import check_seen, shows
from cvtgs.evaluation.scorer import MOST_PSNR, Metrics, Scorer, scene_scores
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import SearchReport, Simplified, SimplifyReport, Tried
from cvtgs.scene import GaussianScene, SceneLike
from cvtgs.simplifier import Simplifier
from cvtgs.text import shown
from cvtgs.validity import valid_rows
from cvtgs.views import automatic_views

STAGE = "search"
SCORE = "score"  # the stage of the held-out views, in the report

HELDOUT_SEED = 307  # of views for presets that use images: none is of a preset or refinement
VIEWS, WIDTH, HEIGHT = 8, 640, 480  # as in ``cvtgs evaluate``: scores depend on the size of images

MOST_SHARE = 0.9  # largest share of Gaussians to try: above it, the full scene is hardly larger
MOST_TRIES = 16
CLOSE = 1.03  # the search ends when a sufficient and an insufficient count are within this factor
MARGIN = 1.3  # predictions are accurate to 30 %, so a preset must fit with this factor
_FIRST_SHARE, _STEP, _SHORTEST = 0.1, 8.0, 0.15


class Found(NamedTuple):
    """The smallest scene that is good enough, and its scores over the held-out views.

    Attributes:
        scene: The scene.
        report: The report of its simplification, with that of the search.
        psnr: Mean PSNR, dB, at most 60 each.
        ssim: Mean SSIM.
        alpha_error: Mean absolute difference of accumulated alpha.
        alpha_bias: Mean signed difference; negative if more of the background shows through.
        tried: All counts that were tried, in order.
    """

    scene: GaussianScene
    report: SimplifyReport
    psnr: float
    ssim: float
    alpha_error: float
    alpha_bias: float
    tried: tuple[Tried, ...]


class Target(NamedTuple):
    """The quality to reach: dB or similarity."""

    metric: Literal["psnr", "ssim"]
    value: float

    def of(self, tried: Tried) -> float:
        """Return the score of the metric."""
        return tried.psnr if self.metric == "psnr" else tried.ssim

    def text(self, value: float, digits: int = 0) -> str:
        """Format a value of the metric, with some more digits than usual."""
        if self.metric == "psnr":
            return f"{value:.{2 + digits}f} dB"
        return f"SSIM {value:.{4 + digits}f}"

    def missed(self, value: float) -> tuple[str, str]:
        """Format this quality in full and a lower one, with as many digits as tell them apart."""
        usual = 2 if self.metric == "psnr" else 4
        exact = (more for more in range(9) if round(self.value, usual + more) == self.value)
        digits = range(next(exact, 0), 9)
        texts = ((self.text(self.value, more), self.text(value, more)) for more in digits)
        return next((pair for pair in texts if pair[0] != pair[1]), (self.text(self.value),) * 2)


def checked_target(psnr: float | None, *, ssim: float | None) -> Target:
    """Return the quality to reach; raise if no scene can have it."""
    if psnr is not None and ssim is None:
        if not 0 < real_number(psnr) <= MOST_PSNR:
            raise InvalidArgumentError(
                f"the PSNR to reach must be above 0 and at most {MOST_PSNR:g} dB, found {psnr!r}."
            )
        return Target("psnr", psnr)
    if ssim is not None and psnr is None:
        if not 0 < real_number(ssim) < 1:
            raise InvalidArgumentError(
                f"the SSIM to reach must be above 0 and below 1, found {ssim!r}."
            )
        return Target("ssim", ssim)
    raise InvalidArgumentError("give either psnr or ssim, found both or neither.")


@checked
def find_count(
    scene: SceneLike,
    *,
    psnr: float | None = None,
    ssim: float | None = None,
    simplifier: Simplifier | None = None,
    cameras: Cameras | None = None,
    heldout: Cameras | None = None,
    written: Callable[[GaussianScene], GaussianScene] = lambda scene: scene,
    listener: ProgressListener = silent,
) -> Found:
    """Find the smallest number of Gaussians that reaches a quality, to within 3 %.

    Quality is measured over the eight automatic views of ``cvtgs evaluate``; for presets that use
    images, over eight others, which no preset uses. Views that show nothing of the scene are left
    out. The full scene is rendered, checked and analyzed once; a search takes six to ten
    simplifications. If quality does not rise monotonically with the count, a smaller count may
    also reach it.

    Memory: that of a simplification, one small scene, and ``12 c h w`` bytes of images.

    Args:
        scene: The full scene, which is not changed, or the path of its file or folder.
        psnr: Mean PSNR to reach, dB, above 0 and at most 60.
        ssim: Mean SSIM to reach instead, above 0 and below 1.
        simplifier: Simplifier of the scene; None for the standard one.
        cameras: Views for presets that use images of the scene; None finds or generates views.
        heldout: Held-out views to measure over; None for the automatic ones.
        written: Called with each simplified scene; returns the scene to score, for example as it
            is read back from a file whose format rounds. The result is not rounded.
        listener: Called with progress events.

    Returns:
        The scene, and all counts that were tried.

    Raises:
        GoalError: Even nine tenths of the valid Gaussians do not reach it; the message names the
            best result.
        InvalidArgumentError: Both or neither are given, one is out of range, ``heldout`` is empty,
            or an argument has another type.
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
    check_listener(listener)
    target = checked_target(psnr, ssim=ssim)
    simplifier = simplifier or Simplifier()
    prepared = simplifier.prepare(scene, cameras=cameras)
    total, full = len(prepared.scene), prepared.scene
    if total == 0:
        raise InvalidSceneError("the scene must have at least one Gaussian, found none.")
    if heldout is None:
        seed = HELDOUT_SEED if simplifier.config.uses_images else 0
        heldout = automatic_views(full, VIEWS, width=WIDTH, height=HEIGHT, seed=seed)
    clock = StageClock(silent, full.device)
    with clock.stage(SCORE):
        scorer = heldout_scorer(full, heldout, listener=listener)
    tried: list[Tried] = []
    costs: list[StageCost] = []
    best: tuple[Simplified, Tried] | None = None

    def reach(count: int) -> float:
        nonlocal best
        made = prepared.run(count=count)
        costs.extend(made.report.stages)
        with clock.stage(SCORE):
            tried.append(heldout_quality(scorer, written(made.scene), count=count))
        value = target.of(tried[-1])
        if value >= target.value and (best is None or len(made.scene) < len(best[0].scene)):
            best = made, tried[-1]
        return value

    most = max(1, math.floor(MOST_SHARE * int(valid_rows(full).sum())))
    tries = islice(smallest_enough(reach, target.value, most=most), MOST_TRIES)
    listener(ProgressEvent(stage=STAGE, done=0, total=MOST_TRIES))
    for number, (count, value) in enumerate(tries, start=1):
        note = f"{count:,}: {target.text(value)}"
        done = min(number, MOST_TRIES - 1)  # the last event follows
        listener(ProgressEvent(stage=STAGE, done=done, total=MOST_TRIES, note=note))
    listener(ProgressEvent(stage=STAGE, done=MOST_TRIES, total=MOST_TRIES))
    if best is None:
        nearest = max(tried, key=target.of)
        wanted, reached = target.missed(target.of(nearest))
        raise GoalError(
            f"no simplified scene reaches {wanted}: the best one tried, with {nearest.count:,} of "
            f"{total:,} Gaussians, reaches {reached}."
        )
    (small, report), quality = best
    search = SearchReport(
        metric=target.metric, target=target.value, tried=tuple(tried), **quality.model_dump()
    )
    stages = tuple(join_costs([*costs, *clock.costs]))
    report = report.model_copy(update={"search": search, "stages": stages})
    scores = quality.model_dump(exclude={"count"})
    return Found(small, report, tried=search.tried, **scores)


def heldout_scorer(full: GaussianScene, cameras: Cameras, *, listener: ProgressListener) -> Scorer:
    """Return a scorer against the full scene over held-out views."""
    total = len(cameras)
    if total == 0:
        raise InvalidArgumentError("heldout must hold at least one camera, found none.")
    check_seen(full, cameras, name="the scene")
    scorer = Scorer(
        full,
        cameras.singles(),
        metrics=Metrics(most_psnr=MOST_PSNR),
        counts=lambda truth: shows(full, truth.cameras, truth.alpha),
        progress=lambda done: listener(ProgressEvent(stage="look", done=done, total=total)),
    )
    if len(scorer) == 0:
        raise InvalidArgumentError("heldout must show something of the scene, found nothing.")
    if len(scorer) < total:
        warn(
            f"{total - len(scorer)} of {total} views show nothing of the scene, so quality is "
            f"measured over the others."
        )
    return scorer


def heldout_quality(scorer: Scorer, small: GaussianScene, *, count: int) -> Tried:
    """Score a small scene over the held-out views."""
    means = scene_scores("", len(small), scorer.score(small)).means()
    return Tried(count=count, **{name: means[name] for name in means if name != "lpips"})


def smallest_enough(
    reach: Callable[[int], float], wanted: float, *, most: int
) -> Iterator[tuple[int, float]]:
    """Search for the smallest count whose value reaches a goal; yield each count and its value."""
    # It steps by a factor until it has a sufficient and an insufficient count. Then it interpolates
    # on logarithms, but never leaves more than 85 % of the bracket (regula falsi with the guarantee
    # of bisection, as Dekker 1969).
    low, low_value = 0, -math.inf
    high, high_value = most + 1, math.inf
    count = max(1, min(most, round(_FIRST_SHARE * most)))
    while True:
        value = reach(count)
        yield count, value
        if value >= wanted:
            high, high_value = count, value
        else:
            low, low_value = count, value
        if high - low <= 1 or (low > 0 and high <= most and high <= CLOSE * low):
            return
        if high > most:
            count = min(most, math.ceil(_STEP * low))
        elif low == 0:
            count = max(1, int(high / _STEP))
        else:
            start, end = math.log(low), math.log(high)
            rise = high_value - low_value
            share = (wanted - low_value) / rise if 0 < rise < math.inf else 0.5
            share = min(max(share, _SHORTEST), 1 - _SHORTEST)
            count = round(math.exp(start + share * (end - start)))
            count = min(max(count, low + 1), high - 1)


def _rounded(seconds: float) -> str:
    return f"{seconds:.2g}" if seconds < 10 else f"{seconds:,.0f}"


class Choice(NamedTuple):
    """A preset that fits the time.

    Attributes:
        preset: Name of the preset.
        seconds: Predicted wall-clock seconds.
    """

    preset: str
    seconds: float


@checked
def choose_preset(
    work: GaussianScene | Work,
    seconds: float,
    *,
    rho: float | None = None,
    count: int | None = None,
    settings: Mapping[str, str] | None = None,
    model: CostModel | None = None,
    cameras: Cameras | None = None,
    with_images: bool = True,
) -> Choice:
    """Choose the best preset whose simplification fits a time.

    The presets are ordered from the fastest to the best; ``paper``, which is only for comparison,
    is never chosen. A preset fits only if 1.3 times its predicted seconds do.

    Args:
        work: The scene, with ``rho`` or ``count``; or a :class:`Work`, which has its own target.
        seconds: Wall-clock seconds from the scene in memory to the small scene in memory.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        settings: Changes to every preset: texts by dotted key, for example
            ``{"visibility.views": "0"}``.
        model: The cost of presets; None for :func:`cvtgs.budget.cost_model`, which measures it once
            on this machine.
        cameras: Cameras to render from, if they are given: a few make fewer images than presets do,
            and their errors take a second allocation.
        with_images: Whether presets that render images may be chosen, which need 400 MB more.

    Raises:
        GoalError: Not even the fastest preset fits; the message says how long it takes.
        InvalidArgumentError: Seconds, ratio or count are out of range, or an argument has another
            type.
        ConfigError: A setting is unknown or out of range.

    Example:
        >>> rates = {"check": {"in": 4e-6}, "refine": {"looks_out": 1e-3}}
        >>> work = Work(count=1_000_000, target=10_000)
        >>> choose_preset(work, 9.0, model=CostModel(rates=rates))
        Choice(preset='standard', seconds=4.0)
    """
    if not 0 < real_number(seconds) < math.inf:
        raise InvalidArgumentError(f"the time must be above 0 and finite, found {seconds!r} s.")
    if settings and "preset" in settings:
        raise InvalidArgumentError(
            f"a time budget chooses the preset, so no setting may name it; found preset = "
            f"{settings['preset']}."
        )
    if isinstance(work, GaussianScene):
        work = Work.of(work, target_count(len(work), rho, count=count))
    elif rho is not None or count is not None:
        raise InvalidArgumentError("rho and count are for a scene only; a Work has its target.")
    if model is not None and not model.rates:
        raise InvalidArgumentError(f"model must be a CostModel with rates, found {shown(model)}.")
    known = cost_model() if model is None else model
    configs = {name: SimplifyConfig.compose(preset=name, settings=settings) for name in CANDIDATES}
    if cameras is not None:
        configs = {name: _with_views(one, most=len(cameras)) for name, one in configs.items()}
    costs = {
        name: known.seconds(work, config, with_cameras=cameras is not None)
        for name, config in configs.items()
        if with_images or not config.uses_images
    }
    if not costs:
        raise InvalidArgumentError(
            "with_images must be true where the settings make every preset render images, found "
            "false."
        )
    fitting = [name for name, cost in costs.items() if MARGIN * cost <= seconds]
    if not fitting:
        fastest = min(costs, key=lambda name: costs[name])
        raise GoalError(
            f"no preset fits into {_rounded(seconds)} s: the fastest, {fastest}, takes about "
            f"{_rounded(costs[fastest])} s to make {work.target:,} of {work.count:,} Gaussians, "
            f"and {MARGIN:g} times that is reserved."
        )
    best = fitting[-1]
    return Choice(best, costs[best])


def _with_views(config: SimplifyConfig, *, most: int) -> SimplifyConfig:
    views = min(config.visibility.views, most)
    visibility = config.visibility.model_copy(update={"views": views})
    return config.model_copy(update={"visibility": visibility})
