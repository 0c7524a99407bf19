"""From where a refinement looks: endless new views, and others that are held out."""

import random
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import torch

from cvtgs.cameras import Cameras
from cvtgs.config import RefineConfig
from cvtgs.errors import InvalidArgumentError
from cvtgs.losses import SSIM_WINDOW
from cvtgs.scene import GaussianScene
from cvtgs.views import mixed_views

HELDOUT_SEED = 101
"""Added to the seed: held-out views are others than those of evaluations, and those learnt from."""

LEARNING_SEED = 211


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook:
    """From where to look.

    Attributes:
        heldout: Cameras of one size that decide.
        learning: Single cameras to learn from.
        endless: Whether there are always more of them.
    """

    heldout: tuple[Cameras, ...]
    learning: Iterator[Cameras]
    endless: bool


def own_outlook(full: GaussianScene, *, config: RefineConfig, seed: int) -> Outlook:
    """Find views of a scene: a quarter automatic ones, the others from anywhere."""

    def batch(number: int, seed: int) -> list[Cameras]:
        return _each(mixed_views(full, number, size=config.size, seed=seed))

    def endless() -> Iterator[Cameras]:
        for number in count():
            views = batch(config.batch, seed + LEARNING_SEED + number)
            random.Random(seed + number).shuffle(views)
            yield from views

    return Outlook(
        heldout=tuple(batch(config.heldout, seed + HELDOUT_SEED)),
        learning=endless(),
        endless=True,
    )


def given_outlook(cameras: Cameras, *, config: RefineConfig, seed: int) -> Outlook:
    """Divide given cameras into some that are held out, spread evenly, and the others."""
    if len(cameras) < 2:
        raise InvalidArgumentError(
            f"a refinement needs at least 2 cameras, one of them to be held out; found "
            f"{len(cameras)}."
        )
    side = min(config.size, max(cameras.width, cameras.height))
    views = _each(cameras.fitted(side, least=SSIM_WINDOW))
    number = max(1, min(config.heldout, len(views) // 8))
    held = {(2 * k + 1) * len(views) // (2 * number) for k in range(number)}
    others = [view for row, view in enumerate(views) if row not in held]
    random.Random(seed).shuffle(others)
    return Outlook(
        heldout=tuple(views[row] for row in sorted(held)), learning=iter(others), endless=False
    )


def _each(cameras: Cameras) -> list[Cameras]:
    return [cameras.select(torch.tensor([row])) for row in range(len(cameras))]
