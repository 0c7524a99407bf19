"""LevelsIndex: what a viewer needs to choose among the levels of a scene."""

from typing import Self

import torch

from cvtgs.config.base import Record
from cvtgs.evaluation import SceneScores
from cvtgs.report import Level
from cvtgs.scene import GaussianScene

Corner = tuple[float, float, float]


class LevelEntry(Record):
    """One level.

    Attributes:
        file: Name of the file, in the folder of the index.
        rho: Ratio of Gaussians that was asked for.
        count: Its Gaussians.
        bytes: Size of the file.
        geometric_error: Root mean square distance from the Gaussians of the full scene to those
            that stand for them, each weighing what it paints; scene units. 0 if all are there.
        box_min: Least coordinates of the centres, scene units.
        box_max: Largest coordinates of the centres.
        nested: Whether each of its cells consists of whole cells of the finest level.
        seconds: Wall-clock seconds beyond what finer levels had done already.
        psnr: Mean PSNR against the full scene, dB; None if it was not measured.
        ssim: The same for SSIM.
        lpips: The same for LPIPS.
    """

    file: str
    rho: float
    count: int
    bytes: int
    geometric_error: float
    box_min: Corner
    box_max: Corner
    nested: bool
    seconds: float
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None

    @classmethod
    def of(
        cls, level: Level, rho: float, *, file: str, size: int, scores: SceneScores | None
    ) -> Self:
        """Describe a level.

        Args:
            level: The level.
            rho: Ratio that was asked for.
            file: Name of its file.
            size: Bytes of its file.
            scores: How it looks; None if nobody looked.

        Returns:
            The entry.
        """
        lowest, highest = bounding_box(level.scene)
        return cls(
            file=file,
            rho=rho,
            count=len(level.scene),
            bytes=size,
            geometric_error=level.geometric_error,
            box_min=lowest,
            box_max=highest,
            nested=level.nested,
            seconds=level.report.seconds,
            psnr=scores.psnr.mean if scores else None,
            ssim=scores.ssim.mean if scores else None,
            lpips=scores.lpips.mean if scores and scores.lpips else None,
        )


class LevelsIndex(Record):
    """All levels of a scene, as ``levels.json`` holds them.

    Attributes:
        version: Version of this format.
        source: Name of the file of the full scene.
        source_count: Its Gaussians.
        views: Views that the scores are means over; 0 if nobody looked.
        levels: The levels, the finest first.
    """

    version: int = 1
    source: str
    source_count: int
    views: int = 0
    levels: tuple[LevelEntry, ...]

    def to_json(self) -> str:
        """Return the index as indented JSON.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"


def bounding_box(scene: GaussianScene) -> tuple[Corner, Corner]:
    """Return the box of the centres."""
    low, high = torch.aminmax(scene.means, dim=0)
    return _corner(low), _corner(high)


def _corner(point: torch.Tensor) -> Corner:
    x, y, z = point.tolist()
    return x, y, z
