"""Crops: cells side by side in one image, each alone, turned, and cut at random."""

import math
import random
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.math import parameters
from cvtgs.math.segments import segment_ids
from cvtgs.scene import GaussianScene
from cvtgs.train.cases import Case

TILE = 32
"""Pixels of a crop's side."""

FAR = 50.0
"""The camera is this many image widths away, so that all cells are seen alike."""

WIDEST = 7.0
"""A crop is this many of the largest standard deviations wide, before the random zoom."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crops:
    """Some cells side by side.

    Attributes:
        members: All members.
        merged: The merged Gaussians.
        corrected: The corrected ones.
        camera: Sees all of them.
    """

    members: GaussianScene
    merged: GaussianScene
    corrected: GaussianScene
    camera: Cameras


def crop_cells(case: Case, changed: dict[str, Tensor], *, dice: random.Random) -> Crops:
    """Lay cells side by side, each turned and zoomed at random and somewhat off the middle.

    Colours are those of the constant band: the network mixes all bands alike.
    """
    reference, count = case.reference, len(case.cells)
    side = math.ceil(math.sqrt(count))
    merged = reference.merged.select(case.cells)
    layout = _Layout.drawn(merged, side, dice)
    ids = segment_ids(case.part.offsets)
    members = reference.scene.select(case.part.order)
    return Crops(
        members=layout.place(members.tensors(), ids),
        merged=layout.place(merged.tensors(), torch.arange(count, device=ids.device)),
        corrected=layout.place(changed, torch.arange(count, device=ids.device)),
        camera=_camera(side, merged.means),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layout:
    """Where each cell comes to lie; a crop's side is one unit."""

    centers: Float[Tensor, "m 3"]
    turns: Float[Tensor, "m 4"]
    zooms: Float[Tensor, "m"]
    places: Float[Tensor, "m 3"]

    @classmethod
    def drawn(cls, merged: GaussianScene, side: int, dice: random.Random) -> "_Layout":
        count = len(merged)
        generator = torch.Generator().manual_seed(dice.getrandbits(62))
        turns = torch.randn(count, 4, generator=generator)
        draws = torch.rand(count, 3, generator=generator)
        numbers = torch.arange(count)
        places = torch.stack(
            [
                numbers % side + 0.5 - side / 2 + 0.3 * (draws[:, 0] - 0.5),
                numbers // side + 0.5 - side / 2 + 0.3 * (draws[:, 1] - 0.5),
                torch.zeros(count),
            ],
            dim=1,
        )
        zooms = torch.exp(math.log(2.0) * (draws[:, 2] - 0.5)) / WIDEST
        like = merged.means
        return cls(
            centers=merged.means,
            turns=parameters.normalize_quats(turns).to(like),
            zooms=zooms.to(like) / merged.scales.amax(dim=1),
            places=places.to(like),
        )

    def place(self, tensors: dict[str, Tensor], ids: Int[Tensor, "n"]) -> GaussianScene:
        turns, zooms = self.turns[ids], self.zooms[ids]
        local = (tensors["means"] - self.centers[ids]) * zooms[:, None]
        turned = torch.einsum("nij,nj->ni", parameters.quats_to_matrices(turns), local)
        return GaussianScene(
            means=turned + self.places[ids],
            quats=parameters.multiply_quats(turns, parameters.normalize_quats(tensors["quats"])),
            log_scales=tensors["log_scales"] + torch.log(zooms)[:, None],
            logit_opacities=tensors["logit_opacities"],
            sh0=tensors["sh0"],
            shN=tensors["sh0"][:, :0],
        )


def _camera(side: int, like: Tensor) -> Cameras:
    distance, pixels = FAR * side, TILE * side
    viewmats = torch.eye(4)[None]
    viewmats[:, 2, 3] = distance
    focal, middle = TILE * distance, pixels / 2
    intrinsics = torch.tensor([[[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]]])
    return Cameras(viewmats=viewmats.to(like), Ks=intrinsics.to(like), width=pixels, height=pixels)
