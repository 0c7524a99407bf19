"""EffectPlan: the effects that a scene calls for, the figures that decide, the columns to use."""

import math
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.checks import checked
from cvtgs.config import EffectsConfig, SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.devices import chunk_length
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import hashed_rows
from cvtgs.math.parameters import MIN_ALPHA, divide, opacity_from_logit
from cvtgs.math.spherical_harmonics import REST_COUNTS, SH_C0, clamped_parts
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene
from cvtgs.tags import ANTIALIASED, TWO_SCALES

BAND_LOSS = 1e-5  # bands of spherical harmonics that together change no colour by more are dropped
UNBOUNDED_SHARE = 0.05  # a scene with more than this share of its mass far away is unbounded
FULLY_UNBOUNDED_SHARE = 0.1  # from this share on, contraction, which sets in gradually, is full
DUPLICATE_SHARE = 0.01  # with more duplicates, it pays to search only once per position
CLAMPED = 2e-3  # if colours below zero take less of full brightness, 0.02 dB can be gained
UNBOUNDED_DISTANCE = 3.0  # distance beyond which Gaussians count as far away, in robust radii
SAMPLE = 1 << 14  # size of samples: of bands, which are examined first, and of colours below zero
HASHED = 1 << 12  # smallest expected size of the sample in which duplicates are counted
CHUNK = 1 << 14
LEAST_CONTRAST = 1e-6  # floor of the contrast, for scenes of a single colour


class Effect(Record):
    """The decision on one effect, and the figure that decided.

    Attributes:
        active: Whether the effect is computed.
        figure: Figure that was measured on the scene.
        meaning: What the figure is, and from where on the effect is on.
        forced: Whether the configuration decided instead of the figure.
    """

    active: bool
    figure: float
    meaning: str
    forced: bool = False


class BandsEffect(Effect):
    """View-dependent colour: the bands of the spherical harmonics to compute.

    Attributes:
        degree: Highest degree that is computed; bands above it are written as zeros.
        bands: Figure of every band of the scene, from degree 1 on.
    """

    degree: int
    bands: tuple[float, ...]


class GradedEffect(Effect):
    """An effect that sets in gradually.

    Attributes:
        strength: Strength, from 0 (no change) to 1.
    """

    strength: float


class EffectPlan(Record):
    """The effects that a scene calls for, named as in :class:`cvtgs.config.EffectsConfig`.

    Attributes:
        sh: View-dependent colour: SH bands above the constant one are computed.
        mip: The scene is rendered with the compensation of Mip-Splatting, and its cells are merged
            for it.
        unbounded: Part of the mass is far: its positions are contracted, and visible masses raised.
        haze: Faint Gaussians hold mass: only the faintest are dropped.
        flat: Gaussians have two scales (2DGS), and none gets a third.
        duplicates: Gaussians share positions: the nearest site is searched once per position.
        clamping: Colours are below zero, where images show black: merged ones make up for it.
        extras: Columns beyond the standard ones are carried along.
        visibility: Images measure the contribution of each Gaussian.
    """

    sh: BandsEffect
    mip: Effect
    unbounded: GradedEffect
    haze: Effect
    flat: Effect
    duplicates: Effect
    clamping: Effect
    extras: Effect
    visibility: Effect


