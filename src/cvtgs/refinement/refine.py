"""The public functions of refinement."""

from copy import deepcopy
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from cvtgs.cameras import Cameras, checked_cameras
from cvtgs.clock import StageClock, check_listener
from cvtgs.config import RefineConfig
from cvtgs.counts import checked_whole
from cvtgs.devices import chosen_device, full_precision, threads_for_chunks, within_memory
from cvtgs.errors import InvalidArgumentError, InvalidSceneError, memory_errors, warn
from cvtgs.evaluation.blind_views import check_seen
from cvtgs.evaluation.scorer import BLACK, MOST_PSNR, WHITE, Metrics, Scorer
from cvtgs.progress import ProgressListener, silent
from cvtgs.refinement.images import (
    ImageBuffer,
    RefineViews,
    generated_views,
    shared_views,
    split_views,
)
from cvtgs.refinement.optimize import STAGE, Limits, learning_rate_scales, optimize
from cvtgs.rendering import ObservedViews
from cvtgs.rendering.backends import choose_backend
from cvtgs.rendering.projection import warn_of_near_plane
from cvtgs.rendering.render import check_observed
from cvtgs.report import RefineReport, SimplifyReport
from cvtgs.scene import GaussianScene, SceneLike, as_scene
from cvtgs.text import shown
from cvtgs.validity import valid_rows
from cvtgs.views.positions import checked_seed

DEFAULT_STEPS = 500  # number of steps if neither seconds nor steps are given


class Refined(NamedTuple):
    """A refined scene and its report.

    Attributes:
        scene: The scene.
        report: The gain and the cost.
    """

    scene: GaussianScene
    report: RefineReport


