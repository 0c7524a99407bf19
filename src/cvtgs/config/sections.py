"""The settings of each stage."""

import math
from typing import Annotated, Literal, Self

import pydantic

from cvtgs.config.base import Section
from cvtgs.errors import ConfigError

Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
Rate = Annotated[float, pydantic.Field(ge=0.0)]
Count = Annotated[int, pydantic.Field(ge=1, le=1_000_000_000)]
CountOrZero = Annotated[int, pydantic.Field(ge=0, le=1_000_000_000)]
UpTo64 = Annotated[int, pydantic.Field(ge=1, le=64)]
Factor = Annotated[float, pydantic.Field(ge=0.0, le=1e9)]  # its square fits into float32
Ridge = Annotated[float, pydantic.Field(ge=1e-9, le=1e9)]  # products of two fit into float32
Choice = Literal["auto", "on", "off"]
Less = Literal["auto", "off"]

LEAST_LENGTHENING = 2.5  # pixels per Gaussian, along a side, from which on steps need fewer
_IN_STEPS = ("steps", "half_after", "check_every", "steps_per_image")  # settings of a refinement


def _degree_of_text(value: object) -> object:
    """Parse a degree given as text; a truth value, which equals 0 or 1 in Python, is none."""
    if isinstance(value, bool):
        return str(value)
    degrees = {"off": 0, "0": 0, "1": 1, "2": 2, "3": 3, "on": 3}
    return degrees.get(value, value) if isinstance(value, str) else value


Degree = Annotated[
    Literal["auto", "on", "off", 0, 1, 2, 3],
    pydantic.BeforeValidator(_degree_of_text),
]


class EffectsConfig(Section):
    """The effects to compute; ``auto`` decides by the scene (:class:`cvtgs.EffectPlan`).

    Attributes:
        sh: Highest degree of view-dependent colour; ``on`` for all bands, ``off`` for degree 0.
            Bands above it are written as zeros.
        mip: Whether a scene with the Mip-Splatting tag is rendered with the compensation of
            Mip-Splatting, and its cells are merged for it. The result keeps the tag in any case.
        unbounded: Whether far positions are contracted, and visible far masses raised, if any.
        haze: Whether faint Gaussians are kept by their mass; ``off`` drops all of them.
        flat: Whether a scene of Gaussians with two scales (2DGS) keeps two scales.
        duplicates: Whether Gaussians at exactly the same position share one search.
        clamping: Whether merged colours make up for members with colours below zero, if there are
            any: images show these as zero, so a plain mean of colours is darker than its members.
        extras: Whether columns beyond the standard ones are carried along.
        visibility: Whether images for contributions and matching are rendered if the preset asks
            for them; refinement has its own.
    """

    sh: Degree = "auto"
    mip: Choice = "auto"
    unbounded: Choice = "auto"
    haze: Choice = "auto"
    flat: Less = "auto"
    duplicates: Choice = "auto"
    clamping: Choice = "auto"
    extras: Less = "auto"
    visibility: Less = "auto"


class FilterConfig(Section):
    """The filter that drops faint Gaussians and flyaways before the tessellation.

    Attributes:
        min_opacity: Gaussians with an opacity below this are faint and may be dropped. The default
            is what 3DGS itself prunes at while it trains.
        max_mass_share: Faint Gaussians are dropped, faintest first, as long as they hold at most
            this share of the apparent mass of the scene; 1 drops all of them.
        max_flyaway_share: Gaussians beyond 100 robust radii are dropped, lightest first, as long
            as they hold at most this share of the mass as seen from the middle of the scene.
    """

    min_opacity: Share = 0.005
    max_mass_share: Share = 0.01
    max_flyaway_share: Share = 1e-3


