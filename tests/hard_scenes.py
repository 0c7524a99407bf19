"""An easy scene, functions that make it hard, and the simplifiers of the hard tests."""

import math
from collections.abc import Callable
from functools import cache

import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene, Simplifier

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["32", "64"])
PRESETS = ("standard", "paper")
DEVICES = ("cpu", *["cuda"] * torch.cuda.is_available())
devices = pytest.mark.parametrize("device", DEVICES)
presets = pytest.mark.parametrize("preset", PRESETS)


@cache
def simplifier(preset: str, device: str = "cpu") -> Simplifier:
    """Return a simplifier that loads its network once for all tests.

    ``paper`` is used without its network, which has no bounds, as published: it also corrects
    clipped colours, and axes that rounding decides. ``test_merge`` tests it in all cases.
    """
    return Simplifier(None if preset == "paper" else "auto", config=preset, device=device)


@cache
def with_network(preset: str) -> Simplifier:
    """Return a simplifier with the network of its preset."""
    return Simplifier(config=preset, device="cpu")


def valid_case(make: Callable[..., GaussianScene], count: int, dtype: torch.dtype) -> GaussianScene:
    """Return the rows of a case that a renderer can draw."""
    scene = make(count, dtype)
    return scene.select(valid_rows(scene))


def ball(count: int, dtype: torch.dtype, *, seed: int = 0) -> GaussianScene:
    """Return an easy scene: a ball of flat, mostly opaque Gaussians, smooth colours, degree 1."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    out = torch.nn.functional.normalize(normal(count, 3), dim=1)
    pole = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turn = torch.cat([1 + out @ pole[:, None], torch.linalg.cross(pole.expand_as(out), out)], dim=1)
    size = math.log(math.sqrt(4 / count))
    tensors = {
        "means": out * (1 + 0.05 * normal(count, 1)),
        "quats": turn,
        "log_scales": torch.tensor([size, size, size - 1.5]) + 0.3 * normal(count, 3),
        "logit_opacities": 1.5 + 1.5 * normal(count),
        "sh0": 1.5 * torch.sin(3 * out + torch.tensor([0.0, 1.0, 2.0]))[:, None],
        "shN": 0.1 * normal(count, 3, 3),
    }
    return GaussianScene(**{name: values.to(dtype) for name, values in tensors.items()})


def changed(scene: GaussianScene, **tensors: Tensor) -> GaussianScene:
    """Return the scene with some of its tensors replaced, in its own dtype."""
    cast = {name: values.to(scene.dtype) for name, values in tensors.items()}
    return scene.with_tensors(cast, scene.extras)


def every(step: int, count: int, values: tuple[float, float]) -> Tensor:
    """Return the first value in every ``step``-th row, the second in all others."""
    return torch.where(torch.arange(count) % step == 0, *values).double()


def flown(count: int, dtype: torch.dtype, far: float) -> GaussianScene:
    """Return a ball with at most five Gaussians far away, each in another direction."""
    scene = ball(count, dtype)
    away = torch.zeros(count, 3, dtype=torch.float64)
    ways = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1], [1, 1, 1]])
    some = min(5, count // 4)
    away[:some] = far * ways[:some].double()
    return changed(scene, means=scene.means + away)


def spoiled(count: int, dtype: torch.dtype, name: str) -> GaussianScene:
    """Return a ball with NaN in one property of the second row and of every ninth row."""
    scene = ball(count, dtype)
    values = getattr(scene, name).clone()
    values.view(count, -1)[1:2, 0], values.view(count, -1)[4::9, -1] = math.nan, math.nan
    return changed(scene, **{name: values})


def measured_in(scene: GaussianScene, exponent: float) -> GaussianScene:
    """Return the scene with all lengths multiplied by ``e^exponent``."""
    means, log_scales = scene.means.double() * math.exp(exponent), scene.log_scales + exponent
    return changed(scene, means=means, log_scales=log_scales)


def valid_rows(scene: GaussianScene) -> Tensor:
    """Return a mask of drawable rows: finite, with a rotation and a scale that float32 holds."""
    rows = torch.cat([scene.means, scene.quats, scene.log_scales, scene.sh.flatten(1)], dim=1)
    return (
        rows.isfinite().all(dim=1)
        & (scene.log_scales < 88.72).all(dim=1)
        & scene.quats.any(dim=1)
        & ~scene.logit_opacities.isnan()
    )
