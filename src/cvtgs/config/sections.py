"""The settings of each stage."""

from typing import Annotated, Literal

import pydantic

from cvtgs.config.base import Section

Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
Rate = Annotated[float, pydantic.Field(ge=0.0)]
Count = Annotated[int, pydantic.Field(ge=1)]
Choice = Literal["auto", "on", "off"]
Less = Literal["auto", "off"]


def _degree_of_text(value: object) -> object:
    """Read what files and command lines hold: numbers as text, on for all bands, off for none."""
    names = {"on": 3, "off": 0, **{str(degree): degree for degree in range(4)}}
    return names.get(value, value) if isinstance(value, str) else value


Degree = Annotated[Literal["auto", 0, 1, 2, 3], pydantic.BeforeValidator(_degree_of_text)]


class EffectsConfig(Section):
    """Which effects are computed: ``auto`` leaves it to the scene (:class:`cvtgs.EffectPlan`).

    Attributes:
        sh: Degree up to which colour depends on the direction of view; ``on`` for all, ``off``
            for 0. Bands above come out as zeros.
        mip: Whether images of a scene that is tagged so are taken with the compensation of
            Mip-Splatting, and its cells merged for it. The tag stays in any case.
        unbounded: Whether far positions are pulled in, if there are any.
        haze: Whether faint Gaussians are kept by their mass; off leaves all of them out.
        flat: Whether a scene of Gaussians with two scales (2DGS) stays one.
        duplicates: Whether Gaussians that lie exactly on others, if any do, share one search.
        extras: Whether columns beyond the standard ones are carried along.
        visibility: Whether images are taken where the preset asks for them.
    """

    sh: Degree = "auto"
    mip: Choice = "auto"
    unbounded: Choice = "auto"
    haze: Choice = "auto"
    flat: Less = "auto"
    duplicates: Choice = "auto"
    extras: Less = "auto"
    visibility: Less = "auto"


class FilterConfig(Section):
    """Which Gaussians are left out before the tessellation: faint ones and flyaways.

    Attributes:
        min_opacity: Only Gaussians fainter than this may be left out.
        max_mass_share: They are left out, faintest first, while they hold at most this share of
            the scene's mass; 1 leaves all of them out.
        max_flyaway_share: Gaussians beyond 100 robust radii are left out, the least first, while
            they hold at most this share of the mass as seen from the middle.
    """

    min_opacity: Share = 0.1
    max_mass_share: Share = 0.0
    max_flyaway_share: Share = 1e-3


class TessellationConfig(Section):
    """How Gaussians are grouped into cells.

    Attributes:
        area_power: A Gaussian weighs its opacity times its mean projected area to this power: 0
            is the opacity alone, 1 the mass.
        perspective: Whether areas count as they look from the middle of the scene, smaller when
            far.
        hidden_share: What an enclosed Gaussian counts, as a share of a free one; 1 does not look at
            what is enclosed.
        weight_floor: No Gaussian weighs less than this share of the mean weight.
        color: Length of one unit of colour for 10,000 cells, in robust radii; 0 groups by position
            alone.
        color_power: The length grows with the number of cells to this power; with few cells,
            colour counts more.
        seeding: Deterministic strata of equal weight, or weighted random draws.
        iterations: Lloyd iterations, at most.
        tolerance: Lloyd stops when an iteration lowers the energy by less than this share.
        samples_per_site: Lloyd looks at this many Gaussians per cell at most; 0 looks at all.
    """

    area_power: float = pydantic.Field(default=0.4, ge=0.0, le=2.0)
    perspective: bool = True
    hidden_share: Share = 0.1
    weight_floor: float = pydantic.Field(default=1e-3, ge=0.0)
    color: float = pydantic.Field(default=0.05, ge=0.0)
    color_power: float = pydantic.Field(default=-0.25, ge=-1.0, le=1.0)
    seeding: Literal["stratified", "weighted"] = "stratified"
    iterations: int = pydantic.Field(default=4, ge=0)
    tolerance: float = pydantic.Field(default=1e-3, ge=0.0)
    samples_per_site: int = pydantic.Field(default=12, ge=0)


