"""KnownRange: closes the corrections of cells unlike those that a network has learned from."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from cvtgs.cells.features import CELL_FEATURES, MEMBER_FEATURES, PAIR_FEATURES, Descriptors
from cvtgs.math.segments import segment_sum

SUMMARY_FEATURES = CELL_FEATURES + MEMBER_FEATURES + PAIR_FEATURES
"""Numbers that tell whether a cell is like those of the training."""

TAIL = 0.01
"""A case does not stand for the cells beyond this quantile of a feature, at both ends."""

MARGIN = 0.1
"""Beyond the range, corrections vanish over this share of its width."""

NARROWEST = 0.01
"""Smallest width over which they vanish, for a feature that never varied."""

MEMBERS, MOST_MEMBERS = 9, 2000
"""The feature that is a fifth of the logarithm of the number of members, and its largest known.

Cells of more members than this are those in the middle of an unbounded scene when most cells are
spent on its sky, whatever a training has seen of them; they cover the cameras when they grow.
"""

WIDEST = 1e30
"""Both ends of the range of a network without a fitted range."""


def summarize(descriptors: Descriptors) -> Float[Tensor, "m f"]:
    """Return the features of cells, and those of members and neighbours in the mean.

    Members count by their share of the mass, so that a huge faint one shows. A cell without
    neighbours has zeros for theirs.
    """
    pairs = descriptors.pairs
    near = pairs.mean(dim=1) if pairs.shape[1] else pairs.new_zeros(len(pairs), pairs.shape[2])
    members = segment_sum(descriptors.members, descriptors.offsets, descriptors.weights)
    return torch.cat([descriptors.cells, members, near], dim=1)


class KnownRange(nn.Module):
    """The range of every feature of a cell over the training, and how far a cell is beyond it.

    A network that extrapolates does harm: an opaque cell of a hundred thousand members, half of
    them a far sky, grows over the cameras. So a residual is multiplied by 1 within the range, by
    0 from ``MARGIN`` beyond it, and linearly in between. The feature that is farthest out
    decides. The range is part of the weights of a network, so training knows of it.

    Example:
        >>> known = KnownRange()
        >>> known(torch.full((1, SUMMARY_FEATURES), 1e6)).tolist()
        [1.0]
        >>> known.fit([torch.linspace(0, 1, 101)[:, None].repeat(1, SUMMARY_FEATURES)])
        >>> rows = torch.tensor([0.5, 1.0390, 1.5])[:, None].repeat(1, SUMMARY_FEATURES)
        >>> [round(value, 3) for value in known(rows).tolist()]
        [1.0, 0.5, 0.0]
    """

    low: Tensor
    high: Tensor
    margin: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("low", torch.full((SUMMARY_FEATURES,), -WIDEST))
        self.register_buffer("high", torch.full((SUMMARY_FEATURES,), WIDEST))
        self.register_buffer("margin", torch.ones(SUMMARY_FEATURES))

    def forward(self, summaries: Float[Tensor, "m f"]) -> Float[Tensor, "m"]:
        """Return the share of its residual that every cell gets, 0 to 1.

        Args:
            summaries: Result of :func:`summarize`.

        Returns:
            Shares, exactly 1 within the range and exactly 0 beyond the margin.
        """
        beyond = torch.maximum(self.low - summaries, summaries - self.high) / self.margin
        return (1 - beyond.amax(dim=1)).clamp(0, 1)

    def fit(self, cases: Iterable[Float[Tensor, "m f"]]) -> None:
        """Set the range from the cells of the training cases.

        Each case has a say of its own, however few cells it has: the range of a feature goes
        from the least to the greatest of what the cases hold without their tails. Cells of more
        than ``MOST_MEMBERS`` members are never known.

        Args:
            cases: Summaries of the cells of every case, at least one.
        """
        ends = [_ends(summaries) for summaries in cases]
        low = torch.stack([end[0] for end in ends]).amin(dim=0)
        high = torch.stack([end[1] for end in ends]).amax(dim=0)
        high[MEMBERS] = high[MEMBERS].clamp(max=0.2 * math.log(MOST_MEMBERS))
        self.low.copy_(low)
        self.high.copy_(high)
        self.margin.copy_((MARGIN * (high - low)).clamp_min(NARROWEST))


def _ends(summaries: Float[Tensor, "m f"]) -> tuple[Float[Tensor, "f"], Float[Tensor, "f"]]:
    ascending = summaries.sort(dim=0).values
    cut = int(TAIL * len(ascending))
    return ascending[cut], ascending[-1 - cut]
