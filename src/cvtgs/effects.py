"""EffectPlan: what a scene calls for; what it does not call for is not computed."""

from typing import Literal

import pydantic
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import activations
from cvtgs.math.frames import RobustFrame
from cvtgs.scene import GaussianScene

UNBOUNDED_DISTANCE = 3.0
"""In robust radii: what lies beyond is far away."""

UNBOUNDED_SHARE = 0.05
"""A scene with more than this share of its mass far away is unbounded."""


class Effect(pydantic.BaseModel):
    """One effect, whether it is computed, and the figure that decided.

    Attributes:
        active: Whether the effect is computed.
        figure: What was measured on the scene.
        meaning: What the figure is, and where the threshold lies.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    active: bool
    figure: float
    meaning: str


class EffectPlan(pydantic.BaseModel):
    """What a scene calls for.

    Attributes:
        view_dependence: Colour depends on the direction of view: SH bands above the constant.
        antialiasing: The scene was trained with anti-aliasing, and its tag is kept.
        unbounded: Part of the mass is far away: far positions are contracted, and huge, smooth
            Gaussians such as those of a sky get fewer cells.
        extras: Columns beyond the standard ones are carried along.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    view_dependence: Effect
    antialiasing: Effect
    unbounded: Effect
    extras: Effect


def plan_effects(
    scene: GaussianScene,
    masses: Float[Tensor, "n"],
    frame: RobustFrame,
    *,
    unbounded: Literal["auto", "on", "off"] = "auto",
) -> EffectPlan:
    """Look at a scene once and decide what it calls for.

    Args:
        scene: The Gaussians, with valid rows.
        masses: Opacity times mean projected area of every Gaussian.
        frame: Centre and radius of the scene.
        unbounded: ``on`` and ``off`` override the decision.

    Returns:
        The plan.

    Example:
        >>> from cvtgs.math.frames import robust_frame
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> plan_effects(scene, scene.opacities, robust_frame(scene.means)).extras.active
        False
    """
    share = far_share(scene.means, masses, frame)
    is_unbounded = share > UNBOUNDED_SHARE if unbounded == "auto" else unbounded == "on"
    return EffectPlan(
        view_dependence=Effect(
            active=scene.sh_degree > 0, figure=scene.sh_degree, meaning="SH degree, on above 0"
        ),
        antialiasing=Effect(
            active=scene.antialiased,
            figure=float(scene.antialiased),
            meaning="1 if the comment SplatRenderMode: mip is there, on at 1",
        ),
        unbounded=Effect(
            active=is_unbounded,
            figure=share,
            meaning=f"share of mass beyond {UNBOUNDED_DISTANCE:g} robust radii, "
            f"on above {UNBOUNDED_SHARE:g}",
        ),
        extras=Effect(
            active=bool(scene.extras),
            figure=len(scene.extras),
            meaning="columns beyond the standard ones, on above 0",
        ),
    )


def far_share(means: Float[Tensor, "n 3"], masses: Float[Tensor, "n"], frame: RobustFrame) -> float:
    """Give the share of mass that lies far away.

    Args:
        means: Positions, scene units.
        masses: Masses.
        frame: Centre and radius of the scene.

    Returns:
        A number in [0, 1].

    Example:
        >>> import torch
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)
        >>> far_share(torch.tensor([[0.0, 0, 0], [9, 0, 0]]), torch.tensor([1.0, 3.0]), frame)
        0.75
    """
    far = frame.distances(means) > UNBOUNDED_DISTANCE
    return float(activations.divide((masses * far).sum(), masses.sum()))