class AllocationConfig(Section):
    """How the cells of a finer tessellation become as many as are wanted.

    Attributes:
        oversampling: The tessellation makes this many times as many cells; pairs of them merge,
            cheapest first. 1 keeps the cells of the tessellation.
        neighbors: A cell may merge with this many of the nearest others.
        color: Weight of squared distances of colours against distances of shape and position, for
            as many cells as Gaussians.
        color_power: The weight grows with the ratio of cells to Gaussians to this power; in large
            cells colours differ anyway.
        mass_power: The cost of a pair counts with the mass that images show to this power.
        reassign: Whether every Gaussian then moves to the cell that explains it best.
    """

    oversampling: float = pydantic.Field(default=2.0, ge=1.0, le=8.0)
    neighbors: int = pydantic.Field(default=6, ge=1, le=64)
    color: float = pydantic.Field(default=75.0, ge=0.0)
    color_power: float = pydantic.Field(default=0.3, ge=0.0, le=1.0)
    mass_power: float = pydantic.Field(default=0.1, ge=0.0, le=2.0)
    reassign: bool = True


class VisibilityConfig(Section):
    """Whether small images of the scene tell which Gaussians are seen.

    Attributes:
        views: Images, from :func:`cvtgs.views.mixed_views`. 0 takes none: what a Gaussian
            paints is then told by its size, opacity and place alone.
        size: Side of the images, pixels.
        stride: Distance in pixels, along rows and columns, of the pixels that are rendered, as
            sharp as in the whole image.
        mass_share: Share of the weight that still comes from size, opacity and place, for all
            that no image shows.
    """

    views: int = pydantic.Field(default=0, ge=0)
    size: int = pydantic.Field(default=128, ge=16)
    stride: Count = 1
    mass_share: Share = 0.3


class MatchConfig(Section):
    """How merged Gaussians are matched to images of the full scene, without descent.

    The images are those of :class:`VisibilityConfig`; without them nothing is matched.

    Attributes:
        opacity_rounds: Rounds in which opacities change until every Gaussian paints what the
            members of its cell paint in the full scene; 0 leaves opacities as they are.
        color_iterations: Conjugate gradients for the least squares of colours; 0 leaves colours as
            they are.
        color_ridge: What keeps colours where they were, as a share of what weighs on them.
        band_ridge: Bands above the constant one are kept this many times as strongly.
    """

    opacity_rounds: int = pydantic.Field(default=0, ge=0)
    color_iterations: int = pydantic.Field(default=0, ge=0)
    color_ridge: float = pydantic.Field(default=0.25, gt=0.0)
    band_ridge: float = pydantic.Field(default=8.0, gt=0.0)

    @property
    def enabled(self) -> bool:
        """Whether anything is matched."""
        return bool(self.opacity_rounds or self.color_iterations)


class MergeConfig(Section):
    """How a cell becomes one Gaussian.

    Attributes:
        area_power: A member weighs its opacity times its mean projected area to this power: 0 is
            the opacity alone, 1 the mass.
        opacity: ``saturating`` conserves the optical depth summed over an image, until the cell is
            opaque, with more where opaque members lie side by side in scenes tagged mip
            (:func:`cvtgs.cells.merged_depth`); ``union`` is the opacity of members that lie exactly
            behind one another, ``1 - prod(1 - a)``.
        representatives: Whether a cell whose members hardly touch keeps the one that shows most,
            instead of their moments.
        align_axes: Whether axes of equal length turn to where the neighbours are
            (:func:`cvtgs.cells.align_axes`).
        inflation: How much wider than its moments an opaque cell of many members becomes along
            every axis, as a share of its standard deviation.
        covered_inflation: The share by which it becomes wider still along an axis at both ends of
            which other cells paint.
        network: Whether MergeNet corrects the merged Gaussians.
    """

    area_power: float = pydantic.Field(default=1.0, ge=0.0, le=2.0)
    opacity: Literal["saturating", "union"] = "saturating"
    representatives: bool = True
    align_axes: bool = True
    inflation: float = pydantic.Field(default=0.1, ge=0.0, le=2.0)
    covered_inflation: float = pydantic.Field(default=0.4, ge=0.0, le=2.0)
    network: bool = True


