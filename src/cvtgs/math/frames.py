"""The robust frame of a scene, and orders of points: along a Morton curve, and by hashes."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.devices import row_chunks
from cvtgs.math.segments import kth_smallest

RADIUS_QUANTILE = 0.7  # the share of points within the radius of a frame
CHUNK = 1 << 16  # points per chunk, to bound memory
FAR = 1000.0  # distance from the origin, in radii, from which float32 positions are coarse
GROUPED = 512  # least number of points that groups are told from
BITS = 21  # bits per axis; three axes fill a 63-bit code

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_FACTORS = (0x1E3779B97F4A7C15, 0x3F58476D1CE4E5B9, 0x14D049BB133111EB)  # odd, of 62 bits at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobustFrame:
    """A centre and a radius that a minority of outliers cannot move.

    Attributes:
        center: ``(3,)`` median of each coordinate, float64.
        radius: The 70 % quantile of the distance to the centre; always positive.
        group_radius: Estimated radius of groups that lie apart (:func:`group_radius`); infinite if
            it was not estimated.
    """

    center: Float[Tensor, "3"]
    radius: float
    group_radius: float = math.inf

    @property
    def view_radius(self) -> float:
        """Radius of what one view shows: of the scene, or of a group if these lie far apart."""
        return min(self.radius, self.group_radius)

    def normalize(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Express finite points, scene units, relative to the centre, in radii and float64."""
        return (points.double() - self.center) / self.radius

    def far_origin(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"] | None:
        """Return the centre if float32 points lie so far from the origin that they are coarse."""
        # Differences from it are exact within a factor of two of the centre's (Sterbenz' lemma).
        if points.dtype != torch.float32 or float(self.center.abs().amax()) < FAR * self.radius:
            return None
        return self.center.to(points.dtype)

    def distances(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return distances of finite points, scene units, to the centre, in radii and float64."""
        found = torch.empty(len(points), dtype=torch.float64, device=points.device)
        for part in row_chunks(len(points), CHUNK, points.device):
            found[part] = torch.linalg.vector_norm(self.normalize(points[part]), dim=1)
        return found

    def contract(self, points: Float[Tensor, "n 3"], strength: float = 1.0) -> Float[Tensor, "n 3"]:
        """Express points in radii, and contract those beyond one radius logarithmically.

        A point at distance d > 1 moves to distance ``1 + log(d)`` in the same direction. Steps
        along the view from the middle shrink by ``1/d`` and those across it by ``(1 + log(d))/d``,
        so a far cell nearly keeps its shape; the map ``2 - 1/d`` of mip-NeRF 360 (Barron et al.
        2022) flattens it. A strength below 1 scales the change of the logarithm of the distance.
        """
        local = self.normalize(points)
        distance: Tensor = torch.linalg.vector_norm(local, dim=1, keepdim=True).clamp_min(1.0)
        return local * ((1.0 + torch.log(distance)) / distance) ** strength


def robust_frame(points: Float[Tensor, "n 3"]) -> RobustFrame:
    """Find the robust frame of finite positions, at least one.

    If more than 70 % of them coincide, the radius is the 70 % quantile of the distances of the
    others; if all do, it is 1.

    Example:
        >>> frame = robust_frame(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
        >>> frame.center.tolist(), frame.radius
        ([1.0, 0.0, 0.0], 1.0)
    """
    center = torch.stack(list(map(torch.median, points.unbind(1)))).double()
    distances = RobustFrame(center=center, radius=1.0).distances(points)
    radius = _radius(distances) or _radius(distances[distances > 0.0]) or 1.0
    return RobustFrame(center=center, radius=radius)


def group_radius(points: Float[Tensor, "n 3"]) -> float:
    """Estimate the radius of the groups that finite points consist of, as a person would see them.

    It is seven times the median, over a sample that is the same in any order of the rows, of the
    distance within which a point has a twentieth of all: 1.1 to 3.3 robust radii in scenes of one
    group, and about three radii of a group where two or more are much further apart than wide. It
    is infinite for fewer than 512 points, and where many coincide.
    """
    if len(points) < GROUPED:
        return math.inf
    rows = hashed_rows(points, 2 * GROUPED)
    rows = rows[:: 1 + len(rows) // (4 * GROUPED)]  # a crowd at one position is there wholly
    if len(rows) < GROUPED:
        return math.inf
    sample = points.index_select(0, rows).double()
    mode = "donot_use_mm_for_euclid_dist"  # products would lose digits far from the origin
    distances = torch.cdist(sample[::16], sample, compute_mode=mode)
    near = kth_smallest(distances, len(sample) // 20)
    return 7.0 * float(near.median()) or math.inf


def _radius(distances: Float[Tensor, "n"]) -> float:
    rank = math.ceil(RADIUS_QUANTILE * len(distances))
    if rank and distances.device.type != "cpu":  # CUDA's kthvalue takes ten times as long
        return float(torch.sort(distances).values[rank - 1])
    return float(distances.kthvalue(rank).values) if rank else 0.0


def unit_vectors(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Scale finite vectors other than 0 to unit length.

    A power of two is divided out first, so that the squares of tiny and huge ones stay finite and
    above 0, and all others have the same bits as without.

    Example:
        >>> unit_vectors(torch.tensor([[0.0, 0.0, 1e-30]])).tolist()
        [[0.0, 0.0, 1.0]]
    """
    exponents = torch.frexp(vectors.abs().amax(dim=1, keepdim=True)).exponent
    return torch.nn.functional.normalize(torch.ldexp(vectors, -exponents), dim=1)


def morton_order(
    points: Float[Tensor, "n 3"], ties: Float[Tensor, "n"] | None = None
) -> Int[Tensor, "n"]:
    """Order points along a Morton curve through their bounding cube (Morton 1966).

    Far outliers make it coarse: 2^21 steps span the cube. ``ties`` order points of the same code,
    ascending, independently of the order of the rows; else these keep their order.

    Example:
        >>> morton_order(torch.tensor([[1.0, 1, 1], [0, 0, 0], [1, 0, 0]])).tolist()
        [1, 2, 0]
    """
    low = points.amin(dim=0) / 2  # halves, since the difference of large numbers may be infinite
    side = (points.amax(dim=0) / 2 - low).amax().clamp_min(torch.finfo(points.dtype).tiny)
    code = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for part in row_chunks(len(points), CHUNK, points.device):  # these fit into a cache
        for axis in range(3):
            steps = (points[part, axis] / 2 - low[axis]) / side * (2**BITS - 1)
            code[part] |= _spread_bits(steps.to(torch.int64)) << axis
    codes, order = torch.sort(code, stable=True)
    if ties is not None and code.device.type != "cpu":  # more work, but no synchronization
        rows = torch.sort(ties, stable=True).indices
        return rows[torch.sort(code[rows], stable=True).indices]
    if ties is not None:
        same = torch.nn.functional.pad(codes[1:] == codes[:-1], (1, 1))
        tied = (same[1:] | same[:-1]).nonzero()[:, 0]
        rows = order[tied]
        rows = rows[torch.sort(ties[rows], stable=True).indices]
        order[tied] = rows[torch.sort(code[rows], stable=True).indices]
    return order


def _spread_bits(values: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Insert two zero bits between any two adjacent bits of the low 21."""
    for shift, mask in _SPREAD:
        values = (values << shift).bitwise_or_(values).bitwise_and_(mask)
    return values


def hashed_rows(means: Float[Tensor, "n 3"], least: int) -> Int[Tensor, "s"]:
    """Sample rows in an order that only depends on the positions: that of their hashes.

    The sample has from ``least`` to twice as many rows, or all; of coincident points, all or none.
    """
    bits = max(0, math.floor(math.log2(max(1, len(means)) / least)))
    rows, hashes = [], []
    for part in row_chunks(len(means), CHUNK, means.device):
        keys = _hash(means[part])
        chosen = (keys & ((1 << bits) - 1) == 0).nonzero()[:, 0]
        rows.append(chosen + part.start)
        hashes.append(keys[chosen])
    return torch.cat(rows)[torch.sort(torch.cat(hashes), stable=True).indices]


def _hash(means: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Hash positions; equal positions give equal hashes, which may be negative."""
    whole = torch.int32 if means.dtype == torch.float32 else torch.int64
    bits = (means + 0.0).contiguous().view(whole).long()  # no -0.0
    x, y, z = (bits ^ (bits >> 32)).unbind(1)  # lower bits of rounded coordinates are zeros
    mixed = x * _FACTORS[0] + y * _FACTORS[1] + z * _FACTORS[2]  # wraps round
    return (mixed ^ (mixed >> 32)) * _FACTORS[0] >> 16
