"""RefineConfig: every choice of a refinement."""

from typing import Annotated

import pydantic

from cvtgs.config.base import Section

Rate = Annotated[float, pydantic.Field(ge=0.0)]
Count = Annotated[int, pydantic.Field(ge=1)]


class Rates(Section):
    """The first steps of every parameter where all images agree; 0 leaves it as it is.

    Attributes:
        means: Positions, in mean standard deviations of each Gaussian.
        quats: Unit quaternions.
        log_scales: Logarithms of the standard deviations.
        logit_opacities: Opacity logits.
        sh0: Constant colours.
        shN: Colours that depend on the direction.
    """

    means: Rate = 0.02
    quats: Rate = 0.008
    log_scales: Rate = 0.01
    logit_opacities: Rate = 0.1
    sh0: Rate = 0.04
    shN: Rate = 0.01  # noqa: N815 (the name that scenes give it)


class RefineConfig(Section):
    """Every choice of a refinement; frozen, unknown keys are errors.

    Attributes:
        steps: Steps, at most; 0 leaves it to ``seconds``.
        seconds: Wall-clock seconds, at most; 0 leaves it to ``steps``. With both 0, a
            simplification is not refined.
        rates: Steps at the start.
        half_after: Steps after which they are half as long; after n times as many, 1 / (n + 1).
        mse_weight: Weight of the logarithm of the mean squared error.
        image_weight: Weight of the logarithm of the loss of CVT-GS, ``0.8 L1 + 0.2 (1 - SSIM) +
            0.2 gradient``.
        size: Longer side of the images, pixels.
        batch: Views that are found together: a quarter automatic ones, half from anywhere around,
            a quarter from anywhere near, within the scene too.
        steps_per_image: Steps for every new image of the full scene; the others take one that
            was rendered before.
        images: Images that are kept at most, 8 bytes per pixel each.
        heldout: Views that decide what is kept, and are never learnt from.
        check_every: Steps between two checks of them.
        patience: Checks without a new best after which the refinement ends.

    Example:
        >>> RefineConfig(size=128).rates.means
        0.02
    """

    steps: int = pydantic.Field(default=0, ge=0)
    seconds: float = pydantic.Field(default=0.0, ge=0.0)
    rates: Rates = Rates()
    half_after: Count = 100
    mse_weight: Rate = 0.5
    image_weight: Rate = 0.5
    size: int = pydantic.Field(default=256, ge=16)
    batch: int = pydantic.Field(default=32, ge=4)
    steps_per_image: Count = 1
    images: Count = 128
    heldout: Count = 8
    check_every: Count = 25
    patience: Count = 8

    @property
    def enabled(self) -> bool:
        """Whether there are steps or seconds to refine for."""
        return bool(self.steps or self.seconds)
