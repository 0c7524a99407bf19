"""EffectPlan: which effects a scene calls for, and the figures that decided."""

import pydantic
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis.measures import (
    UNBOUNDED_DISTANCE,
    band_losses,
    duplicate_share,
    faint_share,
    far_share,
)
from cvtgs.config import SimplifyConfig
from cvtgs.math.frames import RobustFrame
from cvtgs.scene import GaussianScene

BAND_LOSS = 1e-5
"""Bands of the spherical harmonics that together change no colour by more are left out."""

UNBOUNDED_SHARE = 0.05
"""A scene with more than this share of its mass far away is unbounded."""

FULLY_UNBOUNDED_SHARE = 0.1
"""From this share on it is so fully; in between, by degrees: no scene lies on an edge."""

DUPLICATE_SHARE = 0.01
"""With more than this share of duplicates, it pays to search for each place only once."""


class Effect(pydantic.BaseModel):
    """One effect, whether it is computed, and the figure that decided.

    Attributes:
        active: Whether the effect is computed.
        figure: What was measured on the scene.
        meaning: What the figure is, and where the threshold lies.
        forced: Whether the configuration decided, and not the figure.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    active: bool
    figure: float
    meaning: str
    forced: bool = False


class BandsEffect(Effect):
    """View-dependent colour: which bands of the spherical harmonics are computed.

    Attributes:
        degree: The bands up to this degree are; those above come out as zeros.
        bands: The figure of every band that was looked at, from degree 1 on.
    """

    degree: int
    bands: tuple[float, ...]


class GradedEffect(Effect):
    """An effect that sets in by degrees.

    Attributes:
        strength: From 0, which changes nothing, to 1.
    """

    strength: float


class EffectPlan(pydantic.BaseModel):
    """What a scene calls for. The names are those of :class:`cvtgs.config.EffectsConfig`.

    Attributes:
        sh: Colour depends on the direction of view: SH bands above the constant.
        mip: Images of the scene are taken with the compensation of Mip-Splatting.
        unbounded: Part of the mass is far away: far positions are contracted, and huge, smooth
            Gaussians such as those of a sky get fewer cells.
        haze: Faint Gaussians hold mass: they are sorted, and only the faintest left out.
        flat: Gaussians have two scales (2DGS), and none shall get a third.
        duplicates: Gaussians lie exactly on others: the nearest site is searched once for each
            place.
        extras: Columns beyond the standard ones are carried along.
        visibility: Images tell what each Gaussian paints.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    sh: BandsEffect
    mip: Effect
    unbounded: GradedEffect
    haze: Effect
    flat: Effect
    duplicates: Effect
    extras: Effect
    visibility: Effect


def plan_effects(
    scene: GaussianScene,
    masses: Float[Tensor, "n"],
    seen_masses: Float[Tensor, "n"] | None = None,
    *,
    frame: RobustFrame,
    two_scales: bool = False,
    config: SimplifyConfig | None = None,
) -> EffectPlan:
    """Look at a scene once and decide what it calls for.

    Args:
        scene: The Gaussians, with valid rows.
        masses: Opacity times mean projected area of every Gaussian.
        seen_masses: The same as they look in images; None for ``masses``.
        frame: Centre and radius of the scene.
        two_scales: Whether the file that the scene came from has no third scale (2DGS).
        config: Choices that override the decisions, and the thresholds of the filter; None for
            the defaults.

    Returns:
        The plan.

    Example:
        >>> from cvtgs.math.frames import robust_frame
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> plan_effects(scene, scene.opacities, frame=robust_frame(scene.means)).extras.active
        False
    """
    config = config or SimplifyConfig()
    seen = masses if seen_masses is None else seen_masses
    return EffectPlan(
        sh=_bands(scene, config),
        mip=_mip(scene, config),
        unbounded=_unbounded(far_share(scene.means, masses, frame), config),
        haze=_haze(faint_share(scene.opacities, seen, below=config.filter.min_opacity), config),
        flat=_flat(two_scales, config),
        duplicates=_duplicates(duplicate_share(scene.means, scene.sh0), config),
        extras=_extras(scene, config),
        visibility=_visibility(config),
    )


