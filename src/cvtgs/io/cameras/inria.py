"""The ``cameras.json`` that INRIA's code writes beside a trained scene."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cvtgs.io.cameras.views import Lens, View, checked_lens, viewmat_of_pose
from cvtgs.io.fields import Fields


def inria_views(entries: Sequence[Any], path: Path) -> list[View]:
    """Read the cameras of a ``cameras.json``."""
    return [_view(Fields.of(entry, f"{path}: camera {row}")) for row, entry in enumerate(entries)]


def _view(entry: Fields) -> View:
    width, height = entry.whole("width"), entry.whole("height")
    lens = Lens(
        fx=entry.number("fx"),
        fy=entry.number("fy"),
        cx=width / 2,
        cy=height / 2,
        width=width,
        height=height,
    )
    return View(
        name=entry.text("img_name"),
        viewmat=viewmat_of_pose(
            entry.array("rotation", (3, 3)), entry.array("position", (3,)), where=entry.where
        ),
        lens=checked_lens(lens, entry.where),
    )