class TessellationConfig(Section):
    """The tessellation, which groups Gaussians into cells.

    Attributes:
        area_power: The weight of a Gaussian is its opacity times its mean projected area to this
            power: 0 gives the opacity alone, 1 the mass.
        perspective: Whether areas shrink with the distance from the middle of the scene, as they
            do in an image.
        hidden_share: Factor on the area of a fully enclosed Gaussian; 1 ignores enclosure.
        weight_floor: Smallest weight of a Gaussian, as a share of the mean weight.
        color: Length of one unit of colour, in robust radii, at 10,000 cells; 0 groups by position
            alone.
        color_power: This length is proportional to the number of cells to this power. If it is
            negative, colour counts more with fewer cells.
        seeding: Deterministic strata of equal weight, or weighted random draws.
        iterations: Maximum number of Lloyd iterations.
        tolerance: Lloyd stops when an iteration lowers the energy by no more than this share.
        samples_per_site: Gaussians per cell that Lloyd samples; small samples are enlarged, and 0,
            or half of the Gaussians or more, uses all.
    """

    area_power: float = pydantic.Field(default=0.4, ge=0.0, le=2.0)
    perspective: bool = True
    hidden_share: Share = 0.1
    weight_floor: Factor = 1e-3
    color: Factor = 0.05
    color_power: float = pydantic.Field(default=-0.25, ge=-1.0, le=1.0)
    seeding: Literal["stratified", "weighted"] = "stratified"
    iterations: CountOrZero = 2
    tolerance: Factor = 1e-3
    samples_per_site: CountOrZero = 3


class AllocationConfig(Section):
    """The allocation, which merges the cells of a finer tessellation down to the target count.

    Attributes:
        oversampling: The tessellation makes this many times the target number of cells; then pairs
            of cells merge, cheapest first. 1 keeps the cells of the tessellation.
        neighbors: Number of nearest cells that a cell may merge with.
        color: Weight of the squared colour distance relative to the cost of shape and position,
            at one cell per Gaussian; in inverse proportion to the contrast over 0.2. This is the
            root of half the mean squared colour distance of neighbours, limited to 0.06 to 0.28.
        color_power: This weight is proportional to the ratio of cells to Gaussians to this power.
        view_color: Weight of view-dependent colours in it, if neighbours share them; 0 for none.
        mass_power: The cost of a pair is multiplied by its apparent mass to this power, at a
            contrast of 0.2; the power is in proportion to the contrast.
        far_relief: Share by which ``mass_power`` is reduced where all mass lies beyond three robust
            radii, and in proportion where some does: far Gaussians hide one another. Below one cell
            per ten Gaussians, it is in proportion to their ratio.
        widest: Standard deviation of a cell in all directions together, divided by its distance
            from viewers, above which merging costs much more in scenes with far mass, so that
            merged skies do not become fog; 0 sets no limit.
        heaviest: Apparent mass of a pair, in mean cells, around which merging begins to cost more
            in scenes with far mass: for walls and skies of few Gaussians; 0 sets no limit.
        far_gain: Factor on far masses in these costs if less of them is hidden than of near ones.
        reassign: Whether every Gaussian then moves to the cell that explains it best.
    """

    oversampling: float = pydantic.Field(default=8.0, ge=1.0, le=64.0)
    neighbors: int = pydantic.Field(default=6, ge=1, le=64)
    color: Factor = 50.0
    color_power: float = pydantic.Field(default=0.3, ge=0.0, le=1.0)
    view_color: Factor = 2.0
    mass_power: float = pydantic.Field(default=0.5, ge=0.0, le=2.0)
    far_relief: Share = 0.55
    widest: Factor = 0.55
    heaviest: Factor = 20.0
    far_gain: float = pydantic.Field(default=9.0, ge=1.0, le=1e6)
    reassign: bool = True

    @property
    def compares_view_colors(self) -> bool:
        """Whether pairs of cells merge, and their costs depend on view-dependent colours."""
        return self.oversampling > 1.0 and self.view_color > 0.0


class ImageSection(Section):
    """Base of the sections that render images of the scene."""

    size: int = pydantic.Field(default=128, ge=16, le=16_384)
    stride: UpTo64 = 1
    fine_factor: UpTo64 = 1


class VisibilityConfig(ImageSection):
    """The small images of the scene that measure how much each Gaussian contributes.

    Attributes:
        views: Number of images, from :func:`cvtgs.views.mixed_views`. With 0, contributions are
            estimated from size, opacity and position alone.
        size: Longer side of the images, pixels.
        stride: Only every ``stride``-th pixel is rendered, along rows and columns, as sharp as in
            the whole image.
        fine_factor: About every second image is as sharp as one of ``fine_factor`` times the size,
            and has as many pixels, so that results fit screens of both sizes; 1 for none.
        mass_share: Share of the apparent mass that still comes from size, opacity and position,
            so that Gaussians that no image shows also count.
    """

    views: CountOrZero = 0
    mass_share: Share = 0.3


