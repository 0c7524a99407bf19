"""The optimization of a scene: limits, learning rates per Gaussian, Adam steps, the best scene."""

import math
import time
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.analysis import ambient_visibility
from cvtgs.config import Rates, RefineConfig
from cvtgs.counts import checked_whole, real_number
from cvtgs.cvt import nearest_site
from cvtgs.cvt.nearest import runs_of_equal
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.scorer import MOST_PSNR, Scorer
from cvtgs.losses import relative_loss
from cvtgs.math import parameters
from cvtgs.math.frames import robust_frame
from cvtgs.math.parameters import divide
from cvtgs.math.segments import kth_smallest
from cvtgs.progress import ProgressEvent, ProgressListener
from cvtgs.refinement.images import ImageBuffer
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.validity import standardized, valid_rows, with_finite_opacities

STAGE = "refine"

_LARGEST = 1e18

THINNEST = 0.1  # axes below this share of the mean axis count as this thick, as in images
MOST_CONCENTRATED = 0.75  # so a changed Gaussian that represents only one other moves at a quarter
LARGE = 2.0  # times the upper quartile of sizes; Gaussians beyond it move less
MARKING = ("log_scales", "logit_opacities", "sh0")  # what tells Gaussians at one position apart
_BETAS = (0.6, 0.99)

WEAK = 0.01  # gradients below this share of their root mean square cause shorter steps
_LEAST_ROOT = 1e-15

PARTS = 0.75, 0.5, 0.25  # shares of the changes to try if held-out images refuse all of them


class Limits:
    """Counters of steps and seconds, which decide whether one more step fits."""

    def __init__(self, seconds: float | None, *, steps: int | None) -> None:
        if seconds is not None and not 0 < real_number(seconds) < math.inf:
            raise InvalidArgumentError(
                f"the refinement time in seconds must be above 0 and finite, found {seconds!r}."
            )
        self._start = time.perf_counter()
        self._last = self._start
        self.seconds = None if seconds is None else float(seconds)  # also one of numpy
        self._steps = (
            None if steps is None else checked_whole(steps, "the number of refinement steps")
        )
        self._slowest = {"step": 0.0, "check": 0.0}
        self.steps: int = 0

    @property
    def total(self) -> int:
        """Total units of progress: steps, or thousandths of the time."""
        return 1000 if self.seconds is not None or self._steps is None else self._steps

    @property
    def done(self) -> int:
        """Units of progress so far, at least 1 after a step, and below :attr:`total`."""
        return max(min(int(self.share() * self.total), self.total - 1), min(self.steps, 1))

    def share(self) -> float:
        """Return the used share of the steps or seconds, whichever is larger."""
        of_steps = self.steps / self._steps if self._steps else 0.0
        elapsed = time.perf_counter() - self._start
        return min(1.0, max(of_steps, elapsed / self.seconds if self.seconds else 0.0))

    def begin(self) -> None:
        """Start to time a step or check."""
        self._last = time.perf_counter()

    def end(self, kind: Literal["step", "check"]) -> None:
        """Record the time since the last call, and count a step."""
        now = time.perf_counter()
        self._slowest[kind] = max(self._slowest[kind], now - self._last)
        self._last = now
        self.steps += kind == "step"

    def reached(self) -> str:
        """Return the limit, ``steps`` or ``time``, that one more step would exceed; else ""."""
        if self._steps is not None and self.steps >= self._steps:
            return "steps"
        if self.seconds is None:
            return ""
        needed = time.perf_counter() - self._start + sum(self._slowest.values())
        return "time" if needed > self.seconds else ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optimized:
    """The result of an optimization."""

    scene: GaussianScene  # the best by held-out images; the input scene if none was better
    before: float  # score of the input scene, dB
    after: float  # score of the best scene, dB
    stopped: str  # reason for the end: ``steps``, ``time``, ``patience`` or ``perfect``


