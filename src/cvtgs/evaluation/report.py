"""Scores of simplified scenes, per view and on average."""

import math
from collections.abc import Sequence
from typing import Self

from cvtgs.config.base import Record
from cvtgs.evaluation.lpips import LpipsNetwork

NOT_ASKED_FOR = "not asked for"
"""Note for LPIPS that was not requested, which needs no explanation."""


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
        """Make a score from the values of the views.

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
    """Return the mean of a score, or None if there is no score."""
    return None if score is None else score.mean


class SceneScores(Record):
    """Mean and per-view scores of the images of one scene.

    Attributes:
        name: Name of the scene.
        count: Number of its Gaussians.
        psnr: Peak signal-to-noise ratio, dB; infinite where images are equal.
        ssim: Structural similarity, at most 1.
        lpips: LPIPS distance, at least 0; None if it was not measured.
        alpha_error: Mean absolute difference of accumulated alpha, 0 to 1; None against
            photographs, which have none.
        alpha_bias: Mean of the accumulated alpha minus that of the full scene, -1 to 1; negative
            if more of the background shows through. None against photographs.
    """

    name: str
    count: int
    psnr: Score
    ssim: Score
    lpips: Score | None = None
    alpha_error: Score | None = None
    alpha_bias: Score | None = None


class Evaluation(Record):
    """Scores of simplified scenes, and the settings of the measurement.

    Attributes:
        reference: Name of the full scene.
        reference_count: Number of its Gaussians.
        views: Names of the views.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        backend: Name of the backend that rendered.
        lpips_network: The network of LPIPS; None if it was not measured.
        lpips_note: Why LPIPS was not measured, else empty.
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
        """A sentence that names the LPIPS network or why LPIPS is missing; empty if turned off."""
        if self.lpips_network:
            return f"LPIPS with the network {self.lpips_network}."
        if self.lpips_note and self.lpips_note != NOT_ASKED_FOR:
            return f"LPIPS was not measured: {self.lpips_note}."
        return ""

    def to_json(self) -> str:
        """Return the evaluation as indented JSON; infinity becomes the string ``Infinity``.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"
