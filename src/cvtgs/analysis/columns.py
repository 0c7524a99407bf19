"""Which columns of a scene are computed with, and how the others come back."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis.effects import EffectPlan
from cvtgs.config import EffectsConfig
from cvtgs.scene import ANTIALIASED_TAG, FLAT_LOG_SCALE, GaussianScene


def select_columns(scene: GaussianScene, choices: EffectsConfig) -> GaussianScene:
    """Leave out what was switched off, before the scene is looked at.

    Args:
        scene: Any scene.
        choices: What was forced on or off.

    Returns:
        A scene of the same Gaussians, with the SH bands and the columns that are to be used; the
        scene itself if those are all.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=3, seed=0)
        >>> select_columns(scene, EffectsConfig(sh=1)).sh_degree
        1
        >>> select_columns(scene, EffectsConfig()) is scene
        True
    """
    if choices.sh != "auto":
        scene = scene.with_sh_degree(choices.sh)
    if choices.extras == "off" and scene.extras:
        scene = scene.with_tensors({}, {})
    return scene


def drop_unused_bands(scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Leave out the SH bands that a scene does not call for.

    Args:
        scene: The scene that was planned for.
        plan: What it calls for.

    Returns:
        The scene with the other bands, which are copied if there are any, and tagged as
        :func:`drop_mip_tag` does; itself if that changes nothing.

    Example:
        >>> from cvtgs.analysis import plan_effects
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=2, seed=0)
        >>> dull = scene.with_tensors({"shN": torch.zeros_like(scene.shN)}, {})
        >>> plan = plan_effects(dull, dull.masses, distances=torch.ones(10))
        >>> drop_unused_bands(dull, plan).sh_degree
        0
    """
    return drop_mip_tag(scene.with_sh_degree(plan.sh.degree), plan)


def drop_mip_tag(scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Take the tag of antialiasing off a scene, if images of it are to be taken without.

    Args:
        scene: Any scene.
        plan: Whether they are antialiased.

    Returns:
        The scene; itself if there is nothing to take off.

    Example:
        >>> from cvtgs.config import SimplifyConfig
        >>> from cvtgs.analysis import plan_effects
        >>> from cvtgs.synthetic import scene as make
        >>> scene = replace(make("object", 10, sh_degree=0, seed=0), comments=(ANTIALIASED_TAG,))
        >>> config = SimplifyConfig(effects=EffectsConfig(mip="off"))
        >>> plan = plan_effects(scene, scene.masses, distances=torch.ones(10), config=config)
        >>> scene.antialiased, drop_mip_tag(scene, plan).antialiased
        (True, False)
    """
    if plan.mip.active or not scene.antialiased:
        return scene
    tag = ANTIALIASED_TAG.lower()
    return replace(scene, comments=tuple(c for c in scene.comments if tag not in c.lower()))


def restore_columns(small: GaussianScene, scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Make a small scene of the same kind as the one that it was made from.

    Args:
        small: The small scene, with the bands that were computed.
        scene: The scene that came in.
        plan: What it called for.

    Returns:
        The small scene with the SH degree and the comments of ``scene``: zeros where bands were
        left out, and no third scale if its Gaussians have two.

    Example:
        >>> from cvtgs.analysis import plan_effects
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=3, seed=0)
        >>> plan = plan_effects(scene, scene.masses, distances=torch.ones(10))
        >>> restore_columns(select_columns(scene, EffectsConfig(sh=0)), scene, plan).sh_degree
        3
    """
    changes = {}
    missing = scene.shN.shape[1] - small.shN.shape[1]
    if missing > 0:
        changes["shN"] = torch.nn.functional.pad(small.shN, (0, 0, 0, missing))
    if plan.flat.active:
        changes["log_scales"] = _flattened(small.log_scales)
    if changes:
        small = small.with_tensors(changes, small.extras)
    return small if small.comments == scene.comments else replace(small, comments=scene.comments)


def _flattened(log_scales: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    flat = log_scales.clone()
    flat[:, 2].clamp_(max=FLAT_LOG_SCALE)
    return flat