def refine(  # noqa: PLR0913 (all but the scenes are options by name)
    small: SceneLike,
    full: SceneLike,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    cameras: Cameras | None = None,
    config: RefineConfig | None = None,
    seed: int = 0,
    device: str | torch.device = "auto",
    frozen: int = 0,
    observed: ObservedViews | None = None,
    listener: ProgressListener = silent,
) -> Refined:
    """Fine-tune a simplified scene so that its images match those of the full scene better.

    Each step uses ``config.images_per_step`` images of the full scene, each over a random
    background; Adam moves the Gaussians that they show. The scene of highest PSNR on held-out views
    is returned. If none is better than the input, three quarters, a half and a quarter of the
    changes are tried, and the first that is better is returned, or the input scene. Number of
    Gaussians, SH degree, comments, layout and extra columns are kept. Gaussians that no image shows
    stay bit for bit, as do those that represent only themselves, and invalid rows, which are not
    drawn. About every third image of a scene tagged mip ignores the tag, as many viewers do.

    The same scenes, steps, configuration and seed give the same bits on a CPU; with ``seconds``
    the number of steps depends on the clock. The time includes everything, even the compilation
    of numba code at its first use on a machine, some ten seconds. Views and held-out images come
    first, one to five seconds on a CPU, also if that is longer than ``seconds``; if then no step
    fits, a warning says so, and the scene is unchanged.

    Memory: ten times the small scene, 80 more bytes per Gaussian for each further image of a step,
    the memory for rendering the full scene, and the reused images (those of given cameras), at most
    ``8 * size ** 2 * images`` bytes.

    Args:
        small: The simplified scene; it is not changed.
        full: The scene that it was made from.
        seconds: Wall-clock time, seconds; a step that would exceed it is not taken.
        steps: Largest number of steps; if neither is given, the configuration decides, with more
            for few Gaussians if ``config.lengthening`` says so, else 500.
        cameras: The views, at least 2; an eighth of them, from 1 to ``config.heldout``, is held
            out. None finds new views: automatic ones, and others from all around.
        config: All other settings; None for the defaults.
        seed: Seed of the choice and order of views.
        device: Device to compute on: ``auto`` is that of the small scene, or CUDA, if available,
            for scenes on the CPU. The result is on the device of the small scene.
        frozen: Number of Gaussians at the start of the scene that stay bit for bit.
        observed: Existing images of the full scene, with the size and stride of the configuration.
            They are used first; an eighth of them, as of cameras, is held out. A single one is not
            used, since it could only be held out.
        listener: Called at the start, after steps and checks, with the gain so far as its note, and
            at the end.

    Returns:
        The scene and the report.

    Raises:
        InvalidArgumentError: Seconds or steps are not positive, there is only one camera, no
            camera sees the full scene, ``frozen`` is out of range, the seed is no whole number, or
            the first scene has more Gaussians than the second.
        InvalidSceneError: A scene has no valid row.
        DeviceError: There is no such device.
        OutOfMemoryError: The memory does not suffice. A device computes in short chunks first, and
            with ``auto`` the CPU instead, which the report says.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 1000, sh_degree=0, seed=0)
        >>> result = refine(scene, scene, steps=2, config=RefineConfig(size=32, heldout=2))
        >>> result.report.stopped, result.report.gain
        ('perfect', 0.0)
    """
    small, full = as_scene(small, "small"), as_scene(full, "full")
    if len(small) > len(full):
        raise InvalidArgumentError(
            f"small must have at most as many Gaussians as full, found {len(small):,} and "
            f"{len(full):,}; the simplified scene comes first."
        )
    config = RefineConfig() if config is None else config
    if not isinstance(config, RefineConfig):
        raise InvalidArgumentError(f"config must be a RefineConfig, found {shown(config)}.")
    thinning, config = config.thinning(len(small)), config.for_count(len(small))
    if seconds is None and steps is None:
        seconds = config.seconds or None
        steps = config.steps or (DEFAULT_STEPS if seconds is None else None)
    limits = Limits(seconds, steps=steps)
    frozen = checked_whole(frozen, "frozen", least=0, most=len(small), things="Gaussians")
    check_listener(listener)
    if observed is not None:
        check_observed(observed, "observed")
    checked_seed(seed)
    seed = int(seed)  # also one of numpy
    if cameras is not None:
        cameras = checked_cameras(cameras).in_both_modes()
        if len(cameras) < 2:
            raise InvalidArgumentError(
                f"a refinement needs at least 2 cameras, one of them to be held out; found "
                f"{len(cameras)}."
            )

    compute = partial(
        _refine_on,
        small=small,
        full=full,
        limits=limits,
        cameras=cameras,
        config=config,
        thinning=thinning,
        seed=seed,
        frozen=frozen,
        observed=observed,
        listener=listener,
    )
    place, work = chosen_device(device, small.device), f"refining {len(small):,} Gaussians"
    with memory_errors(work, "free some, or use smaller images (size of RefineConfig)"):
        return within_memory(compute, place, work=work, may_leave=device == "auto")


