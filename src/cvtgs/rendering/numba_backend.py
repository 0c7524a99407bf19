"""The fast backend on CPUs: projection, tiles and compositing compiled by numba."""

from collections.abc import Iterator
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
from cvtgs.rendering.backends import RasterOutput, collect_images
from cvtgs.rendering.compiled import (
    GaussianArrays,
    RasterSettings,
    SplatArrays,
    TileArrays,
    for_each_camera,
)
from cvtgs.rendering.kernels_blending import (
    composite_all,
    composite_all_gradient,
    light_of_gradient,
)
from cvtgs.rendering.kernels_projection import project_all, project_all_gradient
from cvtgs.rendering.kernels_tiles import count_tiles, sort_by_tile, write_tiles
from cvtgs.rendering.kernels_weights import TileWeights
from cvtgs.rendering.projection import Pinhole, to_pinholes
from cvtgs.scene import GaussianScene

SIDE = 16  # pixels along a tile's edge
INTERSECTIONS = 2**22  # of splats and tiles that are listed at a time


def require(device: torch.device) -> None:
    """Raise unless the device is a CPU."""
    if device.type != "cpu":
        raise DeviceError(
            f"backend 'numba' works on the CPU only, found a scene on {device}; "
            f"use 'torch' or 'auto', or move the scene."
        )


def rasterize(
    scene: GaussianScene, cameras: Cameras, *, sh_degree: int, listener: ProgressListener = silent
) -> RasterOutput:
    """Render with compiled loops, without gradients up to four images at a time.

    Memory per image: ``11 n`` numbers for n Gaussians, ``12 p`` bytes for p intersections of splats
    and tiles, at most four million at a time, and the image; backward, ``10 p`` numbers.
    """
    tensors = [tensor.contiguous() for tensor in scene.tensors().values()]
    pinholes = to_pinholes(cameras)

    def render_one(camera: Pinhole) -> Float[Tensor, "h w 5"]:
        settings = _settings(camera, sh_degree, scene)
        image: Tensor = _Render.apply(settings, *tensors)  # type: ignore[no-untyped-call]
        return image

    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        images = (render_one(pinhole) for pinhole in pinholes)
    else:
        images = for_each_camera(render_one, pinholes)
    return collect_images(images, scene, cameras, listener=listener)


def contributions(scene: GaussianScene, cameras: Cameras) -> Iterator[Float[Tensor, "n"]]:
    """Yield the sum of each Gaussian's weights ``alpha * T`` over every image, without gradient."""
    return (found for _, found in observe(scene, cameras, sh_degree=0))


def observe(
    scene: GaussianScene, cameras: Cameras, *, sh_degree: int
) -> Iterator[tuple[RasterOutput, Float[Tensor, "n"]]]:
    """Yield every image, and each Gaussian's weights summed over it in the same pass."""
    gaussians = _arrays(scene)

    def observe_one(pinhole: Pinhole) -> tuple[RasterOutput, Tensor]:
        settings = _settings(pinhole, sh_degree, scene)
        found = np.zeros(len(scene))
        image, open_rows = _start_image(settings, gaussians.means.dtype)
        for splats in _parts(_project(gaussians, settings), open_rows):
            tiles, weights = _list_splats(splats, open_rows, settings), np.zeros(splats.starts[-1])
            composite_all(splats.packed, tiles, _pixel_centers(image), image, open_rows, weights)
            sums = np.concatenate([[0.0], np.cumsum(weights)])[splats.starts]
            found[splats.rows] = np.diff(sums)
        layers = torch.from_numpy(image)[None]
        output = RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=1 - layers[..., 4])
        return output, torch.from_numpy(found)

    return for_each_camera(observe_one, to_pinholes(cameras))


def blending_weights(scene: GaussianScene, camera: Cameras) -> TileWeights:
    """Return the weights of every Gaussian in every pixel of one image."""
    (pinhole,) = to_pinholes(camera)
    settings = _settings(pinhole, 0, scene)
    splats = _project(_arrays(scene), settings)
    tiles = _list_splats(splats, _open_rows(settings.size), settings)
    return TileWeights(splats, tiles, settings.size, count=len(scene))


def _arrays(scene: GaussianScene) -> GaussianArrays:
    tensors = scene.tensors().values()
    return GaussianArrays(*(tensor.detach().contiguous().numpy() for tensor in tensors))


