"""How images are taken and judged."""

from dataclasses import dataclass

from cvtgs.evaluation.judge import LpipsChoice
from cvtgs.rendering import BackendName


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSettings:
    """How images are taken and judged.

    Attributes:
        background: Colour behind the scenes: red, green and blue in [0, 1].
        lpips: Which LPIPS to measure: ``vgg``, ``alex``, ``off``, or ``auto``, which leaves it
            out where there are no weights.
        backend: What renders.

    Example:
        >>> EvaluationSettings(lpips="off").background
        (0.0, 0.0, 0.0)
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lpips: LpipsChoice = "auto"
    backend: BackendName = "auto"
