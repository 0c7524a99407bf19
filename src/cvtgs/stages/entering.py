"""Which Gaussians enter the tessellation: valid ones, that are not left out."""

import warnings
from typing import Any

import torch
from torch import Tensor

from cvtgs import cvt, filters
from cvtgs.config import SimplifyConfig
from cvtgs.effects import with_haze
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.math.parameters import divide
from cvtgs.scene import GaussianScene
from cvtgs.stages.outlook import Outlook


def check_rows(scene: GaussianScene) -> tuple[GaussianScene, dict[str, Any]]:
    """Drop rows with NaN, infinite or zero values where there must be none, and warn."""
    if len(scene) == 0:
        raise InvalidSceneError("a scene needs at least one Gaussian to be simplified; found none.")
    invalid = filters.invalid_rows(scene)
    if not invalid:
        return scene, {}
    dropped = torch.stack(list(invalid.values())).any(dim=0)
    count = int(dropped.sum())
    reasons = {name: int(mask.sum()) for name, mask in invalid.items()}
    text = ", ".join(f"{name} {number}" for name, number in reasons.items())
    left = len(scene) - count
    if left == 0:
        raise InvalidSceneError(
            f"none of the {len(scene)} Gaussians is valid; "
            f"found NaN, infinite or zero values in {text}."
        )
    warnings.warn(
        f"dropped {count} of {len(scene)} Gaussians with NaN, infinite or zero values ({text}).",
        DroppedDataWarning,
        stacklevel=2,
    )
    return scene.select(~dropped), {"invalid_rows": reasons, "invalid_count": count}


def entering_rows(
    scene: GaussianScene, outlook: Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, dict[str, Any]]:
    """Leave out faint Gaussians and flyaways, but never more than can be spared."""
    opacities = scene.opacities
    plan = outlook.plan
    if plan.visibility.active:
        seen = outlook.seen_areas * opacities
        outlook = outlook._replace(plan=with_haze(plan, opacities, seen, config=config))
    keep = _without_faint(opacities, outlook, target, config)
    keep = _without_flyaways(scene, keep, outlook, target, config)
    facts = left_out_facts(scene, outlook, ~keep) | {"plan": outlook.plan}
    return keep.nonzero()[:, 0], facts


def _without_faint(
    opacities: Tensor, outlook: Outlook, target: int, config: SimplifyConfig
) -> Tensor:
    """Leave out faint Gaussians: all of them, unless they are the haze of the scene."""
    least, share = config.filter.min_opacity, config.filter.max_mass_share
    if not outlook.plan.haze.active:
        keep, share = opacities >= least, 1.0
        if int(keep.sum()) >= target:
            return keep
    return filters.visible_rows(
        opacities,
        outlook.seen_areas * opacities,
        min_opacity=least,
        max_mass_share=share,
        at_least=target,
    )


def left_out_facts(scene: GaussianScene, outlook: Outlook, left_out: Tensor) -> dict[str, Any]:
    """Return what the report says of Gaussians that are left out."""
    masses = outlook.areas * scene.opacities
    share = divide(masses[left_out].sum(), masses.sum())
    return {"filtered_count": int(left_out.sum()), "filtered_mass_share": float(share)}


def _without_flyaways(
    scene: GaussianScene, keep: Tensor, outlook: Outlook, target: int, config: SimplifyConfig
) -> Tensor:
    share = config.filter.max_flyaway_share
    if share == 0.0:
        return keep
    distances = outlook.frame.distances(scene.means)
    if float(distances.amax()) <= filters.FLYAWAY_RADII:
        return keep
    seen = outlook.areas * scene.opacities * cvt.falloff(scene.means, outlook.frame)
    flown = filters.flyaway_rows(distances, seen, max_share=share)
    fewer = keep & ~flown
    return fewer if int(fewer.sum()) >= target else keep