class MatchConfig(Section):
    """Matching merged Gaussians to images of the full scene, without gradient descent.

    The images are those of :class:`VisibilityConfig`; without them nothing is matched.

    Attributes:
        opacity_rounds: Rounds that adjust opacities so that every Gaussian contributes as much as
            the members of its cell do in the full scene; 0 leaves opacities unchanged.
        color_iterations: Conjugate-gradient iterations of the least-squares fit of colours; 0
            leaves colours unchanged.
        color_ridge: Ridge that holds colours where they were, as a share of the weight that the
            images give them.
        band_ridge: Factor on the ridge for SH bands above the constant one.
        error_power: With given cameras, cells are allocated twice: the masses in the costs of
            merging are multiplied by this power of the error that a first result has there; 0
            allocates once.
    """

    opacity_rounds: CountOrZero = 0
    color_iterations: CountOrZero = 0
    color_ridge: Ridge = 0.25
    band_ridge: Ridge = 8.0
    error_power: float = pydantic.Field(default=0.0, ge=0.0, le=2.0)

    @property
    def enabled(self) -> bool:
        """Whether anything is matched."""
        return bool(self.opacity_rounds or self.color_iterations)


class MergeConfig(Section):
    """The merge, which turns a cell into one Gaussian.

    Attributes:
        area_power: The weight of a member is its opacity times its mean projected area to this
            power: 0 gives the opacity alone, 1 the mass.
        opacity: ``saturating`` conserves the optical depth summed over an image, until the cell is
            opaque, and adds more where opaque members lie side by side in scenes tagged mip;
            ``union`` is the opacity of members that lie exactly behind one another,
            ``1 - prod(1 - a)``.
        representatives: Whether a cell whose members hardly touch keeps the member that shows most
            instead of their moments.
        align_axes: Whether axes of equal length turn towards the neighbours
            (:func:`cvtgs.cells.align_axes`).
        inflation: Growth of an opaque cell of many members along every axis, as a share of the
            standard deviation of its moments.
        covered_inflation: Further growth, as such a share, along an axis with other cells at both
            ends.
        network: Whether MergeNet corrects the merged Gaussians.
        image_size: Longer side of the images in which the scene will be seen, pixels, for the
            network: small images widen small Gaussians. The shipped network was trained on images
            of 256 and 600 pixels.
    """

    area_power: float = pydantic.Field(default=1.0, ge=0.0, le=2.0)
    opacity: Literal["saturating", "union"] = "saturating"
    representatives: bool = True
    align_axes: bool = True
    inflation: float = pydantic.Field(default=0.1, ge=0.0, le=2.0)
    covered_inflation: float = pydantic.Field(default=0.4, ge=0.0, le=2.0)
    network: bool = True
    image_size: int = pydantic.Field(default=400, ge=100, le=2000)


class Rates(Section):
    """Initial step size of every parameter if all images agree; 0 leaves it unchanged.

    Attributes:
        means: Positions along the axes of each Gaussian, in standard deviations.
        quats: Rotations about these axes, as half the angle in radians; less where the other two
            axes differ.
        log_scales: Logarithms of the standard deviations.
        logit_opacities: Opacity logits.
        sh0: Constant colours.
        shN: View-dependent colours.
    """

    means: Rate = 0.04
    quats: Rate = 0.016
    log_scales: Rate = 0.02
    logit_opacities: Rate = 0.1
    sh0: Rate = 0.04
    shN: Rate = 0.002  # noqa: N815 (the name that scenes give it)


