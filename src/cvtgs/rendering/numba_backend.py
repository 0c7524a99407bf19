"""The fast backend on CPUs: projection, tiles and compositing compiled by numba."""

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError
from cvtgs.progress import ProgressListener, silent
from cvtgs.rendering.arrays import GaussianArrays, Setting, SplatArrays, TileArrays
from cvtgs.rendering.compiled import use_threads
from cvtgs.rendering.kernels_blending import composite_all
from cvtgs.rendering.kernels_blending_gradient import composite_all_gradient
from cvtgs.rendering.kernels_projection import project_all
from cvtgs.rendering.kernels_projection_gradient import project_all_gradient
from cvtgs.rendering.kernels_tiles import count_tiles, name_tiles, sort_by_tile
from cvtgs.rendering.output import RasterOutput, paint_each
from cvtgs.rendering.views import View, views_of
from cvtgs.scene import GaussianScene

SIDE = 16
"""Pixels along a tile's edge."""


def require(device: torch.device) -> None:
    """Check that this backend can work on a device."""
    if device.type != "cpu":
        raise DeviceError(
            f"backend 'numba' works on the CPU only, found a scene on {device}; "
            f"use 'torch' or 'auto', or move the scene."
        )


def rasterize(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    sh_degree: int,
    listener: ProgressListener = silent,
) -> RasterOutput:
    """Render with compiled loops, on as many threads as torch uses.

    The first call compiles for some five seconds per dtype, and as long again in the first
    backward pass; the code is kept on disk, and a later process loads it in half a second. No
    result depends on the number of threads. OpenMP's idle threads spin for a while after each
    loop; ``OMP_WAIT_POLICY=PASSIVE``, set before Python starts, saves that processor time.

    Memory: ``11 n`` numbers for n Gaussians, ``12 p`` bytes for p intersections of splats and
    tiles, and the image. The backward pass needs ``10 p`` numbers at a time.
    """
    use_threads(torch.get_num_threads())
    tensors = [tensor.contiguous() for tensor in scene.tensors().values()]
    settings = [
        Setting(_numbers(view), view.size, sh_degree, scene.antialiased)
        for view in views_of(cameras)
    ]
    views = [partial(_Render.apply, setting, *tensors) for setting in settings]
    blank = scene.means.new_zeros(0, cameras.height, cameras.width, 5)
    return paint_each(views, blank, listener)


def contributions(scene: GaussianScene, camera: Cameras) -> Float[Tensor, "n"]:
    """Return the pixels that every Gaussian paints of one image, by one forward pass."""
    use_threads(torch.get_num_threads())
    found = np.zeros(len(scene))
    arrays = {name: tensor.detach().contiguous() for name, tensor in scene.tensors().items()}
    gaussians = GaussianArrays(*(tensor.numpy() for tensor in arrays.values()))
    for view in views_of(camera):
        splats, tiles = _listed(gaussians, Setting(_numbers(view), view.size, 0, scene.antialiased))
        image = np.empty((view.size[1], view.size[0], 5), splats.packed.dtype)
        painted = np.zeros(len(tiles.lists))
        composite_all(splats.packed, tiles, _centers(image), image, painted)
        sums = np.concatenate([[0.0], np.cumsum(painted)])[splats.starts]
        found[splats.rows] += np.diff(sums)
    return torch.from_numpy(found)


class _Render(torch.autograd.Function):
    """One image. The backward pass uses the lists of the forward pass, and blends once more."""

    @staticmethod
    def forward(ctx: Any, setting: Setting, *tensors: Tensor) -> Float[Tensor, "h w 5"]:
        gaussians = GaussianArrays(*(tensor.detach().numpy() for tensor in tensors))
        splats, tiles = _listed(gaussians, setting)
        image = np.empty((setting.size[1], setting.size[0], 5), splats.packed.dtype)
        composite_all(splats.packed, tiles, _centers(image), image, np.empty(0))
        result = torch.from_numpy(image)
        ctx.save_for_backward(result, *tensors)
        ctx.setting, ctx.splats, ctx.tiles = setting, splats, tiles
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        use_threads(torch.get_num_threads())
        image, *arrays = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        gaussians = GaussianArrays(*arrays)
        per_place = np.zeros((len(ctx.tiles.lists), 10), image.dtype)
        of_image = grad.contiguous().numpy()
        composite_all_gradient(
            ctx.splats.packed, ctx.tiles, _centers(image), image, of_image, per_place
        )
        gradients = GaussianArrays(*(np.zeros_like(array) for array in arrays))
        project_all_gradient(gaussians, ctx.setting, ctx.splats, per_place, gradients)
        return None, *(torch.from_numpy(gradient) for gradient in gradients)


def _listed(gaussians: GaussianArrays, setting: Setting) -> tuple[SplatArrays, TileArrays]:
    """Project, sort by depth and list the tiles."""
    count = len(gaussians.means)
    packed, seen = np.empty((count, 10), gaussians.means.dtype), np.empty(count, np.bool_)
    project_all(gaussians, setting, packed, seen)
    rows = np.flatnonzero(seen)
    rows = rows[np.argsort(packed[rows, 9], kind="stable")]
    packed = packed[rows]
    splat_starts = np.zeros(len(rows) + 1, np.int64)
    count_tiles(packed, setting.size, SIDE, splat_starts[1:])
    np.cumsum(splat_starts, out=splat_starts)
    names = np.empty(splat_starts[-1], np.int32)
    name_tiles(packed, setting.size, SIDE, splat_starts, names)
    tiles = -(-setting.size[0] // SIDE) * -(-setting.size[1] // SIDE)
    tile_starts, lists = np.zeros(tiles + 1, np.int64), np.empty((len(names), 2), np.int32)
    sort_by_tile(names, splat_starts, tile_starts, lists)
    return SplatArrays(rows, splat_starts, packed), TileArrays(tile_starts, lists, SIDE)


def _numbers(view: View) -> NDArray[np.float64]:
    """Lay a view out as ``Setting`` describes."""
    pairs = (view.focal, view.principal, *view.slopes, view.size)
    return np.array([*view.rotation, view.center, *((*pair, 0.0) for pair in pairs)])


def _centers(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the coordinates of pixel centres, in the image's dtype."""
    return (np.arange(max(image.shape[:2])) + 0.5).astype(image.dtype)
