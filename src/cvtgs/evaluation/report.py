"""Scores of simplified scenes, per view and on average."""

import math
from collections.abc import Sequence
from typing import Self

from cvtgs.config.base import Record
from cvtgs.evaluation.lpips import LpipsNetwork

NOT_ASKED_FOR = "not asked for"
"""Why LPIPS is missing where that is no news."""


class Score(Record):
    """One metric.

    Attributes:
        mean: Mean over the views.
        views: The value of each view.
    """

    mean: float
    views: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Average values.

        Args:
            values: One per view, at least one.

        Returns:
            The score.

        Example:
            >>> Score.of([20.0, 30.0]).mean
            25.0
        """
        return cls(mean=math.fsum(values) / len(values), views=tuple(values))


def mean_of(score: Score | None) -> float | None:
    """Return the mean of a score, None where there is none."""
    return None if score is None else score.mean


class SceneScores(Record):
    """How close the images of one scene come to others.

    Attributes:
        name: Name of the scene.
        count: Its Gaussians.
        psnr: Peak signal-to-noise ratio, dB; infinite where images are equal.
        ssim: Structural similarity, at most 1.
        lpips: LPIPS distance, at least 0; None where it was not measured.
        alpha_error: Mean absolute difference of accumulated alpha, 0 to 1; None against
            photographs, which have none.
        alpha_bias: Mean of the accumulated alpha minus that of the full scene, -1 to 1; negative
            where more of the background shows through. None against photographs.
    """

    name: str
    count: int
    psnr: Score
    ssim: Score
    lpips: Score | None = None
    alpha_error: Score | None = None
    alpha_bias: Score | None = None


class Evaluation(Record):
    """Scores of simplified scenes, and how they were measured.

    Attributes:
        reference: Name of the full scene.
        reference_count: Its Gaussians.
        views: Names of the views.
        width: Pixels per row.
        height: Rows.
        backend: What rendered.
        lpips_network: The network of LPIPS; None if it was not measured.
        lpips_note: Why it was not measured, else empty.
        scenes: Scores of each simplified scene against images of the full one.
        photographs: Scores of the full and of each simplified scene against photographs; empty
            without photographs.
    """

    reference: str
    reference_count: int
    views: tuple[str, ...]
    width: int
    height: int
    backend: str
    lpips_network: LpipsNetwork | None = None
    lpips_note: str = ""
    scenes: tuple[SceneScores, ...]
    photographs: tuple[SceneScores, ...] = ()

    @property
    def lpips_sentence(self) -> str:
        """Which network LPIPS has, or why it is missing; empty if it was turned off."""
        if self.lpips_network:
            return f"LPIPS with the network {self.lpips_network}."
        if self.lpips_note and self.lpips_note != NOT_ASKED_FOR:
            return f"LPIPS was not measured: {self.lpips_note}."
        return ""

    def to_json(self) -> str:
        """Return the evaluation as indented JSON; infinite numbers are the string ``Infinity``.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"
