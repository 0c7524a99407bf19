"""Gradients of the cases of a step, one after the other or in a process per core."""

import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from cvtgs.devices import thread_count
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.mergenet import Net, PublishedMergeNet
from cvtgs.processes import LocalWorkers
from cvtgs.train.cache import prepare_scene
from cvtgs.train.cases import Case, DeviceCopies
from cvtgs.train.config import TrainConfig
from cvtgs.train.losses import local_loss, published_loss, scene_loss
from cvtgs.train.sources import find_sources

CaseWithViews = tuple[Case, tuple[ViewImages, ...]]


class CaseGradient(NamedTuple):
    """Loss of one case of a step, named by scene and ratio, and gradient of every parameter."""

    name: str
    loss: float
    gradients: list[Tensor]

    @property
    def is_finite(self) -> bool:
        """Whether the loss and all gradients are finite."""
        return math.isfinite(self.loss) and all(
            bool(one.isfinite().all()) for one in self.gradients
        )


@contextmanager
def step_gradients(
    cases: Sequence[CaseWithViews], config: TrainConfig, cache: Path, copies: DeviceCopies
) -> Iterator[Callable[[Net, int], list[CaseGradient]]]:
    """Give a function that computes the gradients of all cases of a step.

    On a CPU, as many processes as there are cores share several cases; each reads the prepared
    scenes from the cache. Case, ratio, view and crop depend only on the seed, the step and the
    number of the case, so that the number of processes changes rounding only.
    """
    numbers = range(config.cases_per_step)
    processes = min(config.cases_per_step, thread_count()) if copies.device.type == "cpu" else 1
    if processes == 1:
        yield lambda net, step: [
            _case_gradient(net, cases, config, copies, step, number) for number in numbers
        ]
        return
    text = config.model_dump_json()
    with LocalWorkers(processes, "with --resume and OMP_NUM_THREADS=1") as workers:
        yield lambda net, step: list(workers(partial(_compute, text, cache, net, step), numbers))


def _compute(config_text: str, cache: Path, net: Net, step: int, number: int) -> CaseGradient:
    """Compute the gradients of a case in another process."""
    config, cases = (
        TrainConfig.model_validate_json(config_text),
        _training_cases(config_text, cache),
    )
    copies = DeviceCopies(torch.device("cpu"))
    return _case_gradient(net, cases, config, copies, step, number)


@lru_cache(maxsize=1)
def _training_cases(config_text: str, cache: Path) -> list[CaseWithViews]:
    config = TrainConfig.model_validate_json(config_text)
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
