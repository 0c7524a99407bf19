"""Contact sheets: all scenes and views on one image, with what they cost and score."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from cvtgs.evaluation.compare import Comparison
from cvtgs.evaluation.error_maps import ERROR_SCALE, colored, error_map
from cvtgs.evaluation.images import lettering, resized
from cvtgs.evaluation.labels import decibels, megabytes, times_fewer
from cvtgs.evaluation.scores import SceneScores

_PAPER, _INK, _FADED = (250, 250, 249), (28, 28, 30), (110, 110, 115)
_LONGEST_TILE, _SHEET_WIDTH = 360, 2800
_GAP, _MARGIN, _SIDE, _HEAD, _FOOT = 8, 28, 230, 44, 64
_NAME, _TEXT = 20, 15


def contact_sheet(comparison: Comparison) -> UInt8[np.ndarray, "y x 3"]:
    """Show every view of every scene: a row per scene, the full one first, a column per view."""
    sheet = _Sheet.of(comparison, rows=1 + len(comparison.small), foot=0)
    sheet.headings(comparison.evaluation.views)
    sheet.row(0, full_lines(comparison), comparison.full, captions=())
    for row, scores in enumerate(comparison.evaluation.scenes, start=1):
        captions = tuple(decibels(value) for value in scores.psnr.views)
        sheet.row(
            row, small_lines(comparison, scores), comparison.small[scores.name], captions=captions
        )
    return sheet.canvas


def error_sheet(comparison: Comparison) -> UInt8[np.ndarray, "y x 3"]:
    """Show where every small image differs from the full one, with a legend of the colours."""
    sheet = _Sheet.of(comparison, rows=len(comparison.small), foot=_FOOT)
    sheet.headings(comparison.evaluation.views)
    for row, scores in enumerate(comparison.evaluation.scenes):
        pairs = zip(comparison.full, comparison.small[scores.name], strict=True)
        maps = np.stack([error_map(one, other) for one, other in pairs])
        captions = tuple(decibels(value) for value in scores.psnr.views)
        sheet.row(row, small_lines(comparison, scores), maps, captions=captions)
    sheet.legend()
    return sheet.canvas


def full_lines(comparison: Comparison) -> tuple[str, ...]:
    """Return what is written beside the images of the full scene."""
    evaluation = comparison.evaluation
    return (
        evaluation.reference,
        f"{evaluation.reference_count:,} Gaussians",
        megabytes(comparison.sizes.get(evaluation.reference)),
    )


def small_lines(comparison: Comparison, scores: SceneScores) -> tuple[str, ...]:
    """Return what is written beside the images of a simplified scene."""
    distance = f"LPIPS {scores.lpips.mean:.3f}" if scores.lpips else ""
    return (
        scores.name,
        f"{scores.count:,} Gaussians",
        times_fewer(comparison.ratio(scores)),
        megabytes(comparison.sizes.get(scores.name)),
        f"PSNR {decibels(scores.psnr.mean)}",
        f"SSIM {scores.ssim.mean:.3f}",
        distance,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sheet:
    """Paper with a grid of tiles; ``canvas`` is what gets drawn on."""

    tile: tuple[int, int]
    row_height: int
    canvas: UInt8[np.ndarray, "y x 3"] = field(repr=False)

    @classmethod
    def of(cls, comparison: Comparison, *, rows: int, foot: int) -> "_Sheet":
        views, height, width, _ = comparison.full.shape
        room = (_SHEET_WIDTH - _SIDE) / views - _GAP
        factor = min(1.0, min(_LONGEST_TILE, room) / max(width, height))
        tile = max(1, round(factor * width)), max(1, round(factor * height))
        row_height = max(tile[1] + round(1.6 * _TEXT), round(7.5 * 1.45 * _TEXT)) + _GAP
        shape = (
            2 * _MARGIN + _HEAD + rows * row_height + foot,
            2 * _MARGIN + _SIDE + views * (max(tile[0], 90) + _GAP),
            3,
        )
        return cls(tile=tile, row_height=row_height, canvas=np.full(shape, _PAPER, np.uint8))

    def headings(self, names: tuple[str, ...]) -> None:
        for column, name in enumerate(names):
            self._write(self._left(column), _MARGIN, _fitting(name, self.tile[0]), color=_FADED)

    def row(
        self,
        number: int,
        lines: tuple[str, ...],
        images: UInt8[np.ndarray, "c h w 3"],
        *,
        captions: tuple[str, ...],
    ) -> None:
        top = _MARGIN + _HEAD + number * self.row_height
        name, *others = lines
        self._write(_MARGIN, top, _fitting(name, _SIDE - 20, _NAME), size=_NAME)
        for place, line in enumerate(filter(None, others)):
            below = top + round(1.5 * _NAME + place * 1.45 * _TEXT)
            self._write(_MARGIN, below, line, color=_FADED)
        for column, image in enumerate(images):
            left = self._left(column)
            tile = resized(image, self.tile)
            self.canvas[top : top + self.tile[1], left : left + self.tile[0]] = tile
        for column, caption in enumerate(captions):
            self._write(self._left(column), top + self.tile[1] + 4, caption, color=_FADED)

    def legend(self) -> None:
        top = self.canvas.shape[0] - _MARGIN - _FOOT + 16
        left, width, height = self._left(0), 320, 14
        bar = np.linspace(0, 1, width, dtype=np.float32)[None].repeat(height, axis=0)
        room = self.canvas[top : top + height, left : left + width]
        room[:] = colored(bar)[:, : room.shape[1]]
        self._write(_MARGIN, top - 3, "RMS difference")
        for step in range(4):
            place = left + round(step / 3 * width) - (0 if step == 0 else 12)
            more = " +" if step == 3 else ""
            self._write(
                place, top + height + 5, f"{step / 3 * ERROR_SCALE:.1f}{more}", color=_FADED
            )

    def _left(self, column: int) -> int:
        return _MARGIN + _SIDE + column * (max(self.tile[0], 90) + _GAP)

    def _write(
        self,
        left: int,
        top: int,
        text: str,
        *,
        size: int = _TEXT,
        color: tuple[int, int, int] = _INK,
    ) -> None:
        letters = lettering(text, size)
        room = self.canvas[top : top + letters.shape[0], left : left + letters.shape[1]]
        cover = letters[: room.shape[0], : room.shape[1], None].astype(np.float32) / 255
        room[:] = (cover * np.asarray(color) + (1 - cover) * room).round().astype(np.uint8)


def _fitting(text: str, width: int, size: int = _TEXT) -> str:
    """Shorten a text in the middle until it fits."""
    shown = text
    while len(shown) > 4 and lettering(shown, size).shape[1] > width:
        keep = len(shown) - 2
        shown = f"{text[: keep // 2]}…{text[-(keep - keep // 2 - 1) :]}"
    return shown