class _Render(torch.autograd.Function):
    """Render one image; the backward pass blends again, and reuses the list of a single part."""

    @staticmethod
    def forward(ctx: Any, settings: RasterSettings, *tensors: Tensor) -> Float[Tensor, "h w 5"]:
        gaussians = GaussianArrays(*(tensor.detach().numpy() for tensor in tensors))
        image, open_rows = _start_image(settings, gaussians.means.dtype)
        projected, kept = _project(gaussians, settings), None
        for splats in _parts(projected, open_rows):
            tiles = _list_splats(splats, open_rows, settings)
            centers, no_weights = _pixel_centers(image), np.empty(0)
            composite_all(splats.packed, tiles, centers, image, open_rows, no_weights)
            kept = tiles if len(splats.rows) == len(projected.rows) else None
        result = torch.from_numpy(image)
        ctx.save_for_backward(result, *tensors)
        ctx.settings, ctx.splats, ctx.tiles = settings, projected, kept
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        image, *arrays = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        gaussians = GaussianArrays(*arrays)
        gradients = GaussianArrays(*(np.zeros_like(array) for array in arrays))
        image_grad, open_rows = grad.contiguous().numpy(), _open_rows(ctx.settings.size)
        behind = np.empty_like(image[..., 0])
        light_of_gradient(image, image_grad, behind)
        state = (np.ones_like(behind), behind, open_rows)
        for splats in _parts(ctx.splats, open_rows):
            tiles = ctx.tiles or _list_splats(splats, open_rows, ctx.settings)
            per_intersection = np.zeros((splats.starts[-1], 10), image.dtype)
            composite_all_gradient(
                splats.packed, tiles, _pixel_centers(image), image_grad, state, per_intersection
            )
            project_all_gradient(gaussians, ctx.settings, splats, per_intersection, gradients)
        return None, *(torch.from_numpy(gradient) for gradient in gradients)


def _start_image(
    settings: RasterSettings, dtype: np.dtype[Any]
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Return an image without splats, and its open pixels."""
    width, height = settings.size
    open_rows, image = _open_rows(settings.size), np.zeros((height, width, 5), dtype)
    image[..., 4] = 1
    return image, open_rows


def _open_rows(size: tuple[int, int]) -> NDArray[np.int64]:
    """Return a bit for each pixel of each tile, one integer per row of a tile."""
    columns, rows = (np.minimum(SIDE, length - np.arange(0, length, SIDE)) for length in size)
    is_row = np.arange(SIDE) < rows[:, None, None]
    return np.where(is_row, (np.int64(1) << columns[:, None]) - 1, 0).reshape(-1, SIDE)


def _project(gaussians: GaussianArrays, settings: RasterSettings) -> SplatArrays:
    """Project Gaussians, sort them by depth and count the tiles that each splat touches."""
    count = len(gaussians.means)
    packed, visible = np.empty((count, 10), gaussians.means.dtype), np.empty(count, np.bool_)
    depths = np.empty(count)  # float32 would often be equal for different depths
    project_all(gaussians, settings, packed, depths, visible)
    rows = np.flatnonzero(visible)
    # Bits of positive floats are in the order of the floats, and integers sort six times as fast.
    bits = torch.from_numpy(depths.view(np.int64)[rows])
    rows = rows[torch.sort(bits, stable=True).indices.numpy()]
    packed = packed.take(rows, axis=0)  # five times as fast as packed[rows]
    starts, first = np.zeros(len(rows) + 1, np.int64), np.empty(len(rows), np.int32)
    count_tiles(packed, settings.size, SIDE, starts[1:], first)
    np.cumsum(starts, out=starts)
    return SplatArrays(rows, starts, first, packed)


def _parts(splats: SplatArrays, open_rows: NDArray[np.int64]) -> Iterator[SplatArrays]:
    """Split splats, front to back, into parts of ``INTERSECTIONS`` while pixels are unfinished."""
    begin, count = 0, len(splats.rows)
    while begin < count and open_rows.any():
        limit = splats.starts[begin] + INTERSECTIONS
        end = max(begin + 1, int(np.searchsorted(splats.starts, limit, side="right")) - 1)
        starts = splats.starts[begin : end + 1] - splats.starts[begin]
        part = slice(begin, end)
        yield SplatArrays(splats.rows[part], starts, splats.first[part], splats.packed[part])
        begin = end


def _list_splats(
    splats: SplatArrays, open_rows: NDArray[np.int64], settings: RasterSettings
) -> TileArrays:
    """List the splats of each tile that has open pixels."""
    tile_ids = np.empty(splats.starts[-1], np.int32)
    write_tiles(splats.packed, settings.size, SIDE, splats.starts, splats.first, tile_ids)
    starts, is_open = np.zeros(len(open_rows) + 1, np.int64), np.any(open_rows, axis=1)
    lists = np.empty((len(tile_ids), 2), np.int32)
    sort_by_tile(tile_ids, splats.starts, is_open, starts, lists)
    return TileArrays(starts, lists[: starts[-1]], SIDE)


def _settings(camera: Pinhole, sh_degree: int, scene: GaussianScene) -> RasterSettings:
    pairs = (camera.focal, camera.principal, *camera.slopes)
    last = (*camera.size, camera.dilation)
    rows = [*camera.rotation, camera.center, *((*pair, 0.0) for pair in pairs), last]
    compensated = scene.antialiased and not camera.ignores_tag
    return RasterSettings(np.array(rows), camera.size, sh_degree, compensated)


def _pixel_centers(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the coordinates of pixel centres, in the image's dtype."""
    return (np.arange(max(image.shape[:2])) + 0.5).astype(image.dtype)