class Rates(Section):
    """The first steps of every parameter where all images agree; 0 leaves it as it is.

    Attributes:
        means: Positions along the axes of each Gaussian, in their standard deviations.
        quats: Rotations about these axes, half radians; less where the other two axes differ.
        log_scales: Logarithms of the standard deviations.
        logit_opacities: Opacity logits.
        sh0: Constant colours.
        shN: Colours that depend on the direction.
    """

    means: Rate = 0.04
    quats: Rate = 0.016
    log_scales: Rate = 0.02
    logit_opacities: Rate = 0.1
    sh0: Rate = 0.04
    shN: Rate = 0.002  # noqa: N815 (the name that scenes give it)


class RefineConfig(Section):
    """Every choice of a refinement; frozen, unknown keys are errors.

    Attributes:
        steps: Steps, at most; 0 leaves it to ``seconds``.
        seconds: Wall-clock seconds, at most; 0 leaves it to ``steps``. With both 0, a
            simplification is not refined.
        rates: Steps at the start.
        half_after: Steps after which they are half as long; after n times as many, 1 / (n + 1).
        cooling: Share of the steps, or of the time, at the end, in which their length falls to
            nothing on top of that.
        mse_weight: Weight of the logarithm of the mean squared error.
        image_weight: Weight of the logarithm of the loss of CVT-GS, ``0.8 L1 + 0.2 (1 - SSIM) +
            0.2 gradient``.
        size: Longer side of the images, pixels; a side below 11 times ``stride`` becomes that.
        stride: Distance in pixels, along rows and columns, of the pixels that a step and a check
            look at, as sharp as in the whole image: at 2, four times as many steps take the same
            time.
        batch: Views that are found together: a quarter automatic ones, half from anywhere around,
            a quarter from anywhere near, within the scene too.
        first_images: Steps at the start that have a new image of the full scene each.
        steps_per_image: Later steps for every new image; the others take one that was rendered
            before.
        images: Images that are kept at most, 8 bytes per pixel each.
        heldout: Views that decide what is kept, and are never learnt from.
        check_every: Steps between two checks of them.
        patience: Checks without a new best after which the refinement ends.

    Example:
        >>> RefineConfig(size=128).rates.means
        0.04
    """

    steps: int = pydantic.Field(default=0, ge=0)
    seconds: float = pydantic.Field(default=0.0, ge=0.0)
    rates: Rates = Rates()
    half_after: Count = 100
    cooling: Share = 0.0
    mse_weight: Rate = 0.5
    image_weight: Rate = 0.5
    size: int = pydantic.Field(default=256, ge=16)
    stride: Count = 1
    batch: int = pydantic.Field(default=32, ge=4)
    first_images: Count = 1
    steps_per_image: Count = 1
    images: Count = 128
    heldout: Count = 8
    check_every: Count = 25
    patience: Count = 8

    def new_images(self, steps: int, *, given: int = 0) -> int:
        """Return how many images of the full scene so many steps take, where there are enough.

        Args:
            steps: Number of steps.
            given: Images to learn from that are there before.

        Returns:
            Number of images to render.
        """
        first = max(0, self.first_images - given)
        later = max(0, steps - first)
        return min(steps, first) + later // self.steps_per_image

    def heldout_of(self, count: int) -> int:
        """Return how many of so many views are held out: every eighth, one at least.

        Args:
            count: Number of views.

        Returns:
            Number of those that decide what is kept.
        """
        return max(1, min(self.heldout, count // 8))

    @property
    def enabled(self) -> bool:
        """Whether there are steps or seconds to refine for."""
        return bool(self.steps or self.seconds)
