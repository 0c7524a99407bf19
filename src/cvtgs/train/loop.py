"""The resumable training loop: gradients, steps, validations and output files."""

import copy
import errno
import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import cvtgs
from cvtgs.checks import checked
from cvtgs.clock import check_listener
from cvtgs.devices import chosen_device, full_precision, in_float32, on_host, thread_count
from cvtgs.errors import (
    CheckpointError,
    ConfigError,
    InvalidArgumentError,
    InvalidSceneError,
    MissingDependencyError,
    OutputError,
    OutputExistsError,
    TrainingError,
    warn,
    without_warnings,
)
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.io.atomic import check_output, make_folder, write_atomically
from cvtgs.mergenet import (
    Architecture,
    CheckpointInfo,
    Net,
    PublishedArchitecture,
    PublishedMergeNet,
    encode_checkpoint,
    load_checkpoint,
    summarize,
)
from cvtgs.mergenet.checkpoint import build_network
from cvtgs.processes import LocalWorkers, can_start_processes
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import shortened, shown
from cvtgs.train.cases import Case, DeviceCopies
from cvtgs.train.config import TrainConfig
from cvtgs.train.losses import local_loss, published_loss, scene_loss, validation_psnr
from cvtgs.train.scenes import Source, TrainingScene, find_sources, prepare_scene
from cvtgs.train.state import Gain, History, TrainFiles, TrainState, Validation

CaseWithViews = tuple[Case, tuple[ViewImages, ...]]

WARM_UP = 50  # number of steps in which the learning rate rises
LARGEST_GRADIENT = 1.0  # gradients are clipped to this norm


@on_host()
@torch.inference_mode(mode=False)
@torch.enable_grad()
@full_precision()
@checked
def train(
    config: TrainConfig,
    files: TrainFiles,
    *,
    resume: bool = False,
    overwrite: bool = False,
    device: torch.device | str = "auto",
    listener: ProgressListener = silent,
    on_validation: Callable[[History], None] = lambda history: None,
) -> History:
    """Train a MergeNet.

    Each step takes a few scenes, each at one ratio. The choice of scene, ratio and cameras depends
    only on the seed and the step number, so a resumed training gives the same bits as an
    uninterrupted one. The saved network is a running mean over steps, from the validation of
    largest gain or from the last one (``config.keep``).

    Args:
        config: The settings.
        files: Output files; the training replaces its own checkpoint, state and curves.
        resume: Whether to resume from ``files.state`` if it exists. All settings but ``note`` and
            ``patience``, the scenes and the start must be the same; their paths may differ. A
            finished training goes on with ``restart_step`` at its end.
        overwrite: Whether files of another training may be replaced.
        device: Device to train on; ``auto`` takes CUDA if there is any.
        listener: Called for each prepared scene and each step.
        on_validation: Called after each validation.

    Returns:
        All validations.

    Raises:
        ConfigError: There are no scenes to train on or to validate with.
        CheckpointError: The start checkpoint or the state to resume from cannot be used, or the
            checkpoint to continue is missing and the state does not hold its network.
        InvalidSceneError: A scene cannot be used; the message names it.
        TrainingError: The loss is not finite; the message names the scene and the last good file.
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.

    Example:
        >>> import tempfile
        >>> from cvtgs import save, synthetic
        >>> from cvtgs.train import DataConfig, ViewsConfig
        >>> with tempfile.TemporaryDirectory() as name:
        ...     folder = Path(name)
        ...     for seed, file in enumerate(["training.ply", "exam.ply"]):
        ...         save(synthetic.scene("object", 300, sh_degree=0, seed=seed), folder / file)
        ...     data = DataConfig(
        ...         folders=(folder,), validation=("exam",), generated=0, generated_validation=0,
        ...         ratios=(0.1,), validation_ratios=(0.1,),
        ...     )
        ...     views = ViewsConfig(count=2, sizes=(32,), validation_count=2, validation_size=32)
        ...     history = train(
        ...         TrainConfig(steps=2, width=4, cell_width=4, data=data, views=views),
        ...         TrainFiles.beside(folder / "net.safetensors"),
        ...     )
        >>> [validation.step for validation in history.validations]
        [0, 2]
    """
    check_listener(listener)
    if not callable(on_validation):
        raise InvalidArgumentError(
            f"on_validation must be a function of a history, found {shown(on_validation)}."
        )
    has_state = files.state.is_file()
    resumes = resume and has_state
    if has_state and not (resume or overwrite):
        text = (
            f"{files.state}: the output must not exist yet, found the state of a training; pass "
            f"resume=True (--resume) to continue it, or overwrite=True (--overwrite) to replace it."
        )
        raise OutputExistsError(text).about(files.state, errno.EEXIST)
    for path in (files.checkpoint, files.state, files.curves):
        check_output(path, overwrite=overwrite or resumes)
    sources = find_sources(config.data, seed=config.seed)
    device = chosen_device(device)
    origins = {source.origin: None for source in sources}
    state = TrainState(_first_net(config).to(device), config, origins)
    if resumes:
        state.load(files.state)
        _restore_checkpoint(state, files)
    make_folder(files.cache)
    cases, validation_scenes = _prepare_scenes(sources, config, files.cache, listener)
    state.learn_range(summarize(case.descriptors) for case, _ in cases)
    copies = DeviceCopies(device)
    if not state.history.validations:
        _validate(state, validation_scenes, math.nan, files, copies)
        on_validation(state.history)
    losses: list[float] = []
    with step_gradients(cases, config, files.cache, copies) as compute:
        while state.step < config.steps and state.history.since_best() < config.patience:
            losses.append(_step(state, compute, files))
            listener(ProgressEvent(stage="train", done=state.step, total=config.steps))
            if state.step % config.validate_every == 0 or state.step == config.steps:
                loss = sum(losses) / len(losses)
                _validate(state, validation_scenes, loss, files, copies)
                on_validation(state.history)
                losses = []
    return state.history


