"""Scenes and settings that the tests of refinement share."""

from typing import Any

import torch

import cvtgs
from cvtgs import GaussianScene
from cvtgs.cameras import Cameras, look_at
from cvtgs.refinement import RefineConfig
from cvtgs.refinement.images import RefineViews


def quick(**changes: Any) -> RefineConfig:
    """Small images, few views."""
    values: dict[str, Any] = {"size": 32, "heldout": 4, "batch": 8, "check_every": 5}
    return RefineConfig(**(values | changes))


def full_scene(count: int = 500, *, degree: int = 1, seed: int = 0) -> GaussianScene:
    return cvtgs.synthetic.scene("object", count, sh_degree=degree, seed=seed)


def small_scene(full: GaussianScene, rho: float = 0.1) -> GaussianScene:
    return cvtgs.Simplifier(None, device="cpu").simplify(full, rho)


def discolored(scene: GaussianScene, shift: float = 0.5) -> GaussianScene:
    """The same scene with colours that are easy to correct."""
    return scene.with_tensors({"sh0": scene.sh0 + shift}, scene.extras)


def as_dtype(scene: GaussianScene, dtype: torch.dtype) -> GaussianScene:
    tensors = {name: tensor.to(dtype) for name, tensor in scene.tensors().items()}
    return scene.with_tensors(tensors, scene.extras)


def ring(count: int = 4, *, width: int = 32, height: int = 24, distance: float = 5.0) -> Cameras:
    """Cameras on one side of the origin, which look at it."""
    turns = torch.linspace(-0.5, 0.5, count)
    eyes = distance * torch.stack([turns.sin(), 0 * turns, -turns.cos()], dim=1)
    viewmats = look_at(eyes, torch.zeros(count, 3), torch.tensor([0.0, -1.0, 0.0]))
    rows = [[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]]
    return Cameras(
        viewmats=viewmats, Ks=torch.tensor(rows).repeat(count, 1, 1), width=width, height=height
    )


def three_views(*, endless: bool = False) -> RefineViews:
    return RefineViews(heldout=(), training=iter(ring(3).singles()), endless=endless)
