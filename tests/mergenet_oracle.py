"""Descriptors and MergeNet, cell by cell in float64; nothing here imports cvtgs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from oracles import Array, clamped_opacity, rotation, thomsen_area

C0 = 0.28209479177387814


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    """One Gaussian, activated; the axes are the columns of ``axes``."""

    mean: Array
    axes: Array
    scales: Array
    opacity: float
    color: Array

    @property
    def area(self) -> float:
        return thomsen_area(self.scales)

    @property
    def covariance(self) -> Array:
        return (self.axes * self.scales**2) @ self.axes.T

    def locate(self, point: Array) -> Array:
        """The point in the frame and in the standard deviations of this Gaussian."""
        return np.array(
            [
                float(axis @ (point - self.mean)) / scale
                for axis, scale in zip(self.axes.T, self.scales, strict=True)
            ]
        )

    def extents(self, other: "Gaussian") -> list[float]:
        """Logs of another's standard deviations along these axes, relative to one's own."""
        lengths = [math.sqrt(axis @ other.covariance @ axis) for axis in self.axes.T]
        return [
            clamp(math.log(length / scale), 9.0)
            for length, scale in zip(lengths, self.scales, strict=True)
        ]

    def contrast(self, other: "Gaussian") -> float:
        return min(math.sqrt(float(np.mean((self.color - other.color) ** 2))), 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A merged Gaussian, the members of its cell, their visibility, and its neighbours."""

    own: Gaussian
    members: Sequence[Gaussian]
    visibilities: Sequence[float]
    others: Sequence[Gaussian]
    other_sizes: Sequence[int]
    antialiased: bool
    pixel_size: float

    @property
    def shares(self) -> list[float]:
        masses = [member.opacity * member.area for member in self.members]
        return [mass / math.fsum(masses) for mass in masses]

    @property
    def visibility(self) -> float:
        return math.fsum(w * v for w, v in zip(self.shares, self.visibilities, strict=True))

    @property
    def contrast(self) -> float:
        squares = [member.contrast(self.own) ** 2 for member in self.members]
        return math.sqrt(math.fsum(w * s for w, s in zip(self.shares, squares, strict=True)))

    @property
    def visibility_gradient(self) -> Array:
        """The direction in which the visibility of members rises."""
        total = np.zeros(3)
        for share, visible, member in zip(
            self.shares, self.visibilities, self.members, strict=True
        ):
            total += share * (visible - self.visibility) * self.own.locate(member.mean)
        return total

    @property
    def cover(self) -> Array:
        """Opacity of neighbours three sigmas out, by axis, positive side first."""
        sides = np.zeros((3, 2))
        for axis in range(3):
            for side, sign in enumerate((1.0, -1.0)):
                end = self.own.mean + sign * 3.0 * self.own.scales[axis] * self.own.axes[:, axis]
                through = [1.0 - other.opacity * bell(other.locate(end)) for other in self.others]
                sides[axis, side] = 1.0 - math.prod(through)
        return sides


def gaussian(
    mean: Sequence[float],
    quat: Sequence[float],
    log_scales: Sequence[float],
    logit: float,
    sh0: Sequence[float],
) -> Gaussian:
    return Gaussian(
        mean=np.array(mean),
        axes=rotation(quat),
        scales=np.exp(np.array(log_scales)),
        opacity=clamped_opacity(logit),
        color=C0 * np.array(sh0),
    )


def clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def bell(position: Array) -> float:
    return math.exp(-0.5 * min(float(position @ position), 60.0))


def squashed_length(position: Array) -> float:
    return math.log1p(min(math.sqrt(float(position @ position)), 50.0))


def distances(position: Array) -> list[float]:
    return [*(math.log1p(min(abs(x), 50.0)) for x in position), squashed_length(position)]


def uncovered(cell: Cell, position: Sequence[float]) -> list[float]:
    """Positive on the less covered side, negative on the other: by axis, and in total."""
    sides = [
        0.5 * (minus - plus) * x for (plus, minus), x in zip(cell.cover, position, strict=True)
    ]
    return [*sides, math.fsum(sides)]


def describe_members(cell: Cell) -> list[list[float]]:
    rows = []
    for share, visible, member in zip(cell.shares, cell.visibilities, cell.members, strict=True):
        position, contrast = cell.own.locate(member.mean), member.contrast(cell.own)
        rows.append(
            [
                *distances(position),
                *(0.3 * extent for extent in cell.own.extents(member)),
                *uncovered(cell, [clamp(x, 4.0) for x in position]),
                0.3 * clamp(math.log(share * len(cell.members)), 14.0),
                member.opacity,
                0.2 * clamp(math.log(member.area / cell.own.area), 14.0),
                3.0 * contrast,
                0.5 * contrast / (cell.contrast + 0.02),
                visible,
                3.0 * (visible - cell.visibility),
                clamp(float(cell.visibility_gradient @ position), 3.0),
            ]
        )
    return rows


