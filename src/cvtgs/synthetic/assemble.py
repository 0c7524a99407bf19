"""From parts with shares to one scene of an exact count, chunk by chunk."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from cvtgs.errors import InvalidArgumentError
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene
from cvtgs.synthetic.chunks import Chunk, Draw

CHUNK = 1 << 15
"""Rows that are drawn together: few enough to stay in the cache of one core."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Something in a scene, and its share of the Gaussians.

    Attributes:
        share: Share of the count, relative to the other parts.
        draw: Makes its Gaussians.
    """

    share: float
    draw: Draw


def allocate(count: int, shares: Sequence[float]) -> list[int]:
    """Split a count in proportion to shares, by largest remainder."""
    if not shares or min(shares) <= 0:
        raise InvalidArgumentError(f"shares must be positive numbers, found {list(shares)}.")
    total = sum(shares)
    quotas = [count * share / total for share in shares]
    counts = [int(quota) for quota in quotas]
    by_remainder = sorted(range(len(shares)), key=lambda k: counts[k] - quotas[k])
    for k in by_remainder[: count - sum(counts)]:
        counts[k] += 1
    return counts


def assemble(
    parts: Sequence[Part],
    *,
    count: int,
    sh_degree: int,
    generator: torch.Generator,
    comment: str,
) -> GaussianScene:
    """Draw all parts into one scene.

    Memory: the scene and the temporaries of one chunk, about ``CHUNK * 1 kB``.
    """
    rest = REST_COUNTS[sh_degree]
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (),
        "sh0": (1, 3), "shN": (rest, 3),
    }  # fmt: skip
    tensors = {name: torch.empty(count, *shape) for name, shape in shapes.items()}
    row = 0
    for part, total in zip(parts, allocate(count, [p.share for p in parts]), strict=True):
        for piece in _pieces(part, total, rest, generator):
            for name, values in piece.tensors().items():
                tensors[name][row : row + len(piece)] = values
            row += len(piece)
    return GaussianScene(
        means=tensors["means"], quats=tensors["quats"], log_scales=tensors["log_scales"],
        logit_opacities=tensors["logit_opacities"], sh0=tensors["sh0"], shN=tensors["shN"],
        comments=(comment,),
    )  # fmt: skip


def _pieces(
    part: Part, total: int, rest: int, generator: torch.Generator
) -> Iterator[GaussianScene]:
    """Draw a part of ``total`` Gaussians chunk by chunk."""
    shift = torch.rand(2, generator=generator)
    for start in range(0, total, CHUNK):
        yield part.draw(
            Chunk(
                start=start,
                stop=min(start + CHUNK, total),
                total=total,
                rest_count=rest,
                shift=shift,
                generator=generator,
            )
        )