def with_haze(
    plan: EffectPlan,
    opacities: Float[Tensor, "n"],
    seen_masses: Float[Tensor, "n"],
    *,
    config: SimplifyConfig,
) -> EffectPlan:
    """Decide on haze anew, once images have told what each Gaussian paints.

    Args:
        plan: The plan so far.
        opacities: Opacities.
        seen_masses: Masses as they look in images.
        config: The threshold, and what overrides it.

    Returns:
        The plan with another figure for haze.
    """
    share = faint_share(opacities, seen_masses, below=config.filter.min_opacity)
    return plan.model_copy(update={"haze": _haze(share, config)})


def _bands(scene: GaussianScene, config: SimplifyConfig) -> BandsEffect:
    choice = config.effects.sh
    losses = band_losses(scene, enough=BAND_LOSS)
    degree = scene.sh_degree
    if choice == "auto":
        while degree > 0 and sum(losses[degree - 1 :]) <= BAND_LOSS:
            degree -= 1
    else:
        degree = min(degree, choice)
    return BandsEffect(
        active=degree > 0,
        figure=max(losses, default=0.0),
        meaning="largest change of colour by a band, in standard deviations of colour; "
        f"bands on above {BAND_LOSS:g}",
        forced=choice != "auto",
        degree=degree,
        bands=losses,
    )


def _mip(scene: GaussianScene, config: SimplifyConfig) -> Effect:
    return _tagged(
        scene.antialiased,
        config.effects.mip,
        meaning="1 if the comment SplatRenderMode: mip is there",
    )


def _unbounded(share: float, config: SimplifyConfig) -> GradedEffect:
    effect = _shared(
        share,
        config.effects.unbounded,
        least=UNBOUNDED_SHARE,
        meaning=f"share of mass beyond {UNBOUNDED_DISTANCE:g} robust radii",
    )
    above = (share - UNBOUNDED_SHARE) / (FULLY_UNBOUNDED_SHARE - UNBOUNDED_SHARE)
    strength = min(1.0, max(0.0, above)) if effect.active else 0.0
    return GradedEffect(**effect.model_dump(), strength=strength)


def _haze(share: float, config: SimplifyConfig) -> Effect:
    choice, most = config.effects.haze, config.filter.max_mass_share
    return Effect(
        active=share > most if choice == "auto" else choice == "on",
        figure=share,
        meaning=f"share of mass as seen with opacity below {config.filter.min_opacity:g}, "
        f"on above {most:g}",
        forced=choice != "auto",
    )


def _flat(two_scales: bool, config: SimplifyConfig) -> Effect:
    return _tagged(
        two_scales, config.effects.flat, meaning="1 if the file has two scales per Gaussian"
    )


def _duplicates(share: float, config: SimplifyConfig) -> Effect:
    return _shared(
        share,
        config.effects.duplicates,
        least=DUPLICATE_SHARE,
        meaning="share of Gaussians exactly where others of their colour are",
    )


def _tagged(is_there: bool, choice: str, *, meaning: str) -> Effect:
    """Decide on what a file says or does not, which cannot be forced on."""
    return Effect(
        active=is_there and choice != "off",
        figure=float(is_there),
        meaning=f"{meaning}, on at 1",
        forced=choice != "auto",
    )


def _shared(share: float, choice: str, *, least: float, meaning: str) -> Effect:
    """Decide on what needs a share above ``least``, or any share if it is forced on."""
    return Effect(
        active=share > (least if choice == "auto" else 0.0) and choice != "off",
        figure=share,
        meaning=f"{meaning}, on above {least:g}",
        forced=choice != "auto",
    )


def _extras(scene: GaussianScene, config: SimplifyConfig) -> Effect:
    return Effect(
        active=bool(scene.extras),
        figure=len(scene.extras),
        meaning="columns beyond the standard ones, on above 0",
        forced=config.effects.extras != "auto",
    )


def _visibility(config: SimplifyConfig) -> Effect:
    return Effect(
        active=config.uses_renders,
        figure=config.visibility.views,
        meaning="images that the preset asks for, on above 0",
        forced=config.effects.visibility != "auto",
    )
