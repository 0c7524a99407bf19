"""Which cameras are for training and which for testing, where the files do not say."""

from collections.abc import Sequence
from typing import Literal, get_args

from cvtgs.io.cameras.views import View

Split = Literal["train", "test"]
"""Part of the cameras."""

SPLITS: tuple[Split, ...] = get_args(Split)

_EVERY = 8


def hold_out(views: Sequence[View], split: Split | None) -> list[View]:
    """Take every 8th view in the order of names for testing, as Mip-NeRF 360 and 3DGS do."""
    if split is None:
        return list(views)
    by_name = sorted(range(len(views)), key=lambda row: views[row].name)
    test = set(by_name[::_EVERY])
    return [view for row, view in enumerate(views) if (row in test) == (split == "test")]
