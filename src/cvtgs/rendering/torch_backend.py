"""The reference backend: tiled compositing in torch operations, on every device."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from cvtgs.cameras import Cameras
from cvtgs.devices import check_computes
from cvtgs.math import segments
from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.progress import ProgressListener, silent
from cvtgs.rendering import backends
from cvtgs.rendering.backends import PixelWeights, RasterOutput
from cvtgs.rendering.projection import (
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    Pinhole,
    Splats,
    half_sizes,
    pack,
    project,
    reach_of,
    to_pinholes,
)
from cvtgs.scene import GaussianScene

TILE = {"cpu": 8}  # pixels along a tile's edge, by device type; small tiles waste fewer operations

_TILE_ELSEWHERE = 16
# Pairs of splat and pixel per batch, by device type; small batches fit a CPU's caches
CELLS = {"cpu": 1 << 18}
_CELLS_ELSEWHERE = 1 << 23

_DEPTH = 32  # splats of each tile in one batch
_SLACK = 1e-3  # pixels by which boxes are enlarged, so that rounding omits nothing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TileLists:
    """The splats of each tile, front to back."""

    splats: Int[Tensor, "p"]  # splat of each intersection; sorted by tile, then by depth
    starts: Int[Tensor, "t_plus_1"]  # start of each tile's list; tiles are in row-major order
    ranks: Int[Tensor, "p"]  # index of each intersection in splat order (by splat, then by tile)
    splat_starts: Int[Tensor, "m_plus_1"]  # start of each splat's intersections
    side: int  # pixels along a tile's edge
    across: int  # tiles per row


def require(device: torch.device) -> None:
    """Accept every device that has float64."""
    if device.type != "meta":  # for shapes without values
        check_computes(device)


def rasterize(
    scene: GaussianScene, cameras: Cameras, *, sh_degree: int, listener: ProgressListener = silent
) -> RasterOutput:
    """Render with torch operations only.

    Memory: for p intersections of splats and tiles, ``60 p`` bytes while they are listed, and
    ``10 CELLS`` numbers; with gradients also the projection, ``30 p`` bytes and ``10 p`` numbers.
    """
    images = (_render_one(scene, sh_degree, camera) for camera in to_pinholes(cameras))
    return backends.collect_images(images, scene, cameras, listener=listener)


def contributions(scene: GaussianScene, cameras: Cameras) -> Iterator[Float[Tensor, "n"]]:
    """Yield contributions, as gradients of summed images with respect to the colours."""
    tensors = backends.without_gradients(scene).tensors()
    for camera in cameras.singles():
        with torch.inference_mode(mode=False), torch.enable_grad():
            # Mid-grey, so that no colour is clipped; the higher SH bands do not matter here.
            # Colours that are not finite stay so, since they are not rendered.
            sh0 = (0 * tensors["sh0"]).requires_grad_()
            gray = scene.with_tensors(tensors | {"sh0": sh0, "shN": tensors["shN"][:, :0]}, {})
            image = rasterize(gray, camera, sh_degree=0).rgb
            (gradient,) = torch.autograd.grad(image[..., 0].sum(), sh0)
        yield gradient[:, 0, 0].double().clamp_min(0.0) / SH_C0


observe = partial(backends.observe_in_two_passes, rasterize, contributions)


@torch.no_grad()
def blending_weights(scene: GaussianScene, camera: Cameras) -> PixelWeights:
    """Return the weights of every Gaussian in every pixel of one image."""
    (pinhole,) = to_pinholes(camera)
    splats = project(scene, pinhole, 0)
    lists = intersect(splats, pinhole.size, TILE.get(scene.device.type, _TILE_ELSEWHERE))
    entries, values = [], []
    for batch in _batches(pack(splats), lists):
        weights = batch.alpha * batch.transmittance
        row, rank, pixel = weights.nonzero(as_tuple=True)
        tile = batch.tiles[row]
        x = tile % lists.across * lists.side + pixel % lists.side
        y = tile // lists.across * lists.side + pixel // lists.side
        inside = (x < pinhole.size[0]) & (y < pinhole.size[1])
        splat = splats.rows[lists.splats[batch.entries[row, rank]]]
        entries.append(torch.stack([y * pinhole.size[0] + x, splat])[:, inside])
        values.append(weights[row, rank, pixel][inside])
    pixels, rows = torch.cat([splats.rows.new_zeros(2, 0), *entries], dim=1)
    weights = torch.cat([scene.means.new_zeros(0), *values])
    return PixelWeights(pixels, rows, weights, size=pinhole.size, count=len(scene))


def _render_one(scene: GaussianScene, sh_degree: int, camera: Pinhole) -> Float[Tensor, "h w 5"]:
    splats = project(scene, camera, sh_degree)
    lists = intersect(splats, camera.size, TILE.get(scene.device.type, _TILE_ELSEWHERE))
    tiles: Tensor = _Composite.apply(pack(splats), lists)  # type: ignore[no-untyped-call]
    down = len(tiles) // lists.across
    grid = tiles.unflatten(0, (down, lists.across)).transpose(1, 2)
    overhanging: Tensor = grid.reshape(down * lists.side, lists.across * lists.side, -1)
    return overhanging[: camera.size[1], : camera.size[0]]


class _Composite(torch.autograd.Function):
    """Compositing; the backward pass recomputes the batches, and sums in a fixed order."""

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


@torch.no_grad()
def intersect(splats: Splats, size: tuple[int, int], side: int) -> TileLists:
    """List, for each splat, the tiles with a pixel where its alpha reaches 1/255.

    Exact up to rounding, which only adds tiles. Memory: 60 bytes per intersection, 100 per splat.
    """
    width, height = size
    across, down = -(-width // side), -(-height // side)
    splat, row, first, last = _strips(splats, size, side)
    counts = (last - first + 1).clamp_min(0)
    strip, place = _expand(counts)
    tiles = (row[strip] * across + first[strip] + place).to(torch.int32)
    owner = splat[strip]
    ranks, starts = segments.sort_by_label(tiles, across * down)
    per_splat = torch.bincount(owner, minlength=len(splats.rows))
    return TileLists(
        splats=owner[ranks],
        starts=starts,
        ranks=ranks,
        splat_starts=torch.nn.functional.pad(per_splat.cumsum(0), (1, 0)),
        side=side,
        across=across,
    )


def _strips(
    splats: Splats, size: tuple[int, int], side: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut splats at rows of tiles; return splat, tile row, first and last tile column of each."""
    width, height = size
    reach = reach_of(splats.opacities)
    half_height = half_sizes(splats.ellipses, reach)[1]
    y = splats.centers[:, 1]
    top, bottom = _pixels(y - half_height, y + half_height, height)
    first, last = top // side, bottom // side
    splat, place = _expand(torch.where(bottom >= top, last - first + 1, 0))
    row = first[splat] + place
    y = y[splat]
    upper = torch.maximum(row * side, top[splat]).to(y) + 0.5 - y
    lower = torch.minimum(row * side + side - 1, bottom[splat]).to(y) + 0.5 - y
    left, right = _extent(splats.ellipses[splat], reach[splat], upper, lower)
    x = splats.centers[:, 0][splat]
    begin, end = _pixels(x + left, x + right, width)
    return splat, row, begin // side, torch.where(end >= begin, end // side, -1)


