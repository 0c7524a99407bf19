"""Losses of a training step: images of whole scenes, or of single cells in a grid."""

import math
import random
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.evaluation import psnr
from cvtgs.losses import relative_loss
from cvtgs.math import parameters
from cvtgs.math.segments import segment_ids
from cvtgs.mergenet import MergeNet, Residuals
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.train.cases import Case, TargetViews
from cvtgs.train.config import LossConfig, TrainConfig

TILE = 32
"""Pixels of the side of a tile, which shows one cell."""

DISTANCE = 50.0
"""Distance of the camera in image widths, so far that all cells are projected alike."""

TILE_WIDTH = 7.0
"""Width of a tile in largest standard deviations of its cell, before the random zoom."""


def scene_loss(
    net: MergeNet, case: Case, views: TargetViews, *, config: TrainConfig, rng: random.Random
) -> Float[Tensor, ""]:
    """Compare random crops of images of the corrected scene, each over a random background.

    Whole images are rendered: a camera that sees the crop only would project Gaussians beside it
    differently.
    """
    residuals: Residuals = net(case.descriptors)
    corrected = case.correct_scene(residuals)
    losses = []
    for _ in range(config.views.per_step):
        background = _random_color(rng, case)
        view = views.select(rng.randrange(len(views.cameras)))
        last = max(0, view.cameras.width - config.views.crop)
        top, left = rng.randint(0, last), rng.randint(0, last)
        y, x = (slice(start, start + config.views.crop) for start in (top, left))
        image = render(corrected, view.cameras, background=background).rgb
        target = view.over(background)
        losses.append(view_loss(image[:, y, x], target[:, y, x], config.loss))
    return torch.stack(losses).mean() + _residual_penalty(residuals, config.loss)


def local_loss(
    net: MergeNet, case: Case, *, config: TrainConfig, rng: random.Random
) -> Float[Tensor, ""]:
    """Compare images of single cells in a grid: members against the corrected Gaussian."""
    number = min(config.cells, len(case.cells))
    rows = torch.tensor(sorted(rng.sample(range(len(case.cells)), number)))
    chosen = case.select(rows)
    residuals: Residuals = net(chosen.descriptors)
    grid = lay_out_cells(chosen, chosen.correct_cells(residuals), rng=rng)
    background = _random_color(rng, case)
    with torch.no_grad():
        target = render(grid.members, grid.camera, background=background).rgb
    image = render(grid.corrected, grid.camera, background=background).rgb
    return view_loss(image, target, config.loss) + _residual_penalty(residuals, config.loss)


def view_loss(
    image: Float[Tensor, "1 h w 3"], target: Float[Tensor, "1 h w 3"], config: LossConfig
) -> Float[Tensor, ""]:
    """Return the loss of an image, without the penalty of residuals."""
    return relative_loss(
        image,
        target,
        squared_weight=config.mse_weight,
        image_weight=config.image_weight,
        ssim_weight=config.ssim_weight,
    )


@torch.no_grad()
def validation_psnr(net: MergeNet, case: Case, views: TargetViews) -> tuple[float, float]:
    """Return the mean PSNR over grey without and with the network, in decibels."""
    merged = case.reference.merged
    grey = merged.means.new_full((3,), 0.5)
    target = views.over(grey)
    before, after = (
        float(psnr(render(scene, views.cameras, background=grey).rgb, target).mean())
        for scene in (merged, case.correct_scene(net(case.descriptors)))
    )
    return before, after


def _residual_penalty(residuals: Residuals, config: LossConfig) -> Float[Tensor, ""]:
    if not config.residual_weight:
        return residuals.d_logit_opacities.new_zeros(())
    return config.residual_weight * residuals.cost()


def _random_color(rng: random.Random, case: Case) -> Float[Tensor, "3"]:
    return case.reference.merged.means.new_tensor([rng.random() for _ in range(3)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellGrid:
    """Cells side by side in the tiles of one image.

    Attributes:
        members: All members.
        merged: The merged Gaussians.
        corrected: The corrected ones.
        camera: Camera that sees all of them.
    """

    members: GaussianScene
    merged: GaussianScene
    corrected: GaussianScene
    camera: Cameras


def lay_out_cells(case: Case, corrected: dict[str, Tensor], *, rng: random.Random) -> CellGrid:
    """Put cells in the tiles of a grid, each rotated, zoomed and shifted at random.

    Colours are those of the constant band: the network mixes all bands alike.
    """
    reference, count = case.reference, len(case.cells)
    side = math.ceil(math.sqrt(count))
    merged = reference.merged.select(case.cells)
    placement = _Placement.draw(merged, side, rng)
    ids = segment_ids(case.part.offsets, len(case.part.order))
    members = reference.scene.select(case.part.order)
    own = torch.arange(count, device=ids.device)
    return CellGrid(
        members=placement.apply(members.tensors(), ids),
        merged=placement.apply(merged.tensors(), own),
        corrected=placement.apply(corrected, own),
        camera=_grid_camera(side, merged.means),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Placement:
    """Rotation, zoom and position of each cell; the side of a tile is one unit."""

    centers: Float[Tensor, "m 3"]
    quats: Float[Tensor, "m 4"]
    zooms: Float[Tensor, "m"]
    positions: Float[Tensor, "m 3"]

    @classmethod
    def draw(cls, merged: GaussianScene, side: int, rng: random.Random) -> "_Placement":
        count = len(merged)
        generator = torch.Generator().manual_seed(rng.getrandbits(62))
        quats = torch.randn(count, 4, generator=generator)
        draws = torch.rand(count, 3, generator=generator)
        tiles = torch.arange(count)
        positions = torch.stack(
            [
                tiles % side + 0.5 - side / 2 + 0.3 * (draws[:, 0] - 0.5),
                tiles // side + 0.5 - side / 2 + 0.3 * (draws[:, 1] - 0.5),
                torch.zeros(count),
            ],
            dim=1,
        )
        zooms = torch.exp(math.log(2.0) * (draws[:, 2] - 0.5)) / TILE_WIDTH
        like = merged.means
        return cls(
            centers=merged.means,
            quats=parameters.normalize_quats(quats).to(like),
            zooms=zooms.to(like) / merged.scales.amax(dim=1),
            positions=positions.to(like),
        )

    def apply(self, tensors: dict[str, Tensor], ids: Int[Tensor, "n"]) -> GaussianScene:
        quats, zooms = self.quats[ids], self.zooms[ids]
        local = (tensors["means"] - self.centers[ids]) * zooms[:, None]
        rotated = torch.einsum("nij,nj->ni", parameters.quats_to_matrices(quats), local)
        return GaussianScene(
            means=rotated + self.positions[ids],
            quats=parameters.multiply_quats(quats, parameters.normalize_quats(tensors["quats"])),
            log_scales=tensors["log_scales"] + torch.log(zooms)[:, None],
            logit_opacities=tensors["logit_opacities"],
            sh0=tensors["sh0"],
            shN=tensors["sh0"][:, :0],
        )


def _grid_camera(side: int, like: Tensor) -> Cameras:
    distance, pixels = DISTANCE * side, TILE * side
    viewmats = torch.eye(4)[None]
    viewmats[:, 2, 3] = distance
    focal, middle = TILE * distance, pixels / 2
    intrinsics = torch.tensor([[[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]]])
    return Cameras(viewmats=viewmats.to(like), Ks=intrinsics.to(like), width=pixels, height=pixels)