def optimize(
    small: GaussianScene,
    images: ImageBuffer,
    scorer: Scorer,
    *,
    limits: Limits,
    config: RefineConfig,
    learning_rate_scale: Float[Tensor, "n"],
    listener: ProgressListener,
) -> Optimized:
    """Fit the Gaussians of a scene to images of the full one, some images per step."""
    limits.begin()
    first = heldout_psnr(small, scorer)
    cap = psnr_cap(first)
    best, before = small, float(first.clamp(max=cap).mean())
    limits.end("check")
    optimizer = SceneOptimizer(small, config.rates, learning_rate_scale=learning_rate_scale)
    after, checks_without_gain = before, 0
    stopped = "perfect" if float(first.amin()) >= MOST_PSNR else limits.reached()
    while not stopped:
        factor = step_factor(limits, config)
        limits.begin()
        optimizer.step(mean_loss(optimizer.scene(), images, config), factor=factor)
        limits.end("step")
        stopped = limits.reached()
        if stopped or limits.steps % config.check_every == 0:
            scene = optimizer.result()
            score = float(heldout_psnr(scene, scorer).clamp(max=cap).mean())
            limits.end("check")
            if score > after:
                best, after, checks_without_gain = scene, score, 0
            else:
                checks_without_gain += 1
            if not stopped:
                is_stuck = checks_without_gain >= config.patience
                stopped = "patience" if is_stuck else limits.reached()
        note = f"{after - before:+.2f} dB"
        listener(ProgressEvent(stage=STAGE, done=limits.done, total=limits.total, note=note))
    if after == before and limits.steps and stopped != "time":
        # Steps that fit their images too closely still point the right way, and lead too far.
        for part in PARTS:
            scene = optimizer.result(part=part)
            score = float(heldout_psnr(scene, scorer).clamp(max=cap).mean())
            if score > before:
                best, after = scene, score
                break
    return Optimized(scene=best, before=before, after=after, stopped=stopped)


def mean_loss(scene: GaussianScene, images: ImageBuffer, config: RefineConfig) -> Tensor:
    """Return the mean loss of a scene in the images of one step."""
    loss = scene.means.new_zeros(())
    for targets in images.draw_step():
        # Random backgrounds, because a wrong opacity is visible over some colors.
        backgrounds = images.draw_backgrounds(len(targets.rgb))
        image = render(scene, targets.cameras, background=backgrounds).rgb
        part = relative_loss(
            image,
            targets.over(backgrounds),
            mse_weight=config.mse_weight,
            image_weight=config.image_weight,
        )
        loss = loss + part * (len(targets.rgb) / config.images_per_step)
    return loss


def step_factor(limits: Limits, config: RefineConfig) -> float:
    """Return the length of the next step relative to the first one."""
    left = 1.0 - limits.share()
    cooled = left / config.cooling if left < config.cooling else 1.0
    return cooled / (1 + limits.steps / config.half_after)


def heldout_psnr(scene: GaussianScene, scorer: Scorer) -> Float[Tensor, "p"]:
    """Return the PSNR of each held-out image, dB, in float64."""
    return torch.tensor(
        [image.psnr for image in scorer.score(scene)], dtype=torch.float64, device="cpu"
    )


def psnr_cap(first: Float[Tensor, "p"]) -> float:
    """Return the most that an image counts, dB, lest a view of a uniform wall outweigh others."""
    return min(MOST_PSNR, float(first.median()) + 10.0)