def _extent(ellipses: Tensor, reach: Tensor, upper: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
    """Return the left and right extent of ellipses between two heights, relative to the centre."""
    steep, shear, flat = ellipses.unbind(1)
    half_width = half_sizes(ellipses, reach)[0]
    tip = -shear / flat * reach / half_width.clamp_min(torch.finfo(reach.dtype).tiny)

    def edge(at: Tensor, side: int) -> Tensor:  # a concave function: farthest nearest to the tip
        height = torch.minimum(torch.maximum(at, upper), lower)
        inside = (reach - flat * height * height).clamp_min(0)
        return -shear * height + side * (inside / steep).sqrt()

    return edge(-tip, -1), edge(tip, 1)


def _pixels(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the first and last of ``count`` pixels whose centres lie in an interval."""
    slack = _SLACK + 1e-6 * (high - low)
    first = (low - 0.5 - slack).ceil().clamp(0, count)
    last = (high - 0.5 + slack).floor().clamp(-1, count - 1)
    return first.to(torch.int64), last.to(torch.int64)


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Repeat each row number ``counts`` times; also return the index of each repetition."""
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    rows = segments.segment_ids(starts)
    return rows, torch.arange(len(rows), device=rows.device) - starts[rows]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TileBatch:
    """The next splats of some tiles, and their weights in the tiles' pixels."""

    tiles: Int[Tensor, "b"]  # indices of the tiles
    entries: Int[Tensor, "b k"]  # indices into the lists; 0 for padding
    valid: Bool[Tensor, "b k"]  # False for padding
    params: Float[Tensor, "b k 10"]  # packed splats
    along: Float[Tensor, "b k s s"]  # offset along x from the centre plus shear times `down`
    down: Float[Tensor, "b k s"]  # offset along y from the centre, pixels
    alpha: Float[Tensor, "b k q"]  # alpha of each splat in each pixel, 0 where it is skipped
    transmittance: Float[Tensor, "b k q"]  # in front of each splat, 0 where the pixel is finished
    remaining: Float[Tensor, "b q"]  # transmittance behind the last splat; infinite if none


def composite(packed: Float[Tensor, "m 10"], lists: TileLists) -> Float[Tensor, "t q 5"]:
    """Composite every tile; memory: the result and about ten arrays of ``CELLS`` numbers."""
    result = packed.new_zeros(len(lists.starts) - 1, lists.side**2, 5)
    result[..., 4] = 1
    for batch in _batches(packed, lists):
        weights = batch.alpha * batch.transmittance
        result[batch.tiles, :, :4] += weights.transpose(1, 2) @ batch.params[:, :, 6:]
        result[batch.tiles, :, 4] = torch.minimum(result[batch.tiles, :, 4], batch.remaining)
    return result


def composite_gradient(
    packed: Float[Tensor, "m 10"],
    lists: TileLists,
    result: Float[Tensor, "t q 5"],
    grad: Float[Tensor, "t q 5"],
) -> Float[Tensor, "m 10"]:
    """Return the gradient of :func:`composite`, front to back over the same batches.

    Light from behind a splat is the total minus that up to it; 3DGS divides, back to front.
    Memory: ten numbers per intersection, and about fifteen arrays of ``CELLS`` numbers.
    """
    behind = (result * grad).sum(dim=2)
    per_entry = packed.new_zeros(len(lists.splats), packed.shape[1])
    for batch in _batches(packed, lists):
        worth = batch.params[:, :, 6:] @ grad[batch.tiles, :, :4].transpose(1, 2)
        alpha, transmittance = batch.alpha, batch.transmittance
        weights = alpha * transmittance
        rest = behind[batch.tiles][:, None] - _scan(weights * worth, torch.add)
        behind[batch.tiles] = rest[:, -1]
        of_alpha = transmittance * worth - (transmittance > 0) * rest / (1 - alpha)
        of_log_alpha = torch.where(alpha < MAX_ALPHA, alpha * of_alpha, 0)
        columns = [_exponent_gradient(batch, of_log_alpha), weights @ grad[batch.tiles, :, :4]]
        per_entry[lists.ranks[batch.entries[batch.valid]]] = torch.cat(columns, dim=2)[batch.valid]
    return segments.segment_sum(per_entry, lists.splat_starts)


def _exponent_gradient(
    batch: TileBatch, of_log_alpha: Float[Tensor, "b k q"]
) -> Float[Tensor, "b k 6"]:
    """Convert the gradient by log alpha to that by centres, ellipses and log opacities."""
    _, _, square, shear, rest = batch.params[:, :, :5].unbind(2)
    per_row = of_log_alpha.unflatten(2, batch.along.shape[2:])
    zeroth, moments = per_row.sum(dim=3), per_row * batch.along
    first, second = moments.sum(dim=3), (moments * batch.along).sum(dim=3)
    along = first.sum(dim=2)
    down = (zeroth * batch.down).sum(dim=2)
    columns = [
        -2 * square * along,
        -2 * square * shear * along - 2 * rest * down,
        second.sum(dim=2),
        2 * square * (first * batch.down).sum(dim=2),
        (zeroth * batch.down * batch.down).sum(dim=2),
        zeroth.sum(dim=2),
    ]
    return torch.stack(columns, dim=2)


def _batches(packed: Tensor, lists: TileLists) -> Iterator[TileBatch]:
    """Yield batches of tiles with lists of similar length until all their pixels are finished."""
    counts = lists.starts.diff()
    order = torch.sort(counts, descending=True, stable=True).indices
    cells = CELLS.get(packed.device.type, _CELLS_ELSEWHERE)
    size = max(1, cells // (_DEPTH * lists.side**2))
    for group in order[: int((counts > 0).sum())].split(size):
        tiles, start = group, 0
        transmittance = packed.new_ones(len(group), lists.side**2)
        while len(tiles):
            batch = _composite_batch(packed, lists, tiles, start, transmittance)
            yield batch
            start += _DEPTH
            transmittance = batch.transmittance[:, -1] * (1 - batch.alpha[:, -1])
            going = (transmittance.amax(dim=1) > 0) & (counts[tiles] > start)
            tiles, transmittance = tiles[going], transmittance[going]


def _composite_batch(
    packed: Tensor, lists: TileLists, tiles: Tensor, start: int, transmittance: Tensor
) -> TileBatch:
    """Composite the next ``_DEPTH`` splats of each tile from number ``start`` on."""
    places = torch.arange(_DEPTH, device=packed.device) + start + lists.starts[tiles][:, None]
    valid = places < lists.starts[tiles + 1][:, None]
    entries = torch.where(valid, places, 0)
    params = packed[lists.splats[entries]]
    pixels = torch.arange(lists.side, dtype=packed.dtype, device=packed.device) + 0.5
    columns = (tiles % lists.across * lists.side)[:, None] + pixels
    rows = (tiles // lists.across * lists.side)[:, None] + pixels
    x, y, square, shear, rest, log_opacity = (
        part[:, :, None] for part in params[..., :6].unbind(2)
    )
    down = rows.to(packed.dtype)[:, None] - y
    along = (columns.to(packed.dtype)[:, None] - x)[:, :, None] + (shear * down)[..., None]
    constant = torch.where(valid[:, :, None], log_opacity, -torch.inf) + rest * down * down
    alpha = (along * along).mul_(square[..., None]).add_(constant[..., None]).exp_().flatten(2)
    alpha = alpha.clamp_max_(MAX_ALPHA).mul_(alpha >= MIN_ALPHA)
    after = _scan(1 - alpha, torch.mul).mul_(transmittance[:, None])
    alive = after >= MIN_TRANSMITTANCE
    remaining = torch.where(alive, after, torch.inf).amin(dim=1)
    before = torch.cat([transmittance[:, None], after[:, :-1]], dim=1).mul_(alive)
    return TileBatch(
        tiles=tiles, entries=entries, valid=valid, params=params, along=along, down=down,
        alpha=alpha, transmittance=before, remaining=remaining,
    )  # fmt: skip


def _scan(
    values: Float[Tensor, "b k q"], combine: Callable[[Tensor, Tensor], Tensor]
) -> Float[Tensor, "b k q"]:
    """Scan along axis 1 by doubling (Hillis and Steele 1986), much faster than ``cumprod``."""
    reach = 1
    while reach < values.shape[1]:
        further = combine(values[:, reach:], values[:, :-reach])
        values = torch.cat([values[:, :reach], further], dim=1)
        reach *= 2
    return values
