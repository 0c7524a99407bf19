"""Losses of a training step: images of whole scenes, of cells in a grid, or of crops of cells."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.cells import Partition
from cvtgs.devices import chunk_length
from cvtgs.evaluation import psnr
from cvtgs.evaluation.scorer import MOST_PSNR, ViewImages
from cvtgs.losses import image_loss, relative_loss
from cvtgs.math import parameters, spherical_harmonics
from cvtgs.math.segments import segment_ids, true_rows
from cvtgs.mergenet import MergeNet, Net, PublishedMergeNet, Residuals
from cvtgs.mergenet.apply import compose_published
from cvtgs.mergenet.published import describe_published
from cvtgs.rendering import contributions, render
from cvtgs.scene import GaussianScene
from cvtgs.train.cases import Case, MergedScene
from cvtgs.train.config import LossConfig, TrainConfig

LEAST_PAINTED = 0.02  # contribution from which a step corrects a cell, pixels
CHUNK_MEMBERS = 1 << 16  # members and neighbours per chunk of the network in a step
BLACK_SHARE = 0.5  # share of the images of whole scenes that have a black background
TILE = 32  # side of a tile, which shows one cell, pixels
DISTANCE = 50.0  # of the camera in image widths, so large that all cells are projected alike
TILE_WIDTH = 7.0  # in units of the largest standard deviation of its cell, before random zoom


def scene_loss(
    net: MergeNet, case: Case, views: ViewImages, *, config: TrainConfig, rng: random.Random
) -> Float[Tensor, ""]:
    """Compare random crops of images of the scene with its cells in these crops corrected.

    A camera of the crop alone would project Gaussians beside it differently: images are whole.
    """
    shots = [_Shot.draw(views, config.views.crop, case, rng) for _ in range(config.views.per_step)]
    case = case.select(_seen_cells(case, [shot.crop_camera() for shot in shots]))
    case = case.seen_by(views.cameras)
    residuals = _predict(net, case)
    corrected, losses = case.correct_scene(residuals), []
    for shot in shots:
        image = render(corrected, shot.view.cameras, background=shot.background).rgb
        target = shot.view.over(shot.background)
        losses.append(view_loss(shot.crop(image), shot.crop(target), config.loss))
    return torch.stack(losses).mean() + _residual_penalty(residuals, config.loss)


class _Shot(NamedTuple):
    """One image of a step: a view, a background, and the crop that is compared."""

    view: ViewImages
    background: Float[Tensor, "3"]
    rows: slice
    columns: slice

    @classmethod
    def draw(cls, views: ViewImages, side: int, case: Case, rng: random.Random) -> "_Shot":
        background = _background(rng, case)
        view = views.select(_draw_view(views, case, rng))
        last = max(0, view.cameras.width - side)
        top, left = rng.randint(0, last), rng.randint(0, last)
        return cls(view, background, slice(top, top + side), slice(left, left + side))

    def crop(self, images: Float[Tensor, "1 h w 3"]) -> Float[Tensor, "1 y x 3"]:
        return images[:, self.rows, self.columns]

    def crop_camera(self) -> Cameras:
        """Return the camera whose image is the crop, but for Gaussians beside it."""
        camera = self.view.cameras
        offset = torch.zeros_like(camera.Ks)
        offset[:, 0, 2], offset[:, 1, 2] = self.columns.start, self.rows.start
        return replace(
            camera,
            Ks=camera.Ks - offset,
            width=min(self.columns.stop, camera.width) - self.columns.start,
            height=min(self.rows.stop, camera.height) - self.rows.start,
        )


def _draw_view(views: ViewImages, case: Case, rng: random.Random) -> int:
    """Draw an image; of a scene tagged mip, half the time one for viewers that ignore the tag."""
    numbers: Sequence[int] = range(len(views.cameras))
    modes = views.cameras.ignores_tag
    if case.reference.merged.antialiased and len(set(modes)) > 1:
        mode = rng.random() < 0.5
        numbers = [number for number in numbers if modes[number] == mode]
    return rng.choice(numbers)


def _seen_cells(case: Case, cameras: Sequence[Cameras]) -> Int[Tensor, "s"]:
    """Return the cells that paint something in any of some images; all if none does."""
    merged = case.reference.merged
    painted = torch.stack([contributions(merged, camera) for camera in cameras]).amax(dim=0)
    is_seen = painted[case.cells] > LEAST_PAINTED
    return true_rows(is_seen if bool(is_seen.any()) else torch.ones_like(is_seen))


def _predict(net: MergeNet, case: Case) -> Residuals:
    """Predict all residuals in chunks, whose tensors fit the caches of a CPU."""
    near = case.descriptors.pairs.shape[1]
    length = chunk_length(CHUNK_MEMBERS, case.cells.device)
    chunks = case.descriptors.part.chunks(length, cell_cost=near)
    numbers = torch.arange(len(case.cells), device=case.cells.device)
    parts = [net(case.descriptors.select(numbers[run])) for run, _ in chunks]
    return Residuals(
        **{
            field.name: torch.cat([getattr(part, field.name) for part in parts])
            for field in fields(Residuals)
        }
    )


def local_loss(
    net: MergeNet, case: Case, *, config: TrainConfig, rng: random.Random
) -> Float[Tensor, ""]:
    """Compare images of single cells in a grid, members against the corrected Gaussian."""
    number = min(config.cells, len(case.cells))
    drawn = sorted(rng.sample(range(len(case.cells)), number))
    rows = torch.tensor(drawn, device=case.cells.device)
    chosen = case.select(rows)
    residuals: Residuals = net(chosen.descriptors)
    corrected = chosen.correct_cells(residuals)
    grid = lay_out_cells(chosen.reference, chosen.cells, chosen.part, corrected, rng=rng)
    image, target = _render_grid(grid, _random_color(rng, case))
    return view_loss(image, target, config.loss) + _residual_penalty(residuals, config.loss)


def published_loss(
    net: PublishedMergeNet, case: Case, *, config: TrainConfig, rng: random.Random
) -> Float[Tensor, ""]:
    """Compare crops of cells with the corrected Gaussian, as CVT-GS does, in all SH bands."""
    scene, merged, partition = case.reference[:3]
    rows = _draw_cells(partition.counts[case.cells], config, rng)
    cells = case.cells[rows]
    part = partition.select(cells)
    descriptors = describe_published(scene, merged, part, cells=cells)
    corrected = compose_published(merged, cells=cells, residuals=net(descriptors))
    background = _random_color(rng, case)
    grid = lay_out_cells(
        case.reference, cells, part, corrected, rng=rng, tile=config.tile, apart=2, all_bands=True
    )
    images = _render_grid(grid, background)
    return image_loss(*(cut_crops(one, len(rows), config.tile, 2) for one in images))


def _draw_cells(counts: Int[Tensor, "r"], config: TrainConfig, rng: random.Random) -> Tensor:
    """Draw random cells within the limits of cells and members; row numbers ascending."""
    rows = rng.sample(range(len(counts)), min(config.cells, len(counts)))
    drawn = torch.tensor(rows, device=counts.device)
    fitting = counts[drawn].cumsum(0) <= config.members
    if not bool(fitting.any()):  # the first is larger than a step
        return drawn[:1]
    return drawn[fitting].sort().values


def cut_crops(
    image: Float[Tensor, "1 h w 3"], count: int, tile: int, apart: int
) -> Float[Tensor, "m t t 3"]:
    """Cut the tiles of the first ``count`` cells out of the image of a grid."""
    side, step = image.shape[1] // (tile * apart), tile * apart
    grid = image[0].reshape(side, step, side, step, 3).permute(0, 2, 1, 3, 4).flatten(0, 1)
    margin = (step - tile) // 2
    return grid[:count, margin : margin + tile, margin : margin + tile]


def view_loss(
    image: Float[Tensor, "1 h w 3"], target: Float[Tensor, "1 h w 3"], config: LossConfig
) -> Float[Tensor, ""]:
    """Return the loss of an image, without the penalty of residuals."""
    return relative_loss(
        image,
        target,
        mse_weight=config.mse_weight,
        image_weight=config.image_weight,
        ssim_weight=config.ssim_weight,
    )


@torch.no_grad()
def validation_psnr(net: Net, case: Case, views: ViewImages) -> tuple[float, float]:
    """Return the mean PSNR over grey without and with the network, dB; at most MOST_PSNR each."""
    merged = case.reference.merged
    grey = merged.means.new_full((3,), 0.5)
    target = views.over(grey)
    before, after = (
        psnr(render(scene, views.cameras, background=grey).rgb, target).clamp(max=MOST_PSNR)
        for scene in (merged, case.seen_by(views.cameras).correct_by(net))
    )
    return float(before.mean()), float(after.mean())


def _residual_penalty(residuals: Residuals, config: LossConfig) -> Float[Tensor, ""]:
    if not config.residual_weight:
        return residuals.d_logit_opacities.new_zeros(())
    return config.residual_weight * residuals.cost()


def _background(rng: random.Random, case: Case) -> Float[Tensor, "3"]:
    """Return a random colour, or black: most viewers have it, and it shows faint haze best."""
    color = _random_color(rng, case)
    return color * 0.0 if rng.random() < BLACK_SHARE else color


def _random_color(rng: random.Random, case: Case) -> Float[Tensor, "3"]:
    return case.reference.merged.means.new_tensor([rng.random() for _ in range(3)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellGrid:
    """Cells side by side in the tiles of one image, before and after merging."""

    members: GaussianScene
    corrected: GaussianScene
    camera: Cameras


def lay_out_cells(
    reference: MergedScene,
    cells: Int[Tensor, "m"],
    part: Partition,
    corrected: dict[str, Tensor],
    *,
    rng: random.Random,
    tile: int = TILE,
    apart: int = 1,
    all_bands: bool = False,
) -> CellGrid:
    """Put cells in the tiles of a grid, each rotated, zoomed and shifted at random.

    Tiles are ``tile`` pixels wide; their centres are ``apart`` tile widths apart.
    """
    side = math.ceil(math.sqrt(len(cells)))
    merged = reference.merged.select(cells)
    placement = _Placement.draw(merged, side, rng, apart)
    ids = segment_ids(part.offsets, len(part.order))
    own = torch.arange(len(cells), device=ids.device)
    members = reference.scene.select(part.order).tensors()
    return CellGrid(
        members=placement.apply(members, ids, all_bands=all_bands),
        corrected=placement.apply(corrected, own, all_bands=all_bands),
        camera=_grid_camera(side * apart, merged.means, tile),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Placement:
    """Rotation, zoom and position of each cell; the side of a tile is one unit."""

    centers: Float[Tensor, "m 3"]
    quats: Float[Tensor, "m 4"]
    zooms: Float[Tensor, "m"]
    positions: Float[Tensor, "m 3"]

    @classmethod
    def draw(cls, merged: GaussianScene, side: int, rng: random.Random, apart: int) -> "_Placement":
        count = len(merged)
        generator = torch.Generator().manual_seed(rng.getrandbits(62))
        quats = torch.randn(count, 4, generator=generator, dtype=torch.float32)
        draws = torch.rand(count, 3, generator=generator, dtype=torch.float32)
        tiles = torch.arange(count)
        grid = torch.stack([tiles % side, tiles // side], dim=1)
        flat = apart * (grid + 0.5 - side / 2) + 0.3 * (draws[:, :2] - 0.5)
        positions = torch.nn.functional.pad(flat, (0, 1))
        zooms = torch.exp(math.log(2.0) * (draws[:, 2] - 0.5)) / TILE_WIDTH
        drawn = [parameters.normalize_quats(quats), zooms[:, None], positions]
        turns, sizes, places = torch.cat(drawn, dim=1).to(merged.means).split([4, 1, 3], dim=1)
        return cls(
            centers=merged.means,
            quats=turns,
            zooms=sizes[:, 0] / merged.scales.amax(dim=1),
            positions=places,
        )

    def apply(
        self, tensors: dict[str, Tensor], ids: Int[Tensor, "n"], *, all_bands: bool
    ) -> GaussianScene:
        quats, zooms = self.quats[ids], self.zooms[ids]
        local = (tensors["means"] - self.centers[ids]) * zooms[:, None]
        rotations = parameters.quats_to_matrices(quats)
        rotated = torch.einsum("nij,nj->ni", rotations, local)
        sh0 = tensors["sh0"]
        if all_bands and tensors["shN"].shape[1]:
            # The camera looks along z; in the frame of the scene, that is the last row.
            colors = spherical_harmonics.evaluate(sh0, tensors["shN"], rotations[:, 2])
            sh0 = ((colors - 0.5) / spherical_harmonics.SH_C0)[:, None]
        return GaussianScene(
            means=rotated + self.positions[ids],
            quats=parameters.multiply_quats(quats, parameters.normalize_quats(tensors["quats"])),
            log_scales=tensors["log_scales"] + torch.log(zooms)[:, None],
            logit_opacities=tensors["logit_opacities"],
            sh0=sh0,
            shN=sh0[:, :0],
        )


def _render_grid(grid: CellGrid, background: Float[Tensor, "3"]) -> tuple[Tensor, Tensor]:
    """Return the image of the corrected Gaussians, and that of the members without gradients."""
    with torch.no_grad():
        target = render(grid.members, grid.camera, background=background).rgb
    return render(grid.corrected, grid.camera, background=background).rgb, target


def _grid_camera(side: int, like: Tensor, tile: int) -> Cameras:
    distance, pixels = DISTANCE * side, tile * side
    viewmats = torch.eye(4)[None]
    viewmats[:, 2, 3] = distance
    focal, middle = tile * distance, pixels / 2
    intrinsics = torch.tensor([[[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]]])
    return Cameras(viewmats=viewmats.to(like), Ks=intrinsics.to(like), width=pixels, height=pixels)