def _first_net(config: TrainConfig) -> Net:
    shape: Architecture | PublishedArchitecture = Architecture(
        width=config.width, cell_width=config.cell_width, largest_growth=config.largest_growth
    )
    if config.kind == "published":
        shape = PublishedArchitecture(width=config.width, cell_width=config.cell_width)
    if config.start is not None:
        net = copy.deepcopy(load_checkpoint(config.start).net).requires_grad_(True).train()
        if net.architecture != shape:
            names = ("kind", "width", "cell_width", "largest_growth")
            theirs, ours = (
                ", ".join(f"{name} {getattr(one, name)}" for name in names if hasattr(one, name))
                for one in (net.architecture, shape)
            )
            raise ConfigError(f"start: {config.start} has {theirs}; the configuration has {ours}.")
        return net
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return build_network(shape)


def _prepare_scenes(
    sources: Sequence[Source], config: TrainConfig, cache: Path, listener: ProgressListener
) -> tuple[list[CaseWithViews], list[TrainingScene]]:
    cases, validation_scenes = [], []
    for number, source in enumerate(sources):
        listener(ProgressEvent(stage="prepare", done=number, total=len(sources)))
        try:
            scene = prepare_scene(source, config, cache)
        except InvalidSceneError as error:
            raise InvalidSceneError(f"scene {source.name}: {error}") from error
        if source.is_validation:
            validation_scenes.append(scene)
        else:
            cases += [(case, scene.views) for case in scene.cases]
    validation_scenes = [scene for scene in validation_scenes if scene.cases]
    for found, text in ((cases, "training"), (validation_scenes, "validation")):
        if not found:
            raise ConfigError(
                f"data: the {text} scenes are too small for their ratios: "
                f"no cell has more than one member."
            )
    listener(ProgressEvent(stage="prepare", done=len(sources), total=len(sources)))
    return cases, validation_scenes


class CaseGradient(NamedTuple):
    """Loss of one case of a step, named by scene and ratio, and gradient of every parameter."""

    name: str
    loss: float
    gradients: list[Tensor]


@contextmanager
def step_gradients(
    cases: Sequence[CaseWithViews], config: TrainConfig, cache: Path, copies: DeviceCopies
) -> Iterator[Callable[[Net, int], list[CaseGradient]]]:
    """Give a function for the gradients of all cases of a step, shared by processes on a CPU.

    Draws depend only on seed, step and number of the case: processes change rounding only.
    """
    numbers = range(config.cases_per_step)
    has_processes = copies.device.type == "cpu" and can_start_processes()
    processes = min(config.cases_per_step, thread_count()) if has_processes else 1
    if processes == 1:
        yield lambda net, step: [
            _case_gradient(net, cases, config, copies, step, number) for number in numbers
        ]
        return
    with LocalWorkers(processes, "with --resume and OMP_NUM_THREADS=1") as workers:
        yield lambda net, step: list(workers(partial(_compute, config, cache, net, step), numbers))


def _compute(config: TrainConfig, cache: Path, net: Net, step: int, number: int) -> CaseGradient:
    """Compute the gradients of a case in another process."""
    cases, copies = _training_cases(config, cache), DeviceCopies(torch.device("cpu"))
    return _case_gradient(net, cases, config, copies, step, number)


@lru_cache(maxsize=1)
def _training_cases(config: TrainConfig, cache: Path) -> list[CaseWithViews]:
    with without_warnings(UserWarning):  # the process that started this one has warned
        sources = find_sources(config.data, seed=config.seed)
    scenes = [prepare_scene(one, config, cache) for one in sources if not one.is_validation]
    return [(case, scene.views) for scene in scenes for case in scene.cases]


def _case_gradient(
    net: Net,
    cases: Sequence[CaseWithViews],
    config: TrainConfig,
    copies: DeviceCopies,
    step: int,
    number: int,
) -> CaseGradient:
    rng = random.Random(f"{config.seed}/{step}/{number}" if number else f"{config.seed}/{step}")
    case, views = rng.choice(cases)
    case = copies.get(case)
    if isinstance(net, PublishedMergeNet):
        loss = published_loss(net, case, config=config, rng=rng)
    else:
        some_views = rng.choice(views)
        if config.kind == "local":
            loss = local_loss(net, case, config=config, rng=rng)
        else:
            loss = scene_loss(net, case, copies.get(some_views), config=config, rng=rng)
    gradients = torch.autograd.grad(loss, list(net.parameters()), materialize_grads=True)
    return CaseGradient(case.name, float(loss.detach()), list(gradients))


