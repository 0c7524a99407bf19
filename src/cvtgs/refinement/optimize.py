"""The steps of a refinement, and what of them is kept."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from cvtgs.config import RefineConfig
from cvtgs.losses import relative_loss
from cvtgs.refinement.budget import Budget
from cvtgs.refinement.images import BEST_PSNR, Image, ImageBuffer, best_counted, scores
from cvtgs.refinement.variables import Variables
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Descent:
    """What came out.

    Attributes:
        scene: The best scene, by held-out images; what came in if none was better.
        before: Score of what came in, dB.
        after: Score of the best, dB.
        stopped: Why it ended: ``steps``, ``time``, ``patience`` or ``perfect``.
    """

    scene: GaussianScene
    before: float
    after: float
    stopped: str


def descend(
    small: GaussianScene,
    album: ImageBuffer,
    heldout: tuple[Image, ...],
    *,
    budget: Budget,
    config: RefineConfig,
    freedom: Float[Tensor, "n"],
    tell: Callable[[float], None],
) -> Descent:
    """Move the Gaussians of a scene towards images of the full one, one image per step."""
    budget.begin()
    first = scores(small, heldout)
    limit = best_counted(first)
    best, before = small, float(first.clamp(max=limit).mean())
    budget.end("check")
    variables = Variables(small, config.rates, freedom=freedom)
    after, waited = before, 0
    stopped = "perfect" if float(first.amin()) >= BEST_PSNR else budget.spent()
    while not stopped:
        factor = 1 / (1 + budget.steps / config.half_after)
        budget.begin()
        _step(variables, album, config=config, factor=factor)
        budget.end("step")
        stopped = budget.spent()
        if stopped or budget.steps % config.check_every == 0:
            found = variables.result()
            reached = float(scores(found, heldout).clamp(max=limit).mean())
            budget.end("check")
            waited = 0 if reached > after else waited + 1
            best, after = (found, reached) if reached > after else (best, after)
            stopped = stopped or ("patience" if waited >= config.patience else budget.spent())
        tell(after - before)
    return Descent(scene=best, before=before, after=after, stopped=stopped)


def _step(variables: Variables, album: ImageBuffer, *, config: RefineConfig, factor: float) -> None:
    """Look at one image, over a random background: a wrong opacity shows over some."""
    target, background = album.draw(), album.draw_color()
    image = render(variables.scene(), target.camera, background=background).rgb
    loss = relative_loss(
        image,
        target.over(background),
        squared_weight=config.squared,
        image_weight=config.image,
    )
    variables.step(loss, factor=factor)
