"""One camera as the renderer uses it: plain numbers, so that projecting is arithmetic only."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.rendering.rules import FRUSTUM_MARGIN


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A pinhole camera.

    Attributes:
        rotation: Rows of the linear part of the view matrix.
        center: Position of the camera in the world.
        focal: Focal lengths along x and y, pixels.
        principal: Principal point, pixels.
        size: Width and height, pixels.
    """

    rotation: tuple[tuple[float, float, float], ...]
    center: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]

    @property
    def slopes(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Bounds of x/z and of y/z, within which the Jacobian of the projection is taken.

        With the principal point in the middle they are 1.3 times the tangent of half the field of
        view, as in 3DGS; elsewhere they move with the edges of the image, as in gsplat.
        """
        (x_low, x_high), (y_low, y_high) = (
            (
                -principal / focal - FRUSTUM_MARGIN * 0.5 * size / focal,
                (size - principal) / focal + FRUSTUM_MARGIN * 0.5 * size / focal,
            )
            for focal, principal, size in zip(self.focal, self.principal, self.size, strict=True)
        )
        return (x_low, x_high), (y_low, y_high)


def views_of(cameras: Cameras) -> list[View]:
    """Turn cameras into views."""
    viewmats = cameras.viewmats.detach().double().cpu()
    Ks = cameras.Ks.detach().double().cpu()  # noqa: N806 (the name that gsplat gives it)
    _check(viewmats, Ks)
    centers = -torch.linalg.solve(viewmats[:, :3, :3], viewmats[:, :3, 3:])[:, :, 0]
    return [
        View(
            rotation=tuple((row[0], row[1], row[2]) for row in viewmat[:3]),
            center=(center[0], center[1], center[2]),
            focal=(K[0][0], K[1][1]),
            principal=(K[0][2], K[1][2]),
            size=(cameras.width, cameras.height),
        )
        for viewmat, center, K in zip(viewmats.tolist(), centers.tolist(), Ks.tolist(), strict=True)
    ]


def _check(viewmats: Tensor, Ks: Tensor) -> None:  # noqa: N803 (the name that gsplat gives it)
    finite = torch.isfinite(viewmats).all(dim=(1, 2)) & torch.isfinite(Ks).all(dim=(1, 2))
    upright = torch.linalg.det(viewmats[:, :3, :3]).abs() > 0
    pinhole = (Ks[:, 0, 0] > 0) & (Ks[:, 1, 1] > 0) & (Ks[:, 0, 1] == 0) & (Ks[:, 1, 0] == 0)
    for good, wish in (
        (finite, "finite viewmats and Ks"),
        (upright, "viewmats that have an inverse"),
        (pinhole, "Ks of pinhole cameras, focal lengths above 0 and no skew"),
    ):
        bad = (~good).nonzero()[:, 0].tolist()
        if bad:
            raise InvalidArgumentError(
                f"cameras must have {wish}; {len(bad)} of {len(good)} have not, "
                f"the first is camera {bad[0]}."
            )