def _step(
    state: TrainState, compute: Callable[[Net, int], list[CaseGradient]], files: TrainFiles
) -> float:
    results = compute(state.net, state.step)
    for group in state.optimizer.param_groups:
        group["lr"] = _learning_rate(state.config, state.step)
    for parameter, *parts in zip(
        state.net.parameters(), *(result.gradients for result in results), strict=True
    ):
        parameter.grad = torch.stack(parts).mean(dim=0)
    for result in results:
        finite = all(bool(gradient.isfinite().all()) for gradient in result.gradients)
        if not (finite and math.isfinite(result.loss)):
            good = files.checkpoint if files.checkpoint.is_file() else "none yet"
            raise TrainingError(
                f"the loss or its gradient is not finite at step {state.step}, {result.name}; "
                f"last good checkpoint: {good}."
            )
    torch.nn.utils.clip_grad_norm_(state.net.parameters(), LARGEST_GRADIENT)
    with in_float32():  # Adam counts its steps in the default dtype
        state.optimizer.step()
    state.average()
    state.step += 1
    return sum(result.loss for result in results) / len(results)


def _learning_rate(config: TrainConfig, step: int) -> float:
    largest, first, end = config.learning_rate, 0, config.steps
    if step >= config.restart_step > 0:
        largest, first = config.restart_rate, config.restart_step
    elif config.restart_step > 0:
        end = config.restart_step
    warm = min(1.0, (step - first + 1) / WARM_UP)
    return largest * warm * 0.5 * (1 + math.cos(math.pi * (step - first) / (end - first)))


def _validate(
    state: TrainState,
    validation_scenes: Sequence[TrainingScene],
    loss: float,
    files: TrainFiles,
    copies: DeviceCopies,
) -> None:
    gains = []
    for scene in validation_scenes:
        views = copies.get(scene.views[0])
        for case in scene.cases:
            before, after = validation_psnr(state.mean_net, copies.get(case), views)
            gains.append(Gain(scene=scene.name, ratio=case.ratio, decibels=after - before))
    history = state.history
    history.validations.append(Validation(step=state.step, loss=loss, gains=tuple(gains)))
    if state.config.keep == "last" or history.since_best() == 0:
        _write_checkpoint(state, files)
    state.save(files.state)
    _draw_curves(history, files)


def _draw_curves(history: History, files: TrainFiles) -> None:
    """Write the image of the curves if that is possible: no training is lost for it."""
    try:
        curves = history.curves()
    except Exception as error:  # of matplotlib: a backend that is not there, for example
        with suppress(OSError):  # it would show fewer steps, or another training
            files.curves.unlink()
        if not isinstance(error, MissingDependencyError):
            warn(f"the curves are not drawn: {shortened(str(error), 200)}")
        return
    try:
        write_atomically(files.curves, curves, overwrite=True)
    except OutputError as error:
        warn(f"the curves are not saved: {error}")


def _restore_checkpoint(state: TrainState, files: TrainFiles) -> None:
    """Write a missing checkpoint or image again; raise if the state is of another network."""
    config = state.config
    if state.history.validations and not files.curves.is_file():
        _draw_curves(state.history, files)
    if files.checkpoint.is_file():
        info, best = load_checkpoint(files.checkpoint).info, state.history.best()
        own = state.step if best is None or config.keep == "last" else best.step
        # It is written before the state, so it may be of a later validation.
        is_own = info.steps == own or info.steps > state.step
        if (info.scenes, info.seed, is_own) != (state.scenes, config.seed, True):
            raise CheckpointError(
                f"{files.checkpoint}: the network is of another training run than {files.state}: "
                f"on other scenes, with another seed or of another step; restore or remove the "
                f"file, or train to another output."
            )
        return
    if config.keep == "best" and state.history.since_best() > 0:
        raise CheckpointError(
            f"{files.checkpoint}: the network of the best validation is missing, and {files.state} "
            f"holds only a later one; restore the file, or train to another output."
        )
    _write_checkpoint(state, files)


def _write_checkpoint(state: TrainState, files: TrainFiles) -> None:
    config = state.config
    # Without paths, and without the note, which has its own field.
    settings = config.model_dump_json(exclude={"start": True, "note": True, "data": {"folders"}})
    info = CheckpointInfo(
        architecture=state.net.architecture,
        preset=config.preset,
        training=config.note or f"{config.kind} training",
        seed=config.seed,
        steps=state.step,
        version=cvtgs.__version__,
        config=settings,
        start=state.start,
        scenes=state.scenes,
    )
    write_atomically(files.checkpoint, encode_checkpoint(state.mean_net, info), overwrite=True)
