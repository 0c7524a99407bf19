"""The reference backend: tiles composited in batches of torch operations, on any device."""

from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from cvtgs.cameras import Cameras
from cvtgs.progress import ProgressListener, silent
from cvtgs.rendering.blending import composite, composite_gradient
from cvtgs.rendering.contributions import contributions_by_gradient
from cvtgs.rendering.output import RasterOutput, pack, paint_each
from cvtgs.rendering.projection import project
from cvtgs.rendering.tiles import TileLists, intersect
from cvtgs.rendering.views import View, views_of
from cvtgs.scene import GaussianScene

TILE = {"cpu": 8}
"""Pixels along a tile's edge, by type of device: small tiles waste fewer operations."""

_TILE_ELSEWHERE = 16


def require(device: torch.device) -> None:
    """Check that this backend can work on a device: it can on every one."""


def rasterize(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    sh_degree: int,
    listener: ProgressListener = silent,
) -> RasterOutput:
    """Render with torch operations only.

    Memory: for p intersections of splats and tiles, ``60 p`` bytes while they are listed, and
    about ``10 * CELLS`` numbers while a batch is composited (see :mod:`cvtgs.rendering.blending`).
    With gradients each camera also keeps what its projection keeps, ``30 p`` bytes and the
    image; its backward pass needs ``10 p`` numbers at a time.
    """
    blank = scene.means.new_zeros(0, cameras.height, cameras.width, 5)
    views = [partial(_paint, scene, view, sh_degree) for view in views_of(cameras)]
    return paint_each(views, blank, listener)


def contributions(scene: GaussianScene, camera: Cameras) -> Tensor:
    """Return the pixels that every Gaussian paints of one image."""
    return contributions_by_gradient(rasterize, scene, camera)


def _paint(scene: GaussianScene, view: View, sh_degree: int) -> Float[Tensor, "h w 5"]:
    splats = project(scene, view, sh_degree)
    lists = intersect(splats, view.size, TILE.get(scene.device.type, _TILE_ELSEWHERE))
    tiles: Tensor = _Composite.apply(pack(splats), lists)  # type: ignore[no-untyped-call]
    return _assemble(tiles, lists, view.size)


def _assemble(
    tiles: Float[Tensor, "t side side 5"], lists: TileLists, size: tuple[int, int]
) -> Float[Tensor, "h w 5"]:
    """Lay tiles side by side and cut off what hangs over the edges."""
    down = len(tiles) // lists.across
    grid = tiles.unflatten(0, (down, lists.across)).transpose(1, 2)
    overhanging: Tensor = grid.reshape(down * lists.side, lists.across * lists.side, -1)
    return overhanging[: size[1], : size[0]]


class _Composite(torch.autograd.Function):
    """Compositing, with a backward pass that goes over the same batches once more.

    Nothing per pixel and splat is kept. Gradients are summed per intersection, then over the
    intersections of each splat in their order, so they do not depend on any race.
    """

    @staticmethod
    def forward(ctx: Any, packed: Tensor, lists: TileLists) -> Tensor:
        tiles = composite(packed, lists)
        ctx.save_for_backward(packed, tiles)
        ctx.lists = lists
        squares: Tensor = tiles.unflatten(1, (lists.side, lists.side))
        return squares

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        packed, tiles = ctx.saved_tensors
        return composite_gradient(packed, ctx.lists, tiles, grad.flatten(1, 2)), None
