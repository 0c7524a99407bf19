"""SceneAnalysis, computed once for all stages; selecting and restoring columns of a scene."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis.effects import EffectPlan, drawn_rows, haze_share, plan_effects, plan_haze
from cvtgs.analysis.visibility import ambient_visibility, perspective_falloff
from cvtgs.cameras import Cameras
from cvtgs.config import EffectsConfig, SimplifyConfig, TessellationConfig
from cvtgs.losses import SSIM_WINDOW
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.parameters import divide
from cvtgs.rendering import ObservedViews, contributions, observe
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from cvtgs.views import mixed_views

MIN_OPACITY = 1e-6  # floor of opacities in divisions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneAnalysis:
    """The analysis of the valid Gaussians of a scene.

    Attributes:
        frame: Robust centre and radius of the scene.
        farthest: Largest distance to the centre, in robust radii.
        opacities: ``(n,)`` opacities in (0, 1).
        areas: ``(n,)`` mean projected areas, squared scene units, float64.
        apparent_areas: ``(n,)`` areas as they count in images: smaller for Gaussians far from the
            middle or enclosed by others.
        visibility: ``(n,)`` ambient visibility of every Gaussian, 0 (enclosed) to 1 (free);
            empty if neither weights nor the network use it.
        plan: The effects that the scene calls for.
        observed: Images of the scene and the contributions of these Gaussians to them; None if
            later stages do not use them.
    """

    frame: RobustFrame
    farthest: float
    opacities: Float[Tensor, "n"]
    areas: Float[Tensor, "n"]
    apparent_areas: Float[Tensor, "n"]
    visibility: Float[Tensor, "n_or_0"]
    plan: EffectPlan
    observed: ObservedViews | None = None

    def select(self, rows: Tensor) -> Self:
        """Return the analysis of some Gaussians.

        Args:
            rows: Row numbers.

        Returns:
            Their values; frame, farthest distance and plan remain those of the whole scene.
        """
        observed = self.observed
        if observed is not None:
            observed = replace(observed, contributions=observed.contributions[rows])
        return replace(
            self,
            observed=observed,
            opacities=self.opacities[rows],
            areas=self.areas[rows],
            apparent_areas=self.apparent_areas[rows],
            visibility=self.visibility[rows] if len(self.visibility) else self.visibility,
        )


def analyze(
    scene: GaussianScene, config: SimplifyConfig, *, with_visibility: bool = False
) -> SceneAnalysis:
    """Analyze a scene without rendering it.

    Args:
        scene: The Gaussians; all rows must be valid.
        config: The configuration.
        with_visibility: Whether a network needs the ambient visibility.

    Returns:
        Frame, areas, visibility and effect plan.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> analysis = analyze(make("object", 100, sh_degree=0, seed=0), SimplifyConfig())
        >>> analysis.plan.unbounded.active, len(analysis.areas)
        (False, 100)
    """
    areas, opacities = scene.areas, scene.opacities
    frame = frame_of(scene.means, opacities)
    distances, masses = frame.distances(scene.means), areas * opacities
    visibility = masses[:0]
    if with_visibility or config.cvt.hidden_share < 1.0:
        visibility = ambient_visibility(scene.means, masses, frame)
    apparent = apparent_areas(areas, distances, visibility, config=config.cvt)
    plan = plan_effects(scene, masses, apparent * opacities, distances=distances, config=config)
    return SceneAnalysis(
        frame=frame,
        farthest=float(distances.amax()),
        opacities=opacities,
        areas=areas,
        apparent_areas=apparent,
        visibility=visibility,
        plan=plan,
    )


def frame_of(means: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> RobustFrame:
    """Return the robust frame of the Gaussians that are drawn at all; of all if none is."""
    return robust_frame(means[drawn_rows(opacities)])


def apparent_areas(
    areas: Float[Tensor, "n"],
    distances: Float[Tensor, "n"],
    visibility: Float[Tensor, "n"],
    *,
    config: TessellationConfig,
) -> Float[Tensor, "n"]:
    """Return areas as they count in images: smaller if far from the middle or enclosed."""
    apparent = areas
    if config.perspective:
        apparent = apparent * perspective_falloff(distances)
    if config.hidden_share < 1.0:
        apparent = apparent * (config.hidden_share + (1 - config.hidden_share) * visibility)
    return apparent


def measure_visibility(
    scene: GaussianScene,
    analysis: SceneAnalysis,
    config: SimplifyConfig,
    *,
    cameras: Cameras | None = None,
) -> SceneAnalysis:
    """Correct apparent areas, and the haze effect, by the contributions to images of the scene."""
    used, observed = drop_unused_bands(scene, analysis.plan), None
    views = visibility_cameras(used, config, cameras=cameras)
    if config.match.enabled:
        observed = observe(used, views)
        rendered = observed.contributions
    else:
        rendered = contributions(used, views)
    opacities, apparent = analysis.opacities, analysis.apparent_areas
    if float(rendered.sum()) > 0.0:
        apparent = measured_areas(
            apparent,
            opacities,
            rendered,
            mass_per_pixel=(apparent * opacities).double().sum() / rendered.sum(),
            share=config.visibility.mass_share,
        )
    haze = plan_haze(float(haze_share(opacities, apparent * opacities, config)), config)
    plan = analysis.plan.model_copy(update={"haze": haze})
    return replace(analysis, apparent_areas=apparent, plan=plan, observed=observed)


def visibility_cameras(
    scene: GaussianScene, config: SimplifyConfig, *, cameras: Cameras | None = None
) -> Cameras:
    """Return the cameras of the images that contributions are measured in.

    They have two sizes and every second, third, ... pixel; about a third ignore the tag mip.
    """
    choices = config.visibility
    least = SSIM_WINDOW * choices.stride
    if cameras is None:
        side = max(choices.size, least)
        views = mixed_views(scene, choices.views, size=side, seed=config.seed)
    else:
        side = min(choices.size, max(cameras.width, cameras.height))
        views = cameras.spread(choices.views).fitted(side, least=least)
    views = views.interleaved(choices.stride).in_two_sizes(choices.fine_factor)
    return views.in_both_modes()


def measured_areas(
    areas: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    contributions: Float[Tensor, "n"],
    *,
    mass_per_pixel: Float[Tensor, ""],
    share: float,
) -> Float[Tensor, "n"]:
    """Return apparent areas that are corrected by the contributions to images."""
    shown = (1.0 - share) * contributions * mass_per_pixel
    blended = share * (areas * opacities).double() + shown
    return divide(blended, opacities.double().clamp_min(MIN_OPACITY)).to(areas.dtype)


def select_columns(scene: GaussianScene, choices: EffectsConfig) -> GaussianScene:
    """Drop SH bands and extra columns that the configuration switches off, if there are any."""
    if isinstance(choices.sh, int):
        scene = scene.with_sh_degree(choices.sh)
    if choices.extras == "off" and scene.extras:
        scene = scene.with_tensors({}, {})
    return scene


def drop_unused_bands(scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Drop the SH bands that a scene does not call for, and a tag mip that is switched off.

    Args:
        scene: The scene that the plan was made for.
        plan: The effect plan.

    Returns:
        The scene with a copy of the remaining bands; the same object if nothing changes.

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
    """Remove the anti-aliasing tag of a scene, if it is to be rendered without anti-aliasing."""
    if plan.mip.active or not scene.antialiased:
        return scene
    return replace(scene, comments=ANTIALIASED.removed_from(scene.comments))


def restore_columns(small: GaussianScene, scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Restore the SH degree, the comments and the flatness of the input in a small scene.

    Args:
        small: The small scene, with the bands that were computed.
        scene: The input scene.
        plan: The effect plan of the input scene.

    Returns:
        The small scene with the SH degree and the comments of ``scene``: dropped bands are zeros.
        If the Gaussians of ``scene`` have two scales, third ones are negligible, unless the plan
        makes them thick; then the tag 2dgs is left out.

    Example:
        >>> from cvtgs.analysis import plan_effects
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=3, seed=0)
        >>> plan = plan_effects(scene, scene.masses, distances=torch.ones(10))
        >>> restore_columns(select_columns(scene, EffectsConfig(sh=0)), scene, plan).sh_degree
        3
    """
    changes, comments = {}, scene.comments
    missing = scene.shN.shape[1] - small.shN.shape[1]
    if missing > 0:
        changes["shN"] = torch.nn.functional.pad(small.shN, (0, 0, 0, missing))
    if plan.flat.active:
        flat = small.log_scales.clone()
        flat[:, 2].clamp_(max=FLAT_LOG_SCALE)
        changes["log_scales"] = flat
    else:
        comments = TWO_SCALES.removed_from(comments)
    if changes:
        small = small.with_tensors(changes)
    return small if small.comments == comments else replace(small, comments=comments)
