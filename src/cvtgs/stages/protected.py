"""Protected Gaussians stay as they are; the stages run on the rest."""

from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from cvtgs import filters
from cvtgs.errors import InvalidArgumentError
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages.prepared import PreparedScene
from cvtgs.stages.run import run_stages


def run_protected(
    prepared: PreparedScene,
    target: int,
    *,
    keep: Bool[Tensor, "n"],
    clock: StageClock,
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages on the Gaussians that are not protected.

    What hides and crowds them is judged by the whole scene.
    """
    scene = prepared.scene
    check_mask(keep, scene)
    valid, keep = prepared.valid(clock), keep.to(scene.device)
    kept = keep if valid is scene else keep[filters.valid_rows(scene)]
    check_room(int(kept.sum()), target=target, total=len(valid))
    if target >= len(valid) or not bool(kept.any()):
        small, facts = prepared.run(target, clock=clock)
        order = torch.sort((~kept).to(torch.uint8), stable=True).indices
        whole = target >= len(valid)
        small = filters.with_finite_opacities(valid).select(order) if whole else small
        return small, facts
    outlook = prepared.outlook(clock)
    rest, protected = (~kept).nonzero()[:, 0], filters.with_finite_opacities(valid.select(kept))
    small, facts = run_stages(
        valid.select(rest),
        target - len(protected),
        prepared.config,
        net=prepared.net,
        clock=clock,
        outlook=outlook.select(rest),
    )
    joined = join_scenes(protected, small)
    facts |= outlook.facts(valid) | prepared.facts(target) | {"kept_count": len(protected)}
    return joined, facts | {"mass_out": float(joined.masses.sum())}


def check_mask(keep: Tensor, scene: GaussianScene) -> None:
    """Refuse what is not a mask of the Gaussians of a scene."""
    if not isinstance(keep, Tensor) or keep.dtype != torch.bool or keep.shape != (len(scene),):
        shape = f"{keep.dtype} {tuple(keep.shape)}" if isinstance(keep, Tensor) else repr(keep)
        raise InvalidArgumentError(
            f"keep must be a boolean tensor of shape ({len(scene)},), found {shape[:80]}."
        )


def check_room(kept: int, *, target: int, total: int) -> None:
    """Check that protected Gaussians leave something of the target for the rest."""
    needed = kept + (1 if kept < total else 0)
    if kept and min(target, total) < needed:
        raise InvalidArgumentError(
            f"{kept} Gaussians are to be kept as they are, so at least {needed} of the {total} "
            f"must be left (rho {needed / total:.4g} or more); asked for {target}."
        )


def join_scenes(first: GaussianScene, second: GaussianScene) -> GaussianScene:
    """Put the Gaussians of two scenes of one kind behind one another."""
    others = second.tensors()
    return first.with_tensors(
        {name: torch.cat([values, others[name]]) for name, values in first.tensors().items()},
        {name: torch.cat([v, second.extras[name]]) for name, v in first.extras.items()},
    )
