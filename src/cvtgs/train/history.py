"""History: what a training measured, and how it looks."""

from collections.abc import Callable
from statistics import mean
from typing import Any, NamedTuple, Self

from cvtgs.plots import Panel, Series, line_chart

CHOICES: tuple[tuple[Callable[[list[float]], float], str], ...] = (
    (mean, "mean gain, validation scenes"),
    (min, "gain of the worst validation scene"),
)
"""What is drawn of the gains of all scenes."""


class Validation(NamedTuple):
    """What the running mean of the network gained on scenes that it never learns from.

    Attributes:
        step: After this step.
        loss: Mean training loss since the last validation; NaN before the first step.
        gains: Decibels gained, by scene and ratio.
    """

    step: int
    loss: float
    gains: dict[str, dict[float, float]]

    @property
    def score(self) -> float:
        """The mean gain over scenes and ratios, in decibels."""
        return mean(gain for row in self.gains.values() for gain in row.values())

    def by_ratio(self) -> dict[float, list[float]]:
        """Return the gains of all scenes, by ratio.

        Returns:
            Decibels by ratio, the largest ratio first.
        """
        ratios = sorted({ratio for row in self.gains.values() for ratio in row}, reverse=True)
        return {
            ratio: [row[ratio] for row in self.gains.values() if ratio in row] for ratio in ratios
        }


class History:
    """The validations of a training, in order.

    Example:
        >>> history = History()
        >>> for step, gain in ((0, 0.0), (500, 0.3), (1000, 0.2)):
        ...     entry = Validation(step=step, loss=1.0, gains={"room": {0.1: gain}})
        ...     history.validations.append(entry)
        >>> history.best().step, history.since_best()
        (500, 1)
    """

    def __init__(self) -> None:
        self.validations: list[Validation] = []

    def best(self) -> Validation | None:
        """Return the first validation with the largest score.

        Returns:
            It, or None before the first.
        """
        return max(self.validations, key=lambda entry: entry.score, default=None)

    def since_best(self) -> int:
        """Count the validations after the best one.

        Returns:
            Their number.
        """
        best = self.best()
        return 0 if best is None else len(self.validations) - 1 - self.validations.index(best)

    def to_json(self) -> list[Any]:
        """Return plain values.

        Returns:
            Lists, dictionaries, numbers and texts.
        """
        return [
            [entry.step, entry.loss, {name: [*row.items()] for name, row in entry.gains.items()}]
            for entry in self.validations
        ]

    @classmethod
    def from_json(cls, values: list[Any]) -> Self:
        """Take over plain values.

        Args:
            values: What :meth:`to_json` gave.

        Returns:
            The history.
        """
        history = cls()
        for step, loss, gains in values:
            rows = {name: dict(row) for name, row in gains.items()}
            history.validations.append(Validation(step=step, loss=loss, gains=rows))
        return history

    def curves(self) -> bytes:
        """Draw the training loss, and the gains by ratio: mean, and the scene that gains least.

        There must have been a validation.

        Returns:
            A PNG file.

        Raises:
            MissingDependencyError: matplotlib is missing.
        """
        steps = [entry.step for entry in self.validations]
        losses = Panel(
            series=[Series(name="loss", x=steps, y=[entry.loss for entry in self.validations])],
            title="training loss",
            x_label="step",
        )
        table = [entry.by_ratio() for entry in self.validations]
        panels = [
            Panel(
                series=[
                    Series(name=f"rho {ratio:g}", x=steps, y=[choose(row[ratio]) for row in table])
                    for ratio in table[0]
                ],
                title=title,
                x_label="step",
                y_label="dB",
            )
            for choose, title in CHOICES
        ]
        return line_chart([losses, *panels], columns=3, width=1500, height=450)
