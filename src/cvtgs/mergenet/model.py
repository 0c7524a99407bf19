"""MergeNet: a small network that corrects merged Gaussians, shared by all cells."""

import copy
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import pydantic
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from cvtgs.cells.descriptors import (
    AREA,
    AREA_SCALE,
    CELL_FEATURES,
    DISTANCE,
    DISTANCE_BACK,
    LEAST_PIXELS,
    MEMBER_FEATURES,
    PAIR_FEATURES,
    PIXEL_SCALE,
    Descriptors,
)
from cvtgs.config.base import Record
from cvtgs.devices import move_together
from cvtgs.math.segments import segment_ids, segment_max, segment_sum
from cvtgs.text import short_repr

Width = Annotated[int, pydantic.Field(ge=1, le=1024)]
CellWidth = Annotated[int, pydantic.Field(ge=1, le=4096)]

LARGE_GROWTH = 0.6  # unit of changes of log scales in the cost of residuals
LARGEST_LOGIT_CHANGE = 2.0  # largest change of an opacity logit
LARGEST_TURN = 0.5  # largest rotation of a cell about each of its axes, in radians

LARGEST_MEMBER_GATE = 2.0
LARGEST_PAIR_GATE = 0.5

LEAST_AREA = -4.5
"""Logarithm of the ratio of areas up to which a neighbour is too small to lend its colour; from 1
above it, it lends all. A cell of the sky has much smaller ones far in front of it as neighbours."""

FARTHEST = 10.0
"""Distance from which on a neighbour lends no colour, in standard deviations of the cell or of the
neighbour, whichever are fewer; up to 1 less, it lends all. Few walls of a room have the object in
front of them among their nearest cells."""

SUMMARY_FEATURES = CELL_FEATURES - 1 + MEMBER_FEATURES + PAIR_FEATURES
"""Number of features that decide whether a cell is similar to the training cells."""

TAIL = 0.01  # share of the cells of a case that is ignored at both ends of each feature
MARGIN = 0.1  # corrections fade to zero beyond the range over this share of its width
NARROWEST = 0.01  # smallest width of this fade, for features that did not vary in training

MEMBERS, MOST_MEMBERS = 9, 2000
"""Index of the feature ``0.2 log(members)``, and the number from which on corrections fade: larger
cells, of unbounded scenes where most cells are spent on the sky, cover the cameras when they grow.
"""

_TO_BE_LOADED = ContextVar("_TO_BE_LOADED", default=False)

WIDEST = 1e30  # absolute value of both ends of the range before it is fitted


