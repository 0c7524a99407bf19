"""One look at a scene before anything is done to it."""

from typing import Any, NamedTuple, Self

from jaxtyping import Float
from torch import Tensor

from cvtgs import cvt
from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig, TessellationConfig, VisibilityConfig
from cvtgs.effects import EffectPlan, imaged, plan_effects
from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.rendering import contributions
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.views import mixed_views


class Outlook(NamedTuple):
    """What one look at the scene tells: where it is, and what each Gaussian paints.

    Attributes:
        frame: Centre and radius of the scene.
        areas: ``(n,)`` mean projected areas, squared scene units.
        seen_areas: ``(n,)`` the same as they look in images; smaller for what is far or hidden.
        light: ``(n,)`` how freely every Gaussian can be seen, 0 to 1; empty if nobody asks.
        plan: What the scene calls for.
    """

    frame: RobustFrame
    areas: Tensor
    seen_areas: Tensor
    light: Tensor
    plan: EffectPlan

    def select(self, rows: Tensor) -> Self:
        """Keep what is known of some Gaussians."""
        light = self.light[rows] if len(self.light) else self.light
        return self._replace(areas=self.areas[rows], seen_areas=self.seen_areas[rows], light=light)

    def area_power(self, config: TessellationConfig) -> float:
        """Return the power of the area in the weight: the more unbounded, the flatter."""
        strength = self.plan.unbounded.strength
        return (1 - strength) * config.area_power + strength * config.unbounded_area_power

    def facts(self, scene: GaussianScene) -> dict[str, Any]:
        """Return what the report says about it."""
        return {"plan": self.plan, "mass_in": float((self.areas * scene.opacities).sum())}


def look(
    valid: GaussianScene,
    config: SimplifyConfig,
    *,
    with_light: bool,
    clock: StageClock,
    cameras: Cameras | None,
) -> Outlook:
    """Look at a scene, and at images of it where the configuration asks for them."""
    with clock.stage("plan"):
        outlook = look_at_scene(valid, config, with_light=with_light)
    if not outlook.plan.visibility.active:
        return outlook
    with clock.stage("visibility"):
        return look_at_images(valid, outlook, config.visibility, cameras=cameras, seed=config.seed)


def look_at_scene(scene: GaussianScene, config: SimplifyConfig, *, with_light: bool) -> Outlook:
    """Find out what a scene is like, without an image of it."""
    frame, areas = robust_frame(scene.means), scene.areas
    masses = areas * scene.opacities
    hides = config.cvt.hidden_share < 1.0
    light = (
        cvt.ambient_visibility(scene.means, masses, frame) if hides or with_light else masses[:0]
    )
    seen = as_seen(areas, scene.means, light, frame=frame, config=config.cvt)
    plan = plan_effects(
        scene,
        masses,
        seen * scene.opacities,
        frame=frame,
        two_scales=scene.has_two_scales,
        config=config,
    )
    return Outlook(frame, areas, seen, light, plan)


def as_seen(
    areas: Float[Tensor, "n"],
    means: Float[Tensor, "n 3"],
    light: Float[Tensor, "n"],
    *,
    frame: RobustFrame,
    config: TessellationConfig,
) -> Float[Tensor, "n"]:
    """Return areas as they look in images, smaller for what is far or hidden."""
    seen = areas
    if config.perspective:
        seen = seen * cvt.falloff(means, frame)
    if config.hidden_share < 1.0:
        seen = seen * (config.hidden_share + (1 - config.hidden_share) * light)
    return seen


def look_at_images(
    scene: GaussianScene,
    outlook: Outlook,
    config: VisibilityConfig,
    *,
    cameras: Cameras | None,
    seed: int,
) -> Outlook:
    """Correct what every Gaussian paints by images of the scene."""
    if cameras is None:
        views = mixed_views(scene, config.views, size=config.size, seed=seed)
    else:
        longer = max(cameras.width, cameras.height)
        views = cameras.spread(config.views).fitted(min(config.size, longer))
    painted = contributions(imaged(scene, outlook.plan), views)
    masses = (outlook.seen_areas * scene.opacities).double()
    total, all_painted = masses.sum(), painted.sum()
    if not float(all_painted) > 0.0:
        return outlook
    trust = 1.0 - config.mass_share
    blended = config.mass_share * masses + trust * painted * (total / all_painted)
    seen = parameters.divide(blended, scene.opacities.double().clamp_min(FAINTEST))
    return outlook._replace(seen_areas=seen.to(outlook.seen_areas.dtype))


FAINTEST = 1e-6
"""Opacities below count as this where something is divided by them."""
