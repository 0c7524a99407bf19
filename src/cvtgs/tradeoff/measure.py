"""Measure cost and quality of every preset on one scene."""

import os
import platform
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.devices import chosen_device, device_name
from cvtgs.errors import RunError, warn
from cvtgs.evaluation import Comparison, EvaluationSettings, compare
from cvtgs.evaluation.scorer import mean_of
from cvtgs.io import load, scene_size
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.scene import GaussianScene
from cvtgs.tradeoff.results import Failure, Tradeoff, TradeoffResult, with_fronts
from cvtgs.tradeoff.runs import Run, pass_warnings_on, run_task, start_seconds, tasks_of
from cvtgs.views import automatic_views, find_own_cameras

STAGE = "simplify"
RATIOS = (0.1, 0.01, 0.001)

CameraChoice = Callable[[GaussianScene], Cameras]  # function that returns the views of a scene

PhotographChoice = Callable[[Cameras], Float[Tensor, "c h w 3"]]
"""Function that returns the photograph of every camera, at the size of the cameras."""


class Measured(NamedTuple):
    """The measurements, and images of the scenes.

    Attributes:
        tradeoff: Costs and scores.
        comparison: Images of the full scene and of all results.
    """

    tradeoff: Tradeoff
    comparison: Comparison


def measure_tradeoff(  # noqa: PLR0913 (options by name)
    source: str | os.PathLike[str],
    *,
    presets: Sequence[str] | None = None,
    ratios: Sequence[float] = RATIOS,
    cameras: CameraChoice = automatic_views,
    photographs: PhotographChoice | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    device: str = "auto",
    folder: str | os.PathLike[str] | None = None,
    trust_sizes: bool = False,
    listener: ProgressListener = silent,
) -> Measured:
    """Simplify a file with several presets, and measure cost and quality of each.

    Each run is a separate process, ``cvtgs simplify``, so that seconds and memory are those that
    users see. Then all results are rendered from the same views. A run that fails causes a warning
    and is listed; the others go on.

    Presets that use images are fitted to the cameras beside the source, but not to their test split
    (:meth:`cvtgs.views.OwnCameras.test_cameras`), if there is one. Score by this split, so that no
    preset is scored by what it learned from.

    Memory: that of :func:`cvtgs.evaluation.compare` in this process, plus that of one run at a
    time.

    Args:
        source: The full scene.
        presets: Names of presets; None for all, from the fastest to the best.
        ratios: Ratios of Gaussians to keep, each in (0, 1].
        cameras: Returns the views of the scene.
        photographs: Returns their photographs, to score all scenes against too; None for none.
        settings: Background, LPIPS network and backend.
        device: ``auto``, ``cpu`` or ``cuda``.
        folder: Folder to keep the results in, as ``fast_0.01.ply``; files of the same name are
            replaced. None keeps no results.
        trust_sizes: Whether to believe a compressed source that claims far more Gaussians than its
            bytes can hold.
        listener: Called after each run and image.

    Returns:
        Costs, scores and images.

    Raises:
        CvtgsError: The scene cannot be read, or a preset or ratio is invalid.
        RunError: All runs failed.

    Example:
        >>> from cvtgs.io import save
        >>> from cvtgs.synthetic import scene as make
        >>> def look(scene):
        ...     return automatic_views(scene, 2, width=32, height=24)
        >>> with TemporaryDirectory() as name:
        ...     path = Path(name) / "full.ply"
        ...     save(make("object", 500, sh_degree=0), path)
        ...     found = measure_tradeoff(path, presets=["standard"], ratios=[0.1], cameras=look)
        >>> [(result.name, result.count) for result in found.tradeoff.results]
        [('standard 0.1', 50)]
    """
    tasks = tasks_of(presets, ratios)
    where = chosen_device(device)
    full = load(source, trust_sizes=trust_sizes).to(where)
    views, own = cameras(full), find_own_cameras(full, source)
    held_out = own is not None and own.test_cameras() is not None
    kept = None if folder is None else nullcontext(folder)
    with kept or TemporaryDirectory(prefix="cvtgs-") as name:
        place = Path(name)
        start = start_seconds()
        training = own.source if own is not None and held_out else None
        runs, failures, warned = list[Run](), list[Failure](), set[str]()
        for done, task in enumerate(tasks):
            listener(ProgressEvent(stage=STAGE, done=done, total=len(tasks), note=task.name))
            try:
                run = run_task(
                    source, task, place, training=training, device=device, trust_sizes=trust_sizes
                )
            except RunError as error:
                failures.append(Failure(name=task.name, reason=str(error)))
            else:
                runs.append(run)
                pass_warnings_on(run.cost.errors, warned)
        listener(ProgressEvent(stage=STAGE, done=len(tasks), total=len(tasks)))
        if failures and not runs:
            raise RunError(f"every run failed; {failures[0].name}: {failures[0].reason}")
        for failure in failures:
            warn(f"{failure.name} failed: {failure.reason}")
        sizes = {run.task.name: run.path.stat().st_size for run in runs}
        source_name = Path(source).name
        comparison = compare(
            full,
            {run.task.name: load(run.path).to(where) for run in runs},
            views,
            reference_name=source_name,
            sizes=sizes | {source_name: scene_size(source)},
            photographs=None if photographs is None else photographs(views),
            settings=settings,
            listener=listener,
        )
    results = [
        TradeoffResult(
            name=run.task.name,
            preset=run.task.preset,
            rho=run.task.rho,
            count=scores.count,
            bytes=sizes[run.task.name],
            seconds=run.cost.wall_seconds,
            peak_memory_bytes=run.cost.peak_memory_bytes,
            psnr=scores.psnr.mean,
            ssim=scores.ssim.mean,
            lpips=mean_of(scores.lpips),
            alpha_error=mean_of(scores.alpha_error),
            alpha_bias=mean_of(scores.alpha_bias),
            report=run.report,
        )
        for run, scores in zip(runs, comparison.evaluation.scenes, strict=True)
    ]
    tradeoff = Tradeoff(
        source=source_name,
        source_count=len(full),
        source_bytes=comparison.sizes[source_name],
        start_seconds=start,
        machine=f"{device_name(where)}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, torch {torch.__version__}",
        evaluation=comparison.evaluation,
        results=tuple(with_fronts(results)),
        failures=tuple(failures),
        held_out=held_out,
    )
    return Measured(tradeoff, comparison)