@checked
def plan_effects(
    scene: GaussianScene,
    masses: Float[Tensor, "n"],
    apparent_masses: Float[Tensor, "n"] | None = None,
    *,
    distances: Float[Tensor, "n"],
    config: SimplifyConfig | None = None,
) -> EffectPlan:
    """Decide which effects a scene calls for.

    Args:
        scene: The Gaussians; all rows must be valid.
        masses: Opacity times mean projected area of every Gaussian.
        apparent_masses: The same with apparent areas; None for ``masses``.
        distances: Distances to the centre of the scene, in robust radii.
        config: Overrides of the decisions, and the thresholds of the filter; None for the
            defaults.

    Returns:
        The plan.

    Raises:
        InvalidArgumentError: An argument has another type or shape.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> plan_effects(scene, scene.masses, distances=torch.ones(100)).extras.active
        False
    """
    config = config or SimplifyConfig()
    choices = config.effects
    apparent = masses if apparent_masses is None else apparent_masses
    if masses.shape != scene.logit_opacities.shape:  # and so all others
        raise InvalidArgumentError("masses must be one number for each Gaussian of the scene.")
    opacities = scene.opacities
    shares = [
        far_share(distances, masses * drawn_rows(opacities)),
        haze_share(opacities, apparent, config),
        duplicate_share(scene.means, scene.sh0),
        mean_clamped(scene, masses),
    ]
    far, hazy, duplicates, clamped = torch.stack(shares).tolist()  # one wait for the device
    is_double = "of the Gaussians coincide with others of the same colour"
    is_far = f"of the mass is beyond {UNBOUNDED_DISTANCE:g} robust radii"
    effects = {
        name: _decide(figure, getattr(choices, name), what, least=least)
        for name, figure, what, least in (
            ("mip", scene.antialiased, "the comment SplatRenderMode: mip is present (1)", 0.0),
            ("unbounded", far, is_far, UNBOUNDED_SHARE),
            ("flat", scene.has_two_scales, "the file has two scales per Gaussian (1)", 0.0),
            ("duplicates", duplicates, is_double, DUPLICATE_SHARE),
            ("clamping", clamped, "of full brightness, on average, is below zero", CLAMPED),
            ("extras", len(scene.extras), "there are columns beyond the standard ones", 0.0),
            ("visibility", config.visibility.views, "the preset asks for images", 0.0),
        )
    }
    above = (far - UNBOUNDED_SHARE) / (FULLY_UNBOUNDED_SHARE - UNBOUNDED_SHARE)
    unbounded = effects.pop("unbounded")
    strength = min(1.0, max(0.0, above)) if unbounded.active else 0.0
    return EffectPlan(
        sh=_plan_bands(scene, choices.sh),
        unbounded=GradedEffect(**unbounded.model_dump(), strength=strength),
        haze=plan_haze(hazy, config),
        **effects,
    )