class Architecture(Record):
    """The architecture of a MergeNet.

    Attributes:
        kind: Distinguishes it from the published network.
        member_features: Number of features of a member.
        pair_features: Number of features of a neighbour.
        cell_features: Number of features of a cell.
        width: Units of the layers of members and neighbours.
        cell_width: Units of the layers of cells.
        largest_growth: Largest change of a log scale.
    """

    kind: Literal["gated"] = "gated"
    member_features: int = MEMBER_FEATURES
    pair_features: int = PAIR_FEATURES
    cell_features: int = CELL_FEATURES
    width: Width = 32
    cell_width: CellWidth = 64
    largest_growth: float = pydantic.Field(default=0.6, gt=0.0, le=3.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residuals:
    """Changes of the merged Gaussians; zeros change nothing.

    Attributes:
        d_means: ``(m, 3)`` moves of the centres, in the frame and the standard deviations of each.
        d_log_scales: ``(m, 3)`` changes of the log scales.
        d_rotvecs: ``(m, 3)`` rotation vectors v in the frame of each; the angle is
            ``2 atan(|v| / 2)`` radians, which is nearly ``|v|`` here.
        d_logit_opacities: ``(m,)`` changes of the opacity logits.
        member_colors: ``(n,)`` shares of the members' colour differences to add.
        pair_colors: ``(m, k)`` shares of the neighbours' colour differences to add.
    """

    d_means: Float[Tensor, "m 3"]
    d_log_scales: Float[Tensor, "m 3"]
    d_rotvecs: Float[Tensor, "m 3"]
    d_logit_opacities: Float[Tensor, "m"]
    member_colors: Float[Tensor, "n"]
    pair_colors: Float[Tensor, "m k"]

    __repr__ = short_repr

    def cost(self) -> Float[Tensor, ""]:
        """Return the mean square of all changes but colours, each in units of a large change.

        Returns:
            A term of the training loss; 0 for no change.
        """
        parts = [
            self.d_log_scales / LARGE_GROWTH,
            self.d_logit_opacities / LARGEST_LOGIT_CHANGE,
            self.d_rotvecs / LARGEST_TURN,
            self.d_means.clamp(-1, 1),
        ]
        return torch.stack([part.square().mean() for part in parts]).mean()


class CellNetwork(nn.Module):
    """A network that corrects merged Gaussians, cell by cell.

    Attributes:
        sees_surroundings: Whether it needs the neighbours of a cell and the ambient visibility of
            its members.
    """

    sees_surroundings = True

    def copy_to(self, device: torch.device, dtype: torch.dtype) -> Self:
        """Return a copy on a device in a given precision; all parameters move in a single copy."""
        copied = copy.deepcopy(self).to(dtype)
        if device.type == "cpu":
            return copied
        state = copied.state_dict()
        moved = move_together(list(state.values()), device)
        copied.load_state_dict(dict(zip(state, moved, strict=True)), assign=True)
        return copied


class MergeNet(CellNetwork):
    """The network that predicts residuals from descriptors.

    As in CVT-GS, a pointwise network over members is pooled by mean, maximum and mass, and the last
    layer of the decoder starts at zero, so that an untrained network changes nothing. Unlike there,
    neighbours are encoded in the same way as members; only size and opacity come from the decoder.
    Changes of position, rotation and colour are sums over members and neighbours of their
    differences from the cell, each times a predicted gate. So the residuals rotate with the scene,
    mix existing colours, and support any number of SH bands at no cost.
    Cells unlike those of the training stay unchanged (:class:`KnownRange`).

    Args:
        architecture: Kind and layer sizes.

    Example:
        >>> sum(parameter.numel() for parameter in MergeNet(Architecture()).parameters())
        25966
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture: Architecture = architecture
        width, cell_width = architecture.width, architecture.cell_width
        pooled = architecture.cell_features + 5 * width
        self.member_layers: nn.Sequential = two_layers(architecture.member_features, width)
        self.pair_layers: nn.Sequential = two_layers(architecture.pair_features, width)
        self.cell_layers: nn.Sequential = two_layers(pooled, cell_width)
        self.decoder: Linear = Linear(cell_width, 4)
        self.member_gates: _Gates = _Gates(width, cell_width)
        self.pair_gates: _Gates = _Gates(width, cell_width)
        self.known: KnownRange = KnownRange()
        nn.init.zeros_(self.decoder.weight)
        nn.init.zeros_(self.decoder.bias)

    def forward(self, descriptors: Descriptors) -> Residuals:
        """Predict the residuals of some cells.

        Args:
            descriptors: Any number of cells, each with at least one member.

        Returns:
            Residuals of each cell.
        """
        offsets, weights = descriptors.offsets, descriptors.weights
        ids, shape = segment_ids(offsets, len(weights)), descriptors.pairs.shape[:2]
        members = self.member_layers(descriptors.members)
        pairs = self.pair_layers(descriptors.pairs.flatten(0, 1))
        pooled = [
            descriptors.cells,
            segment_sum(members, offsets, descriptors.shares),
            segment_sum(members, offsets, weights),
            segment_max(members, offsets),
            *_pool_pairs(pairs.unflatten(0, shape)),
        ]
        cells = self.cell_layers(torch.cat(pooled, dim=1))
        sizes = self.decoder(cells)
        of_members = LARGEST_MEMBER_GATE * self.member_gates(members, cells, ids)
        pair_ids = torch.arange(len(cells), device=ids.device).repeat_interleave(shape[1])
        of_pairs = LARGEST_PAIR_GATE / max(1, shape[1]) * self.pair_gates(pairs, cells, pair_ids)
        positions = descriptors.positions
        pair_positions = descriptors.pair_positions.flatten(0, 1)
        pulls = segment_sum(_pulls(of_members, positions, positions.clamp(-5, 5)), offsets, weights)
        near = pair_positions / (1 + pair_positions.abs())
        others = _pulls(of_pairs, pair_positions, near).unflatten(0, shape).sum(dim=1)
        # Doubled, so that neighbours can turn a cell as much as a gate of 1 does.
        twists = pulls[:, 3:] + 2 * others[:, 3:]
        # Cells far below a pixel in size could not be seen from where pixels are measured, so
        # people look at them from nearby, and what their size is there is unknown.
        pixels = descriptors.cells[:, -1] / PIXEL_SCALE
        known = self.known(summarize(descriptors)) * (pixels - (LEAST_PIXELS - 1)).clamp(0, 1)
        by_cell = known[:, None]
        areas = descriptors.pairs[:, :, AREA] / AREA_SCALE
        own, back = descriptors.pairs[:, :, DISTANCE], descriptors.pairs[:, :, DISTANCE_BACK]
        distances = torch.minimum(own, back).expm1()
        lends = (areas - LEAST_AREA).clamp(0, 1) * (FARTHEST - distances).clamp(0, 1)
        return Residuals(
            d_means=(pulls[:, :3] + others[:, :3]) * by_cell,
            d_log_scales=self.architecture.largest_growth * torch.tanh(sizes[:, :3]) * by_cell,
            d_rotvecs=LARGEST_TURN * torch.tanh(twists) * by_cell,
            d_logit_opacities=LARGEST_LOGIT_CHANGE * torch.tanh(0.5 * sizes[:, 3]) * known,
            member_colors=of_members[:, 1] * weights * known.index_select(0, ids),
            pair_colors=of_pairs[:, 1].unflatten(0, shape) * by_cell * lends,
        )


class _SiLU(nn.Module):
    """SiLU, in place unless autograd keeps its input."""

    def forward(self, sums: Tensor) -> Tensor:
        return nn.functional.silu(sums, inplace=not sums.requires_grad)


class _Gates(nn.Module):
    """Gates in [-1, 1] for position, colour and rotation about three axes; initially 0."""

    def __init__(self, width: int, cell_width: int) -> None:
        super().__init__()
        self.own: Linear = Linear(width, width)
        self.cell: Linear = Linear(cell_width, width, bias=False)
        self.gates: Linear = Linear(width, 5)
        self.activation: nn.Module = _SiLU()
        nn.init.zeros_(self.gates.weight)
        nn.init.zeros_(self.gates.bias)

    def forward(self, inputs: Tensor, cells: Tensor, ids: Int[Tensor, "n"]) -> Tensor:
        of_cells = self.cell(cells) + self.own.bias
        # One fused multiply-add instead of a product and two sums over all members.
        hidden = self.activation(of_cells.index_select(0, ids).addmm_(inputs, self.own.weight.T))
        # Few gates, many rows: the product is faster if each gate is contiguous over all rows.
        return torch.tanh(torch.addmm(self.gates.bias[:, None], self.gates.weight, hidden.T)).T


class Linear(nn.Linear):
    """A layer in float32 on the CPU, whatever the defaults of the program, with random weights."""

    def __init__(self, features: int, width: int, *, bias: bool = True) -> None:
        super().__init__(features, width, bias=bias, device="cpu", dtype=torch.float32)

    def reset_parameters(self) -> None:
        """Draw random weights, unless they are going to be loaded."""
        if not _TO_BE_LOADED.get():
            super().reset_parameters()


@contextmanager
def without_weights() -> Iterator[None]:
    """Build networks without weights in this thread, so that no random numbers are drawn."""
    token = _TO_BE_LOADED.set(True)
    try:
        yield
    finally:
        _TO_BE_LOADED.reset(token)


def two_layers(features: int, width: int) -> nn.Sequential:
    """Return two linear layers of a width, each with its activation."""
    return nn.Sequential(Linear(features, width), _SiLU(), Linear(width, width), _SiLU())


def _pool_pairs(pairs: Float[Tensor, "m k w"]) -> tuple[Tensor, Tensor]:
    """Pool over neighbours by mean and maximum; zeros for cells without neighbours."""
    if pairs.shape[1] == 0:
        nothing = pairs.new_zeros(len(pairs), pairs.shape[2])
        return nothing, nothing
    return pairs.mean(dim=1), pairs.amax(dim=1)


def _pulls(
    gates: Float[Tensor, "n 5"], positions: Float[Tensor, "n 3"], levers: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 6"]:
    """Return by how much each row moves its cell, and turns it about each axis.

    The turn about an axis is proportional to the product of the other two coordinates.
    """
    x, y, z = levers.unbind(1)
    twists = torch.stack([y * z, x * z, x * y])
    return torch.cat([gates.T[:1] * positions.T, gates.T[2:] * twists]).T


def summarize(descriptors: Descriptors) -> Float[Tensor, "m f"]:
    """Return the features of cells, and the means of those of members and neighbours.

    Members are weighted by their share of the mass, so that a huge faint member counts. Features
    of missing neighbours are 0. The last feature of a cell, its size in pixels, is left out: cells
    are corrected whatever the size of the images, unless they are far too small to be seen.
    """
    pairs = descriptors.pairs
    near = pairs.mean(dim=1) if pairs.shape[1] else pairs.new_zeros(len(pairs), pairs.shape[2])
    members = segment_sum(descriptors.members, descriptors.offsets, descriptors.weights)
    return torch.cat([descriptors.cells[:, :-1], members, near], dim=1)


class KnownRange(nn.Module):
    """The range of every cell feature in training; it fades out residuals of cells beyond it.

    Extrapolation does harm: an opaque cell of a hundred thousand members, half of them in a
    distant sky, grows over the cameras. So a residual is multiplied by 1 within the range, by 0
    from ``MARGIN`` beyond it, and linearly in between. The feature that is farthest outside
    decides. The range is stored with the weights of the network, and is active in training.

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
        widest = torch.full((SUMMARY_FEATURES,), WIDEST, dtype=torch.float32, device="cpu")
        self.register_buffer("low", -widest)
        self.register_buffer("high", widest)
        self.register_buffer("margin", torch.ones_like(widest))

    def forward(self, summaries: Float[Tensor, "m f"]) -> Float[Tensor, "m"]:
        """Return the factor of the residual of every cell, 0 to 1.

        Args:
            summaries: Result of :func:`summarize`.

        Returns:
            Factors, exactly 1 within the range and exactly 0 beyond the margin.
        """
        beyond = torch.maximum(self.low - summaries, summaries - self.high) / self.margin
        return (1 - beyond.amax(dim=1)).clamp(0, 1)

    def fit(self, cases: Iterable[Float[Tensor, "m f"]]) -> None:
        """Set the range from the summaries of the cells of the training cases, at least one case.

        Tails are cut case by case, however few cells a case has; the range of a feature then goes
        from the smallest to the largest remaining value of all cases, that of the members at most
        to ``MOST_MEMBERS``.
        """
        lows, highs = list[Tensor](), list[Tensor]()
        for summaries in cases:
            ascending = summaries.sort(dim=0).values
            cut = int(TAIL * len(ascending))
            lows.append(ascending[cut])
            highs.append(ascending[-1 - cut])
        low, high = torch.stack(lows).amin(dim=0), torch.stack(highs).amax(dim=0)
        high[MEMBERS] = high[MEMBERS].clamp(max=0.2 * math.log(MOST_MEMBERS))
        self.low.copy_(low)
        self.high.copy_(high)
        self.margin.copy_((MARGIN * (high - low)).clamp_min(NARROWEST))
