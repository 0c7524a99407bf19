"""What the drawings share: figures that need no display, and small PNG files."""

import io
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

LARGEST = 150_000
"""Bytes of a drawing at most, so that the repository stays small."""


def figure(rows: int, columns: int, *, width: float, height: float) -> tuple[Figure, Any]:
    """Make a figure with panels."""
    made = Figure(figsize=(width, height), layout="constrained", dpi=100)
    FigureCanvasAgg(made)
    return made, made.subplots(rows, columns)


def save_small(drawn: Figure, path: Path) -> None:
    """Write a figure with as many colours as fit."""
    raw = io.BytesIO()
    drawn.savefig(raw, format="png")
    image = Image.open(raw).convert("RGB")
    for colors in (256, 128, 64, 32):
        small = io.BytesIO()
        image.quantize(colors, dither=Image.Dither.NONE).save(small, "png", optimize=True)
        if small.tell() <= LARGEST:
            path.write_bytes(small.getvalue())
            return
    raise SystemExit(f"{path} would be larger than {LARGEST} bytes")