class RefineConfig(ImageSection):
    """The settings of a refinement; frozen, unknown keys are errors.

    Attributes:
        steps: Maximum number of steps, before ``lengthening``; 0 leaves the limit to ``seconds``.
        images_per_step: Images of one step, whose losses are averaged. On a GPU, a step of four
            takes little more time than one of a single image.
        seconds: Maximum wall-clock seconds; 0 leaves the limit to ``steps``. With both 0, a
            simplification is not refined.
        rates: Initial step sizes.
        half_after: Steps after which the step sizes are halved; after n times as many steps, they
            are 1 / (n + 1) of the initial ones.
        cooling: Share of the steps, or of the time, at the end, over which the step sizes also
            fall linearly to zero.
        mse_weight: Weight of the logarithm of the mean squared error.
        image_weight: Weight of the logarithm of the loss of CVT-GS, ``0.8 L1 + 0.2 (1 - SSIM) +
            0.2 gradient``.
        size: Longer side of the images, pixels; a side below 11 times ``stride`` becomes that.
        stride: Steps and checks use only every ``stride``-th pixel, along rows and columns, as
            sharp as in the whole image: at 2, four times as many steps take the same time.
        fine_factor: About every second image is as sharp as one of ``fine_factor`` times the size,
            and has as many pixels; 1 for none.
        batch: Views that are generated together: a quarter automatic, half random from around the
            scene, a quarter random from near it or within it.
        first_images: Images at the start of which each is newly rendered from the full scene.
        steps_per_image: Later images per new one; the others were rendered before.
        images: Maximum number of images to keep, 8 bytes per pixel each.
        heldout: Number of held-out views, which decide what is kept and are never trained on.
        check_every: Steps between two checks of the held-out views.
        patience: Checks without a new best after which the refinement ends.
        lengthening: Largest factor of the number of steps for few Gaussians, which are large and
            need fewer pixels and more steps. If a square image has r * r pixels for each, and r is
            at least 2.5, a step uses only every second pixel along rows and columns, and
            ``steps``, ``half_after``, ``check_every`` and ``steps_per_image`` are r times as large,
            or this many times if that is less. 1 for never.

    Example:
        >>> RefineConfig(size=128).rates.means
        0.04
    """

    steps: CountOrZero = 0
    images_per_step: Count = 1
    seconds: float = pydantic.Field(default=0.0, ge=0.0)
    rates: Rates = Rates()
    half_after: Count = 100
    cooling: Share = 0.0
    mse_weight: Rate = 0.5
    image_weight: Rate = 0.5
    size: int = pydantic.Field(default=256, ge=16, le=16_384)
    batch: int = pydantic.Field(default=32, ge=4)
    first_images: Count = 1
    steps_per_image: Count = 1
    images: Count = 128
    heldout: Count = 8
    check_every: Count = 25
    patience: Count = 8
    lengthening: float = pydantic.Field(default=1.0, ge=1.0, le=16.0)

    @pydantic.model_validator(mode="after")
    def _check_weights(self) -> Self:
        if self.mse_weight == 0.0 == self.image_weight:
            raise ConfigError("one of refine.mse_weight and refine.image_weight must be above 0.")
        return self

    def thinning(self, count: int) -> int:
        """Return 2 if a step for so many Gaussians uses every second row and column, 1 for all."""
        return 1 if self._times(count) == 1.0 else 2

    def for_count(self, count: int) -> Self:
        """Return the settings with as many steps as a number of Gaussians needs."""
        times = self._times(count)
        return self.model_copy(
            update={name: round(times * getattr(self, name)) for name in _IN_STEPS}
        )

    def _times(self, count: int) -> float:
        """Return the factor of the number of steps."""
        side = self.size / self.stride / math.sqrt(max(1, count))  # pixels per Gaussian
        return min(side, self.lengthening) if side >= LEAST_LENGTHENING else 1.0

    def new_images(self, steps: int, *, shared: int = 0) -> int:
        """Return how many images of the full scene some steps render besides those shared."""
        used = steps * self.images_per_step
        learned = shared - self.heldout_of(shared) if shared else 0
        first = max(0, self.first_images - learned)
        later = max(0, used - first)
        return min(used, first) + later // self.steps_per_image

    def heldout_of(self, count: int) -> int:
        """Return how many of some views are held out: an eighth, from 1 to ``heldout``."""
        return max(1, min(self.heldout, count // 8))

    @property
    def enabled(self) -> bool:
        """Whether there are steps or seconds to refine for."""
        return bool(self.steps or self.seconds)