class SceneOptimizer:
    """A scene as initial values plus changes, and Adam (Kingma and Ba 2015) for the changes.

    Unseen Gaussians keep their momentum. Each corrects bias by its own count of steps, or rarely
    seen ones would move too far; epsilon is a share of the root mean square of all gradients.
    ``torch.optim.SparseAdam`` has neither, and takes a second to import. Memory: five scenes.
    """

    def __init__(
        self, scene: GaussianScene, rates: Rates, *, learning_rate_scale: Float[Tensor, "n"]
    ) -> None:
        self._scene = scene
        # Finite opacities and unit quaternions, which render the same.
        start = with_finite_opacities(scene).tensors()
        self._start = start | {"quats": parameters.normalize_quats(start["quats"])}
        self._units = _units(scene, learning_rate_scale)
        self._frames = parameters.rotation_matrices(self._start["quats"])
        self._rates = {
            name: rate
            for name, rate in rates.model_dump().items()
            if rate > 0 and self._start[name].numel()
        }
        # All changes are columns of one tensor, which takes far fewer operations.
        self._widths = [self._start[name][0].numel() for name in self._rates]
        pairs = zip(self._rates.values(), self._widths, strict=True)
        self._column_rates = scene.means.new_tensor([r for r, width in pairs for _ in range(width)])
        self._changes = scene.means.new_zeros(len(scene), sum(self._widths), requires_grad=True)
        self._moved = torch.zeros(len(scene), dtype=torch.bool, device=scene.device)
        self._moments = torch.zeros_like(self._changes), torch.zeros_like(self._changes)
        self._counts = scene.means.new_zeros(len(scene), 1)  # steps of each Gaussian

    def scene(self, *, part: float = 1.0) -> GaussianScene:
        """Return the scene after some part of the changes, differentiable in them."""
        changes = self._changes if part == 1.0 else part * self._changes
        shifts = {
            name: change.view(self._start[name].shape) * self._units[name]
            for name, change in zip(self._rates, changes.split(self._widths, 1), strict=True)
        }
        if "means" in shifts:
            shifts["means"] = (self._frames @ shifts["means"][:, :, None])[:, :, 0]
        if "quats" in shifts:
            shifts["quats"] = parameters.multiply_quats(self._start["quats"], shifts["quats"])
        moved = {name: self._start[name] + shift for name, shift in shifts.items()}
        return self._scene.with_tensors(self._start | moved)

    def step(self, loss: Tensor, *, factor: float) -> None:
        """Move every Gaussian with a finite nonzero gradient."""
        if not self._rates or not loss.requires_grad:
            return
        (gradient,) = torch.autograd.grad(loss, [self._changes], materialize_grads=True)
        rows = ((gradient != 0).any(dim=1) & gradient.isfinite().all(dim=1)).nonzero()[:, 0]
        counts = self._counts.index_select(0, rows).add_(1)
        self._counts.index_copy_(0, rows, counts)
        largest = 0.5 * torch.finfo(gradient.dtype).max ** 0.5  # its square must not overflow
        some = gradient.index_select(0, rows).clamp_(-largest, largest)
        means, squares = (
            _moved_average(values, rows, new, beta)
            for values, new, beta in zip(self._moments, (some, some.square()), _BETAS, strict=True)
        )
        common = self._moments[1].mean(dim=0, dtype=torch.float64).sqrt_().to(gradient.dtype)
        roots = squares.sqrt_().add_(WEAK * common).add_(_LEAST_ROOT)
        biases = [1 - beta**counts for beta in _BETAS]
        lengths = biases[1].sqrt_().div_(biases[0]).mul_(-factor)
        change = means.div_(roots).mul_(lengths).mul_(self._column_rates)
        values = self._changes.detach()
        values.index_copy_(0, rows, change.add_(values.index_select(0, rows)))
        self._moved[rows] = True

    @torch.no_grad()
    def result(self, *, part: float = 1.0) -> GaussianScene:
        """Return the scene as it would be saved, after some part of the changes."""
        current = self.scene(part=part)
        moved, now = self._moved & valid_rows(current), standardized(current)
        tensors = {
            name: torch.where(_like(moved, old), now.tensors()[name], old)
            for name, old in self._scene.tensors().items()
        }
        return self._scene.with_tensors(tensors)


def _units(scene: GaussianScene, scale: Float[Tensor, "n"]) -> dict[str, Tensor]:
    """Return the length of one unit of change, in the frame of each Gaussian.

    As in the Fisher metric, it changes the density equally along each axis: the standard deviation
    for a position, ``ab / |a^2 - b^2|``, at most 1, for a rotation of two axes.
    """
    axes = torch.where((scale > 0)[:, None], torch.exp(scene.log_scales), 0.0)
    axes = axes.clamp_max(_LARGEST)  # their products must not overflow
    axes = torch.maximum(axes, THINNEST * axes.mean(dim=1, keepdim=True))
    first, second = axes[:, [1, 2, 0]], axes[:, [2, 0, 1]]
    squares = (first.square() - second.square()).abs()
    turns = (first * second / squares.clamp_min(1e-30)).clamp_max(1.0)
    units = {name: _like(scale, tensor) for name, tensor in scene.tensors().items()}
    return units | {
        "means": scale[:, None] * axes,
        "quats": scale[:, None] * torch.nn.functional.pad(turns, (1, 0)),
    }


