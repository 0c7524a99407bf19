"""Project Gaussians onto an image, in differentiable torch operations, by the rules of 3DGS."""

from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters, spherical_harmonics
from cvtgs.scene import GaussianScene

# The numbers of the rasterizer of 3DGS (Kerbl et al. 2023, section 6 and their renderer).

NEAR_PLANE = 0.01
"""Gaussians whose centre is nearer to the camera's plane are not rendered; scene units."""

DILATION = 0.3
"""Variance that every projected Gaussian gains, squared pixels."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is taken no farther outside the image than this share of half its size."""

MAX_ALPHA = 0.99
"""No single Gaussian hides more than this."""

MIN_ALPHA = 1 / 255
"""What would hide less than this is skipped."""

MIN_TRANSMITTANCE = 1e-4
"""A pixel is finished before the Gaussian that would let less light than this through."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pinhole:
    """A pinhole camera as plain numbers, so that projection is arithmetic only.

    Attributes:
        rotation: Rows of the linear part of the view matrix.
        center: Position of the camera in the world.
        focal: Focal lengths along x and y, pixels.
        principal: Principal point, pixels.
        size: Width and height, pixels.
        dilation: Variance that every projected Gaussian gains, squared pixels.
    """

    rotation: tuple[tuple[float, float, float], ...]
    center: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    dilation: float = DILATION

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


class CameraTensors(NamedTuple):
    """Numbers of a camera beside the Gaussians that it sees; bounds are those of ``slopes``."""

    rotation: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    focal: Float[Tensor, "2"]
    principal: Float[Tensor, "2"]
    low: Float[Tensor, "2"]
    high: Float[Tensor, "2"]

    @classmethod
    def of(cls, camera: Pinhole, like: Tensor) -> "CameraTensors":
        """Return the numbers in the dtype of a tensor, the centre in float64; one copy for all."""
        low, high = zip(*camera.slopes, strict=True)
        numbers = *camera.center, *chain(*camera.rotation), *camera.focal, *camera.principal
        table = torch.tensor([*numbers, *low, *high], dtype=torch.float64, device=like.device)
        rotation, *pairs = table[3:].to(like.dtype).split([9, 2, 2, 2, 2])
        return cls(rotation.view(3, 3), table[:3], *pairs)


def to_pinholes(cameras: Cameras) -> list[Pinhole]:
    """Return plain numbers of each camera, after checks."""
    both = cameras.viewmats.flatten(1).double(), cameras.Ks.flatten(1).double()
    table = torch.cat(both, dim=1).detach().cpu()
    viewmats, Ks = table[:, :16].view(-1, 4, 4), table[:, 16:].view(-1, 3, 3)  # noqa: N806 (as gsplat)
    _check(viewmats, Ks)
    centers = -torch.linalg.solve(viewmats[:, :3, :3], viewmats[:, :3, 3:])[:, :, 0]
    return [
        Pinhole(
            rotation=tuple((row[0], row[1], row[2]) for row in viewmat[:3]),
            center=(center[0], center[1], center[2]),
            focal=(K[0][0], K[1][1]),
            principal=(K[0][2], K[1][2]),
            size=(cameras.width, cameras.height),
            dilation=DILATION / cameras.stride**2,
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splats:
    """Gaussians as they lie in one image, front to back.

    With ``(u, v)`` the way from the centre to a pixel, the squared distance in standard deviations
    is ``steep (u + shear v)^2 + flat v^2``. That is the conic of 3DGS, ``A u^2 + 2 B u v + C v^2``,
    as ``L D L^T``: it is never negative and keeps its digits for needles of any length.

    Attributes:
        rows: ``(m,)`` which Gaussian of the scene each is.
        centers: ``(m, 2)`` pixels.
        ellipses: ``(m, 3)`` steep, shear, flat; per squared pixel, one, per squared pixel.
        opacities: ``(m,)`` at the centre, above 1/255.
        colors: ``(m, 3)`` red, green, blue, at least 0.
        depths: ``(m,)`` along the view axis, scene units, ascending.
    """

    rows: Int[Tensor, "m"]
    centers: Float[Tensor, "m 2"]
    ellipses: Float[Tensor, "m 3"]
    opacities: Float[Tensor, "m"]
    colors: Float[Tensor, "m 3"]
    depths: Float[Tensor, "m"]


def project(scene: GaussianScene, camera: Pinhole, sh_degree: int) -> Splats:
    """Project a scene: EWA splatting (Zwicker et al. 2001) by the rules of 3DGS.

    The covariance is ``M M^T + 0.3 I`` with ``M = J W R S``; its determinant comes from the minors
    of ``M`` (Cauchy-Binet), which needs no difference of large numbers. Gaussians behind the near
    plane, outside the image, too faint, or with values that are not finite, are left out.

    Memory with gradients: about ``(150 + 6 k) n`` numbers for n Gaussians in view with k rest
    coefficients.
    """
    beside = CameraTensors.of(camera, scene.means)
    rows = _candidates(scene, camera, beside)
    offsets = _offsets(scene.means.index_select(0, rows), beside)
    local = offsets @ beside.rotation.T
    axes = _image_axes(scene, rows, local, beside)
    ellipses, survival = _ellipses(axes, camera.dilation)
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, rows))
    if scene.antialiased:
        opacities = opacities * survival
    slopes = local[:, :2] / local[:, 2:]
    centers = slopes * beside.focal + beside.principal
    order = _front_to_back(centers, ellipses, opacities, local[:, 2], camera)
    return Splats(
        rows=rows[order],
        centers=centers[order],
        ellipses=ellipses[order],
        opacities=opacities[order],
        colors=_colors(scene, rows[order], offsets[order], sh_degree),
        depths=local[:, 2][order],
    )


def pack(splats: Splats) -> Float[Tensor, "m 10"]:
    """Return what compositing needs of each splat, side by side."""
    steep, shear, flat = splats.ellipses.unbind(1)
    columns = [-0.5 * steep, shear, -0.5 * flat, parameters.positive_log(splats.opacities)]
    exponents = torch.stack(columns, dim=1)
    return torch.cat([splats.centers, exponents, splats.colors, splats.depths[:, None]], dim=1)


@torch.no_grad()
def reach_of(opacities: Float[Tensor, "m"]) -> Float[Tensor, "m"]:
    """Return how far Gaussians reach: the squared distance at which alpha falls to 1/255."""
    return (2 * parameters.positive_log(opacities / MIN_ALPHA)).clamp_min(0)


@torch.no_grad()
def half_sizes(
    ellipses: Float[Tensor, "m 3"], reach: Float[Tensor, "m"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Return half the width and height of the boxes around ellipses."""
    steep, shear, flat = ellipses.unbind(1)
    return (reach / steep + reach * shear * shear / flat).sqrt(), (reach / flat).sqrt()


