"""What has no surface: haze, and the floaters that training leaves behind."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.scene import GaussianScene
from cvtgs.synthetic.chunks import Chunk, Draw, gaussians
from cvtgs.synthetic.textures import Color

_HAZE_OPACITY = 0.022
_MANY_FLOATERS = 1000  # more than these are smaller, so that they hide no more of the scene


def haze(
    center: Float[Tensor, "3"], extent: Float[Tensor, "3"], depth: float, color: Color
) -> Draw:
    """Fill a soft ellipsoid with many faint Gaussians.

    Their size follows from their number, so that the haze dims what is behind it alike for
    every count.
    """
    rgb = torch.tensor(color, dtype=torch.float32)
    shadow = 2 * math.pi * float(extent.prod()) ** (2 / 3)

    def draw(chunk: Chunk) -> GaussianScene:
        size = math.sqrt(depth * shadow / (2 * math.pi * chunk.total * _HAZE_OPACITY))
        size = min(size, 0.5 * float(extent.min()))
        scales = size * torch.exp(0.5 * chunk.normals(3) - 0.25)
        return gaussians(
            means=center + extent * chunk.normals(3),
            frames=chunk.frames(),
            scales=scales,
            opacities=chunk.lognormals(_HAZE_OPACITY, 0.5).clamp_max(0.09),
            colors=rgb + 0.04 * chunk.normals(1) + 0.02 * chunk.normals(3),
            rest=0.03 * chunk.normals(chunk.rest_count, 3),
        )

    return draw


def floaters(center: Float[Tensor, "3"], radius: float) -> Draw:
    """Scatter stray Gaussians of any size and colour, most of them faint."""

    def draw(chunk: Chunk) -> GaussianScene:
        distance = radius * (0.4 + 2.6 * chunk.uniforms().square())
        offset = distance[:, None] * chunk.directions() * torch.tensor([1.0, 0.35, 1.0])
        lift = torch.tensor([0.0, -0.3 * radius, 0.0])
        size = 0.012 * radius * math.sqrt(min(1.0, _MANY_FLOATERS / chunk.total))
        longest = chunk.lognormals(size, 0.8)
        shape = torch.stack(
            [
                torch.ones(len(chunk)),
                0.2 + 0.7 * chunk.uniforms(),
                0.02 + 0.4 * chunk.uniforms(),
            ],
            dim=1,
        )
        return gaussians(
            means=center + lift + offset,
            frames=chunk.frames(),
            scales=longest[:, None] * shape,
            opacities=0.02 + 0.5 * chunk.uniforms() ** 3,
            colors=0.55 + 0.15 * chunk.normals(1) + 0.05 * chunk.normals(3),
            rest=0.05 * chunk.normals(chunk.rest_count, 3),
        )

    return draw