def _refine_on(  # noqa: PLR0913 (options by name)
    place: torch.device,
    note: str,
    *,
    small: GaussianScene,
    full: GaussianScene,
    limits: Limits,
    cameras: Cameras | None,
    config: RefineConfig,
    thinning: int,
    seed: int,
    frozen: int,
    observed: ObservedViews | None,
    listener: ProgressListener,
) -> Refined:
    """Refine on a device, within limits of which earlier attempts used some seconds."""
    limits = deepcopy(limits)
    ours, theirs = _on_device(small, full, place)
    if cameras is not None:
        check_seen(theirs, cameras, name="the full scene", refines=True)
    clock = StageClock(listener, place)
    # The program may have disabled gradients, or be in inference mode or autocast.
    with (
        threads_for_chunks(),
        full_precision(),
        torch.inference_mode(mode=False),
        torch.enable_grad(),
        clock.stage(STAGE, limits.total),
    ):
        views = _views(theirs, cameras, observed, config=config, seed=seed)
        metrics = Metrics(ssim=False, alpha=False, most_psnr=MOST_PSNR)
        scorer = Scorer(
            theirs,
            views.heldout,
            metrics=metrics,
            images=views.heldout_images,
            backgrounds=(BLACK, WHITE),
        )
        images = ImageBuffer(theirs, views, config=config, seed=seed, thinning=thinning)
        scales = learning_rate_scales(ours, theirs)
        scales[:frozen] = 0.0
        valid = valid_rows(ours)
        drawn = ours if bool(valid.all()) else ours.select(valid)  # one NaN would spread in images
        found = optimize(
            drawn,
            images,
            scorer,
            limits=limits,
            config=config,
            learning_rate_scale=scales[valid],
            listener=listener,
        )
        refined = ours if found.scene is drawn else _with_rows(ours, valid, found.scene)
    cost = clock.costs[0]
    if found.stopped == "time" and limits.steps == 0:
        warn(
            f"no step of the refinement fits into {limits.seconds:g} s, so the scene is unchanged; "
            f"views and held-out images took {cost.seconds:.1f} s."
        )
    report = RefineReport(
        steps=limits.steps,
        images=images.rendered,
        heldout=len(scorer),
        psnr_before=found.before,
        psnr_after=found.after,
        gain=found.after - found.before,
        changed_count=changed_count(ours, refined),
        stopped=found.stopped,
        backend=choose_backend("auto", place)[0],
        device=str(place),
        device_note=note,
        cost=cost,
    )
    return Refined(small if refined is ours else refined.to(small.device), report)


def _views(
    full: GaussianScene,
    cameras: Cameras | None,
    observed: ObservedViews | None,
    *,
    config: RefineConfig,
    seed: int,
) -> RefineViews:
    """Return the views to learn from and those that are held out."""
    if observed is not None and len(observed.cameras) > 1:
        return shared_views(observed, full, cameras, config=config, seed=seed)
    if cameras is not None:
        return split_views(cameras, config=config, seed=seed, full=full)
    views = generated_views(full, config=config, seed=seed)
    warn_of_near_plane(full, views.heldout, name="the full scene")
    return views


def join_reports(report: SimplifyReport, refined: Refined) -> SimplifyReport:
    """Add a refinement to the report of the simplification before it."""
    return report.model_copy(
        update={
            "stages": (*report.stages, refined.report.cost),
            "refinement": refined.report,
            "mass_out": float(refined.scene.masses.sum()),
        }
    )


def changed_count(before: GaussianScene, after: GaussianScene) -> int:
    """Count the Gaussians that changed."""
    changed = torch.zeros(len(before), dtype=torch.bool, device=before.device)
    for name, old in before.tensors().items():
        new = after.tensors()[name]
        differs = (new != old) & ~(new.isnan() & old.isnan())
        changed |= differs.reshape(len(old), -1).any(dim=1)
    return int(changed.sum())


def _with_rows(scene: GaussianScene, rows: Bool[Tensor, "n"], part: GaussianScene) -> GaussianScene:
    """Return a scene with other values of some rows."""
    new = part.tensors()
    tensors = {
        name: old.detach().masked_scatter(rows.view(-1, *[1] * (old.ndim - 1)), new[name])
        for name, old in scene.tensors().items()
    }
    return scene.with_tensors(tensors)


def _on_device(
    small: GaussianScene, full: GaussianScene, device: torch.device
) -> tuple[GaussianScene, GaussianScene]:
    """Move both scenes to one device and dtype, and drop invalid rows of the full one."""
    valid = valid_rows(full)
    for name, scene, rows in (("simplified", small, valid_rows(small)), ("full", full, valid)):
        if not bool(rows.any()):
            raise InvalidSceneError(
                f"a refinement needs valid Gaussians in both scenes; none of the {len(scene):,} of "
                f"the {name} scene is valid."
            )
    whole = full if bool(valid.all()) else full.select(valid)
    tensors = {name: tensor.to(device, small.dtype) for name, tensor in whole.tensors().items()}
    return small.to(device), whole.with_tensors(tensors, {})