def _offsets(means: Float[Tensor, "n 3"], beside: CameraTensors) -> Float[Tensor, "n 3"]:
    """Return ways from the camera; far from the origin float32 holds them, but not the camera."""
    return (means.double() - beside.center).to(means.dtype)


@torch.no_grad()
def _candidates(scene: GaussianScene, camera: Pinhole, beside: CameraTensors) -> Tensor:
    """Return the rows whose bounding ball touches the image, without faint and invalid ones."""
    rotation = beside.rotation
    x, y, z = (_offsets(scene.means, beside) @ rotation.T).unbind(1)
    steepest = sum(max(abs(low), abs(high)) ** 2 for low, high in camera.slopes)
    stretch = rotation.norm() * max(camera.focal) * (1 + steepest) ** 0.5 / z
    deviation = stretch * scene.log_scales.amax(dim=1).exp()
    # 3.33 standard deviations is where even an opacity of 1 falls to 1/255.
    radius = 3.34 * deviation + 3.34 * camera.dilation**0.5
    quats = scene.quats.abs().amax(dim=1)
    # The squares of larger ones would overflow.
    keep: Tensor = deviation < torch.finfo(scene.dtype).max ** 0.5 / 4
    keep &= (z >= NEAR_PLANE) & torch.isfinite(z) & torch.isfinite(quats) & (quats > 0)
    for way, focal, principal, size in zip(
        (x, y), camera.focal, camera.principal, camera.size, strict=True
    ):
        place = way / z * focal + principal
        keep &= (place + radius > 0) & (place - radius < size)
    keep &= parameters.opacity_from_logit(scene.logit_opacities) >= MIN_ALPHA
    return keep.nonzero()[:, 0]


def _image_axes(
    scene: GaussianScene, rows: Tensor, local: Tensor, beside: CameraTensors
) -> Float[Tensor, "m 2 3"]:
    """Return ``M = J W R S``: the own axes of each Gaussian, to first order in the image."""
    quats = parameters.normalize_quats(scene.quats.index_select(0, rows))
    turned = beside.rotation @ parameters.quats_to_matrices(quats)
    slopes = torch.minimum(torch.maximum(local[:, :2] / local[:, 2:], beside.low), beside.high)
    stretch = beside.focal / local[:, 2:]
    jacobian = stretch[:, :, None] * (turned[:, :2] - slopes[:, :, None] * turned[:, 2:])
    return jacobian * torch.exp(scene.log_scales.index_select(0, rows))[:, None, :]


def _ellipses(axes: Float[Tensor, "m 2 3"], dilation: float) -> tuple[Tensor, Tensor]:
    """Return ellipses, and what share of its opacity an antialiased Gaussian keeps.

    With the covariance ``(a b; b d)``: steep is ``d / det``, shear ``-b / d``, flat ``1 / d``.
    Dividing one row of ``M`` by ``sqrt(d)`` first keeps the determinant within float32.
    """
    across, down = axes.unbind(1)
    bare_a = (across * across).sum(dim=1)
    d = (down * down).sum(dim=1) + dilation
    b = (across * down).sum(dim=1)
    minors = torch.linalg.cross(across, down / d.sqrt()[:, None])
    bare = (minors * minors).sum(dim=1)
    schur = bare + dilation * (bare_a + d) / d
    survival = (bare / schur).clamp_min(MIN_ALPHA**2 / 4).sqrt()
    return torch.stack([1 / schur, -b / d, 1 / d], dim=1), survival


@torch.no_grad()
def _front_to_back(
    centers: Tensor, ellipses: Tensor, opacities: Tensor, depths: Tensor, camera: Pinhole
) -> Tensor:
    """Order what touches the image by depth."""
    keep = (opacities >= MIN_ALPHA) & torch.isfinite(ellipses).all(dim=1)
    halves = half_sizes(ellipses, reach_of(opacities))
    for place, half, size in zip(centers.unbind(1), halves, camera.size, strict=True):
        keep &= (place + half >= 0) & (place - half <= size)
    touching = keep.nonzero()[:, 0]
    return touching[torch.sort(depths[touching], stable=True).indices]


def _colors(scene: GaussianScene, rows: Tensor, offsets: Tensor, sh_degree: int) -> Tensor:
    sh0 = scene.sh0.index_select(0, rows)
    count = spherical_harmonics.REST_COUNTS[sh_degree]
    if not count:
        return spherical_harmonics.evaluate(sh0, scene.shN.new_zeros(len(rows), 0, 3), offsets)
    directions = torch.nn.functional.normalize(offsets, dim=1)
    shN = scene.shN[:, :count].index_select(0, rows)  # noqa: N806
    return spherical_harmonics.evaluate(sh0, shN, directions)
