"""Composite the splats of tiles front to back, many tiles at a time, and its gradient."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.math import segments
from cvtgs.rendering.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from cvtgs.rendering.tiles import TileLists

CELLS = {"cpu": 1 << 18}
"""Pairs of splat and pixel in one step, by type of device: few stay in a CPU's caches."""

_CELLS_ELSEWHERE = 1 << 23

_DEPTH = 32
"""Splats of each tile in one step."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """The next splats of some tiles, and what they do to the tiles' pixels.

    Attributes:
        tiles: ``(b,)`` numbers of the tiles.
        entries: ``(b, k)`` places in the lists; any place where there is none.
        real: ``(b, k)`` whether there is one.
        params: ``(b, k, 10)`` packed splats.
        along: ``(b, k, s, s)`` sheared way along x from the centre, pixels.
        down: ``(b, k, s)`` way along y from the centre, pixels.
        alpha: ``(b, k, q)`` what each hides of what is behind it, 0 where it is skipped.
        light: ``(b, k, q)`` what light reaches each, 0 where the pixel is finished.
        left: ``(b, q)`` the least light left by a splat that the pixel was not finished before.
    """

    tiles: Int[Tensor, "b"]
    entries: Int[Tensor, "b k"]
    real: Bool[Tensor, "b k"]
    params: Float[Tensor, "b k 10"]
    along: Float[Tensor, "b k s s"]
    down: Float[Tensor, "b k s"]
    alpha: Float[Tensor, "b k q"]
    light: Float[Tensor, "b k q"]
    left: Float[Tensor, "b q"]


def composite(packed: Float[Tensor, "m 10"], lists: TileLists) -> Float[Tensor, "t q 5"]:
    """Composite every tile.

    Memory: the result, and about ten arrays of ``CELLS`` numbers.
    """
    result = packed.new_zeros(len(lists.starts) - 1, lists.side**2, 5)
    result[..., 4] = 1
    for step in _steps(packed, lists):
        weights = step.alpha * step.light
        result[step.tiles, :, :4] += weights.transpose(1, 2) @ step.params[:, :, 6:]
        result[step.tiles, :, 4] = torch.minimum(result[step.tiles, :, 4], step.left)
    return result


def composite_gradient(
    packed: Float[Tensor, "m 10"],
    lists: TileLists,
    result: Float[Tensor, "t q 5"],
    grad: Float[Tensor, "t q 5"],
) -> Float[Tensor, "m 10"]:
    """Return the gradient of :func:`composite`, front to back over the same steps.

    Going forward again gives the same transmittances as before, bit for bit; what lies behind a
    splat is the whole minus what lies in front of it. (3DGS goes backward and divides.)

    Memory: ten numbers per intersection, and about fifteen arrays of ``CELLS`` numbers.
    """
    behind = (result * grad).sum(dim=2)
    per_entry = packed.new_zeros(len(lists.splats), packed.shape[1])
    for step in _steps(packed, lists):
        worth = step.params[:, :, 6:] @ grad[step.tiles, :, :4].transpose(1, 2)
        weights = step.alpha * step.light
        rest = behind[step.tiles][:, None] - _scan(weights * worth, torch.add)
        behind[step.tiles] = rest[:, -1]
        of_alpha = step.light * worth - (step.light > 0) * rest / (1 - step.alpha)
        of_log_alpha = torch.where(step.alpha < MAX_ALPHA, step.alpha * of_alpha, 0)
        columns = [_exponent_gradient(step, of_log_alpha), weights @ grad[step.tiles, :, :4]]
        per_entry[lists.ranks[step.entries[step.real]]] = torch.cat(columns, dim=2)[step.real]
    return segments.segment_sum(per_entry, lists.splat_starts)


def _exponent_gradient(step: Step, of_log_alpha: Float[Tensor, "b k q"]) -> Float[Tensor, "b k 6"]:
    """Pass the gradient of the exponents on to centres, ellipses and log opacities."""
    _, _, square, shear, rest = step.params[:, :, :5].unbind(2)
    per_row = of_log_alpha.unflatten(2, step.along.shape[2:])
    zeroth, moments = per_row.sum(dim=3), per_row * step.along
    first, second = moments.sum(dim=3), (moments * step.along).sum(dim=3)
    along = first.sum(dim=2)
    down = (zeroth * step.down).sum(dim=2)
    columns = [
        -2 * square * along,
        -2 * square * shear * along - 2 * rest * down,
        second.sum(dim=2),
        2 * square * (first * step.down).sum(dim=2),
        (zeroth * step.down * step.down).sum(dim=2),
        zeroth.sum(dim=2),
    ]
    return torch.stack(columns, dim=2)


def _steps(packed: Tensor, lists: TileLists) -> Iterator[Step]:
    """Go through the lists of tiles of similar length together, until all are finished."""
    counts = lists.starts.diff()
    order = torch.sort(counts, descending=True, stable=True).indices
    cells = CELLS.get(packed.device.type, _CELLS_ELSEWHERE)
    size = max(1, cells // (_DEPTH * lists.side**2))
    for group in order[: int((counts > 0).sum())].split(size):
        tiles, start = group, 0
        light = packed.new_ones(len(group), lists.side**2)
        while len(tiles):
            step = _step(packed, lists, tiles, start, light)
            yield step
            start += _DEPTH
            light = _light_after(step)
            going = (light.amax(dim=1) > 0) & (counts[tiles] > start)
            tiles, light = tiles[going], light[going]


def _step(packed: Tensor, lists: TileLists, tiles: Tensor, start: int, light: Tensor) -> Step:
    """Shade the pixels of tiles with their splats number ``start`` and following."""
    places = torch.arange(_DEPTH, device=packed.device) + start + lists.starts[tiles][:, None]
    real = places < lists.starts[tiles + 1][:, None]
    entries = torch.where(real, places, 0)
    params = packed[lists.splats[entries]]
    pixels = torch.arange(lists.side, device=packed.device) + 0.5
    columns = (tiles % lists.across * lists.side)[:, None] + pixels
    rows = (tiles // lists.across * lists.side)[:, None] + pixels
    x, y, square, shear, rest, log_opacity = (
        part[:, :, None] for part in params[..., :6].unbind(2)
    )
    down = rows.to(packed.dtype)[:, None] - y
    along = (columns.to(packed.dtype)[:, None] - x)[:, :, None] + (shear * down)[..., None]
    constant = torch.where(real[:, :, None], log_opacity, -torch.inf) + rest * down * down
    alpha = (along * along).mul_(square[..., None]).add_(constant[..., None]).exp_().flatten(2)
    alpha = alpha.clamp_max_(MAX_ALPHA).mul_(alpha >= MIN_ALPHA)
    after = _scan(1 - alpha, torch.mul).mul_(light[:, None])
    alive = after >= MIN_TRANSMITTANCE
    left = torch.where(alive, after, torch.inf).amin(dim=1)
    before = torch.cat([light[:, None], after[:, :-1]], dim=1).mul_(alive)
    return Step(
        tiles=tiles, entries=entries, real=real, params=params, along=along, down=down,
        alpha=alpha, light=before, left=left,
    )  # fmt: skip


def _light_after(step: Step) -> Float[Tensor, "b q"]:
    """Return the light behind a step, 0 where the pixel is finished."""
    return step.light[:, -1] * (1 - step.alpha[:, -1])


def _scan(
    values: Float[Tensor, "b k q"], combine: Callable[[Tensor, Tensor], Tensor]
) -> Float[Tensor, "b k q"]:
    """Combine each row with all before it, by doubling (Hillis and Steele 1986).

    That is several times faster than ``cumprod`` along an axis that is not the last.
    """
    reach = 1
    while reach < values.shape[1]:
        further = combine(values[:, reach:], values[:, :-reach])
        values = torch.cat([values[:, :reach], further], dim=1)
        reach *= 2
    return values