def _moved_average(values: Tensor, rows: Tensor, new: Tensor, beta: float) -> Tensor:
    """Update running averages of some rows in place, and return a copy of these rows."""
    old = values.index_select(0, rows)
    moved = (new - old).mul_(1 - beta).add_(old)
    values.index_copy_(0, rows, moved)
    return moved


def _like(values: Float[Tensor, "n"], tensor: Tensor) -> Tensor:
    """Reshape values per Gaussian to broadcast against a tensor."""
    return values.reshape(-1, *[1] * (tensor.ndim - 1))


@torch.no_grad()
def learning_rate_scales(small: GaussianScene, full: GaussianScene) -> Float[Tensor, "n"]:
    """Return the learning-rate factor of each Gaussian, 0 to 1; invalid rows do not move.

    Enclosed Gaussians (:func:`cvtgs.analysis.ambient_visibility`) move less, as they may be all
    that other views see; so do those of few others, which are nearly right, and large ones, mostly
    fog.
    """
    valid = valid_rows(small)
    some = small.select(valid)
    visibility = ambient_visibility(some.means, some.masses, robust_frame(some.means))
    free = visibility * (1.0 - _concentrations(some, full))
    scales = torch.zeros_like(small.logit_opacities)
    scales[valid] = (free * _size_factors(some, free > 0.0)).to(small.dtype)
    return scales


def _size_factors(scene: GaussianScene, movable: Bool[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return 1, or less for a Gaussian beyond :data:`LARGE` times the upper quartile of sizes."""
    sizes = scene.log_scales.double().amax(dim=1).clamp_min(-1e3)  # infinities have no differences
    some = sizes[movable]
    if len(some) == 0:
        return torch.ones_like(sizes)
    limit = math.log(LARGE) + kth_smallest(some, -(-3 * len(some) // 4))
    return (limit - sizes).clamp_max(0.0).exp()


def _concentrations(small: GaussianScene, full: GaussianScene) -> Float[Tensor, "n"]:
    """Return how few Gaussians of the full scene each represents: 0 for many, 1 for only itself.

    The squared shares of the mass nearest to it, summed (the index of Simpson 1949), at most
    :data:`MOST_CONCENTRATED`, or the own share of an unchanged Gaussian, if that is larger.
    """
    labels = _nearest_or_equal(full, small)
    same = torch.ones_like(labels, dtype=torch.bool)
    for name in ("means", *MARKING):
        before, now = getattr(full, name), getattr(small, name)
        same &= (before == now[labels]).reshape(len(full), -1).all(dim=1)
    labels, masses, same = labels.cpu(), full.masses.double().cpu(), same.cpu()
    around = torch.bincount(labels, masses, minlength=len(small))
    shares = divide(masses, around[labels])
    squares = torch.bincount(labels, shares.square(), minlength=len(small))
    own = torch.zeros_like(around)
    own.scatter_reduce_(0, labels[same], shares[same], "amax")
    return torch.maximum(squares.clamp_max(MOST_CONCENTRATED), own.clamp_max(1.0)).to(small.device)


def _nearest_or_equal(full: GaussianScene, small: GaussianScene) -> Int[Tensor, "n"]:
    """Return the nearest small Gaussian of each; of several at one position, an equal one."""
    if runs_of_equal(small.means) is None:
        return nearest_site(full.means, small.means)[0]
    unit = 1e-9 * robust_frame(small.means).radius / len(full)
    points, sites = (
        torch.cat([scene.means.double(), unit * _marks(scene)[:, None]], dim=1)
        for scene in (full, small)
    )
    return nearest_site(points, sites)[0]


def _marks(scene: GaussianScene) -> Float[Tensor, "n"]:
    """Return a number for every Gaussian, the same only for equal ones; copies are numbered."""
    marks = torch.zeros_like(scene.logit_opacities, dtype=torch.float64)
    values = torch.cat([getattr(scene, name).reshape(len(scene), -1) for name in MARKING], dim=1)
    for number, column in enumerate(values.unbind(1)):
        finite = column.double().clamp(-1e9, 1e9)  # opacity logits may be infinite
        marks += finite * math.sqrt(2 + number)  # incommensurable: sums rarely coincide
    marks %= 1.0
    runs = runs_of_equal(torch.cat([scene.means.double(), marks[:, None]], dim=1))
    if runs is not None:
        order, ranks = runs
        marks[order] += ranks
    return marks