def describe_pairs(cell: Cell) -> list[list[float]]:
    rows = []
    for other, size in zip(cell.others, cell.other_sizes, strict=True):
        position, back = cell.own.locate(other.mean), other.locate(cell.own.mean)
        rows.append(
            [
                *distances(position),
                *(0.3 * extent for extent in cell.own.extents(other)),
                *uncovered(cell, [x / (1.0 + abs(x)) for x in position]),
                squashed_length(back),
                other.opacity,
                0.2 * clamp(math.log(other.area / cell.own.area), 14.0),
                0.2 * math.log(size / len(cell.members)),
                3.0 * other.contrast(cell.own),
                other.opacity * bell(back),
                bell(position),
            ]
        )
    return rows


def describe_cell(cell: Cell) -> list[float]:
    cover, own = cell.cover, cell.own
    inner = np.zeros(3)
    for share, member in zip(cell.shares, cell.members, strict=True):
        inner += share * np.minimum(np.exp(2.0 * np.array(own.extents(member))), 4.0)
    painted = math.fsum(-math.log1p(-member.opacity) * member.area for member in cell.members)
    logs = np.log(own.scales)
    places = [own.locate(other.mean) for other in cell.others]
    return [
        *cover.min(axis=1),
        *cover.max(axis=1),
        *inner,
        0.2 * math.log(len(cell.members)),
        own.opacity,
        0.2 * math.log(own.opacity / (1.0 - own.opacity)),
        0.3 * clamp(math.log(painted / own.area), 14.0),
        0.5 * clamp(logs[0] - logs[1], 8.0),
        0.3 * clamp(logs[1] - logs[2], 8.0),
        5.0 * cell.contrast,
        cell.visibility,
        min(float(np.linalg.norm(cell.visibility_gradient)), 3.0),
        min((squashed_length(position) for position in places), default=math.log1p(50.0)),
        1.0 if cell.antialiased else 0.0,
        0.3 * min(max(math.log(np.prod(own.scales) ** (1 / 3) / cell.pixel_size), -6.0), 12.0),
    ]


def dense(weights: Mapping[str, Array], name: str, values: Array) -> Array:
    """One linear layer of a network given as its weights by name."""
    return weights[f"{name}.weight"] @ values + weights.get(f"{name}.bias", 0.0)


def silu(values: Array) -> Array:
    return values / (1.0 + np.exp(-values))


def layers(weights: Mapping[str, Array], name: str, values: Array) -> Array:
    return silu(dense(weights, f"{name}.2", silu(dense(weights, f"{name}.0", values))))


def gates(weights: Mapping[str, Array], name: str, own: Array, cell: Array) -> Array:
    summed = dense(weights, f"{name}.own", own) + dense(weights, f"{name}.cell", cell)
    return np.tanh(dense(weights, f"{name}.gates", silu(summed)))


def twist(position: Array) -> Array:
    x, y, z = position
    return np.array([y * z, x * z, x * y])


def predict(weights: Mapping[str, Array], cell: Cell) -> dict[str, Array]:
    """The residuals of one cell, by name."""
    shares = np.array(cell.shares)
    members = [layers(weights, "member_layers", np.array(row)) for row in describe_members(cell)]
    pairs = [layers(weights, "pair_layers", np.array(row)) for row in describe_pairs(cell)]
    nothing = np.zeros_like(members[0])
    pooled = layers(
        weights,
        "cell_layers",
        np.concatenate(
            [
                describe_cell(cell),
                np.mean(members, axis=0),
                shares @ np.array(members),
                np.max(members, axis=0),
                np.mean(pairs, axis=0) if pairs else nothing,
                np.max(pairs, axis=0) if pairs else nothing,
            ]
        ),
    )
    of_members = [2.0 * gates(weights, "member_gates", own, pooled) for own in members]
    of_pairs = [0.5 * gates(weights, "pair_gates", own, pooled) for own in pairs]
    shift, turn = np.zeros(3), np.zeros(3)
    for share, gate, member in zip(shares, of_members, cell.members, strict=True):
        position = np.clip(cell.own.locate(member.mean), -50.0, 50.0)
        shift += share * gate[0] * position
        turn += share * gate[2:] * twist(np.clip(position, -5.0, 5.0))
    for gate, other in zip(of_pairs, cell.others, strict=True):
        position = np.clip(cell.own.locate(other.mean), -50.0, 50.0)
        shift += gate[0] * position / len(of_pairs)
        turn += 2.0 * gate[2:] * twist(position / (1.0 + np.abs(position))) / len(of_pairs)
    sizes = dense(weights, "decoder", pooled)
    ratios = np.array([math.log(other.area / cell.own.area) for other in cell.others])
    lends = np.clip(ratios + 4.5, 0.0, 1.0)
    return {
        "d_means": shift,
        "d_log_scales": 0.6 * np.tanh(sizes[:3]),
        "d_rotvecs": 0.5 * np.tanh(turn),
        "d_logit_opacities": 2.0 * np.tanh(0.5 * sizes[3]),
        "member_colors": shares * [gate[1] for gate in of_members],
        "pair_colors": lends * [gate[1] for gate in of_pairs] / max(1, len(of_pairs)),
    }