def drawn_rows(opacities: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Return which Gaussians images can show at all; all of them if none can be seen."""
    drawn = opacities >= MIN_ALPHA
    return drawn | ~drawn.any()


def haze_share(
    opacities: Float[Tensor, "n"], apparent_masses: Float[Tensor, "n"], config: SimplifyConfig
) -> Float[Tensor, ""]:
    """Compute the share of the apparent mass that faint Gaussians hold, of those that are drawn."""
    masses = apparent_masses.double() * drawn_rows(opacities)
    return divide((masses * (opacities < config.filter.min_opacity)).sum(), masses.sum())


def plan_haze(share: float, config: SimplifyConfig) -> Effect:
    """Decide whether faint Gaussians are haze, by their share of the apparent mass."""
    choice, most = config.effects.haze, config.filter.max_mass_share
    below = config.filter.min_opacity
    return Effect(
        active=share > (most if choice == "auto" else 0.0) and choice != "off",
        figure=share,
        meaning=f"on if more than {most:g} of the apparent mass has an opacity below {below:g}",
        forced=choice != "auto",
    )


def _plan_bands(scene: GaussianScene, choice: str | int) -> BandsEffect:
    losses = band_losses(scene, enough=BAND_LOSS)
    degree = len(losses)
    if isinstance(choice, int):
        degree = min(degree, choice)
    else:
        while degree > 0 and sum(losses[degree - 1 :]) <= BAND_LOSS:
            degree -= 1
    return BandsEffect(
        active=degree > 0,
        figure=max(losses, default=0.0),
        meaning=f"on if bands change colours by more than {BAND_LOSS:g} standard deviations",
        forced=choice != "auto",
        degree=degree,
        bands=losses,
    )


def _decide(figure: float, choice: str, what: str, *, least: float = 0.0) -> Effect:
    """Decide on an effect: on above ``least``, or above 0 if it is forced on."""
    return Effect(
        active=figure > (least if choice == "auto" else 0.0) and choice != "off",
        figure=figure,
        meaning=f"on if more than {least:g} {what}" if least else f"on if {what}",
        forced=choice != "auto",
    )


def band_losses(scene: GaussianScene, *, enough: float) -> tuple[float, ...]:
    """Return the largest change of a colour by dropping each band of the spherical harmonics.

    It is a bound, in units of the standard deviation of constant colours if that is below 1.
    """
    losses = [0.0] * scene.sh_degree
    if not losses:
        return ()
    step = max(1, len(scene.means) // SAMPLE)
    colors = SH_C0 * scene.sh0[::step, 0].double()
    shares = opacity_from_logit(scene.logit_opacities[::step]).double()
    shares = (shares / shares.sum())[:, None]
    mean = (shares * colors).sum(dim=0)
    contrast = (shares * (colors - mean).square()).sum(dim=0).mean().sqrt()
    spread = [scene.shN[::step]] if step > 1 else []
    for part in (*spread, *scene.shN.split(chunk_length(CHUNK, scene.means.device))):
        figures = [contrast]
        for low, high in pairwise(REST_COUNTS[: len(losses) + 1]):
            sums = part[:, low:high].square().sum(dim=(1, 2))  # sums of whole rows are fast
            figures.append(torch.nn.functional.pad(sums, (0, 1)).amax().double())
        deviation, *squares = torch.stack(figures).tolist()
        unit = min(1.0, max(deviation, LEAST_CONTRAST))
        for band, square in enumerate(squares):  # by the addition theorem (Unsöld 1927)
            change = math.sqrt((2 * band + 3) / (4 * math.pi) * square)
            losses[band] = max(losses[band], change / unit)
        if losses[-1] >= enough:
            break
    return tuple(losses)


def far_share(distances: Float[Tensor, "n"], masses: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the share of the mass that is far away."""
    return divide((masses * (distances > UNBOUNDED_DISTANCE)).sum(), masses.sum()).double()


def duplicate_share(means: Float[Tensor, "n 3"], sh0: Float[Tensor, "n 1 3"]) -> Float[Tensor, ""]:
    """Return the share of Gaussians that repeat exactly the position and colour of another."""
    sample = hashed_rows(means, HASHED)  # by positions, so that duplicates are sampled together
    place, color = means[sample], sh0[sample, 0]
    same = (place[1:] == place[:-1]).all(dim=1) & (color[1:] == color[:-1]).all(dim=1)
    return same.sum().double() / max(1, len(sample))


def mean_clamped(scene: GaussianScene, masses: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return how far colours are below zero, as a mean over a sample, by mass, and directions."""
    sample = hashed_rows(scene.means, SAMPLE)  # large, as a few Gaussians may hold most of the mass
    clamped = SH_C0 * clamped_parts(scene.sh0[sample], scene.shN[sample])[:, 0].mean(dim=1)
    weights = masses[sample].double()
    return divide((weights * clamped).sum(), weights.sum())


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
        flat = small.log_scales.clone()
        flat[:, 2].clamp_(max=FLAT_LOG_SCALE)
        changes["log_scales"] = flat
    if changes:
        small = small.with_tensors(changes)
    return restore_comments(small, scene, plan)


def restore_comments(small: GaussianScene, scene: GaussianScene, plan: EffectPlan) -> GaussianScene:
    """Restore the comments of the input, without the tag 2dgs if the plan makes flat ones thick."""
    comments = scene.comments if plan.flat.active else TWO_SCALES.removed_from(scene.comments)
    return small if small.comments == comments else replace(small, comments=comments)
