"""Project Gaussians onto an image, in differentiable torch operations, by the rules of 3DGS."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.cameras import Cameras, view_scales
from cvtgs.errors import CameraWarning, InvalidArgumentError, warn
from cvtgs.math import parameters, spherical_harmonics
from cvtgs.scene import GaussianScene

# Constants of the 3DGS rasterizer (Kerbl et al. 2023, section 6 and their renderer).

DILATION = 0.3  # variance added to every projected Gaussian, squared pixels
# Slopes in the Jacobian are clamped to the image plus this share of half its size
FRUSTUM_MARGIN = 0.3
MAX_ALPHA = 0.99  # largest alpha of one Gaussian in a pixel
# A pixel is finished before the Gaussian that would lower its transmittance below this
MIN_TRANSMITTANCE = 1e-4
# Entries of the product of a rotation and its transpose may differ from the identity by this, after
# a uniform scale of the view is divided out
SKEW = 1e-3
SAMPLED = 4096  # about how many Gaussians tell how much the near plane hides
# Mean share of the Gaussians before a camera that the near plane may hide. In captures and
# generated scenes with a radius of 0.1 to 4 units, it is 0; where it is larger than this, with a
# radius of about 0.01 units, PSNR changes by 1 dB and more.
MOST_HIDDEN = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Pinhole:
    """A pinhole camera as plain Python numbers."""

    rotation: tuple[tuple[float, float, float], ...]  # rows of the linear part of the view matrix
    center: tuple[float, float, float]  # position in world space
    focal: tuple[float, float]  # along x and y, pixels
    principal: tuple[float, float]  # pixels
    size: tuple[int, int]  # width and height, pixels
    dilation: float  # variance added to every projected Gaussian, squared pixels
    ignores_tag: bool  # whether scenes tagged mip are rendered without compensation

    @property
    def slopes(self) -> list[tuple[float, float]]:
        """Bounds to which x/z and y/z are clamped in the Jacobian of the projection.

        They are those of 3DGS for centred images, and move with the edges of others, as in gsplat.
        """
        return [
            (
                -principal / focal - FRUSTUM_MARGIN * 0.5 * size / focal,
                (size - principal) / focal + FRUSTUM_MARGIN * 0.5 * size / focal,
            )
            for focal, principal, size in zip(self.focal, self.principal, self.size, strict=True)
        ]


class CameraTensors(NamedTuple):
    """A camera as tensors on the scene's device; ``center`` and ``forward`` are float64."""

    rotation: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    forward: Float[Tensor, "3"]
    focal: Float[Tensor, "2"]
    principal: Float[Tensor, "2"]
    low: Float[Tensor, "2"]
    high: Float[Tensor, "2"]

    @classmethod
    def of(cls, camera: Pinhole, like: Tensor) -> "CameraTensors":
        """Convert a camera to the device and dtype of a tensor, in one copy."""
        low, high = zip(*camera.slopes, strict=True)
        numbers = *camera.center, *chain(*camera.rotation), *camera.focal, *camera.principal
        table = torch.tensor([*numbers, *low, *high], dtype=torch.float64, device=like.device)
        rotation, *pairs = table[3:].to(like.dtype).split([9, 2, 2, 2, 2])
        return cls(rotation.view(3, 3), table[:3], table[9:12], *pairs)


def to_matrices(cameras: Cameras) -> tuple[Float[Tensor, "c 4 4"], Float[Tensor, "c 3 3"]]:
    """Check cameras; return view matrices without uniform scales, and intrinsics, on the host."""
    both = cameras.viewmats.flatten(1).double(), cameras.Ks.flatten(1).double()
    table = torch.cat(both, dim=1).detach().cpu()
    viewmats, Ks = table[:, :16].view(-1, 4, 4), table[:, 16:].view(-1, 3, 3)  # noqa: N806 (as gsplat)
    _check(viewmats.numpy(), Ks.numpy())
    viewmats = viewmats.clone()
    viewmats[:, :3] /= view_scales(viewmats)[:, None, None]
    return viewmats, Ks


def to_pinholes(cameras: Cameras) -> list[Pinhole]:
    """Check cameras and convert them to plain numbers."""
    viewmats, Ks = to_matrices(cameras)  # noqa: N806 (as gsplat)
    centers = -torch.linalg.solve(viewmats[:, :3, :3], viewmats[:, :3, 3:])[:, :, 0]
    modes = cameras.ignores_tag or (False,) * len(cameras)
    strides = cameras.strides or (1,) * len(cameras)
    rows = zip(viewmats.tolist(), centers.tolist(), Ks.tolist(), strides, modes, strict=True)
    return [
        Pinhole(
            rotation=tuple((row[0], row[1], row[2]) for row in viewmat[:3]),
            center=(center[0], center[1], center[2]),
            focal=(K[0][0], K[1][1]),
            principal=(K[0][2], K[1][2]),
            size=(cameras.width, cameras.height),
            dilation=DILATION / stride**2,
            ignores_tag=ignores_tag,
        )
        for viewmat, center, K, stride, ignores_tag in rows
    ]


@np.errstate(all="ignore")  # the conditions refuse numbers that are not finite
def _check(viewmats: NDArray[np.float64], Ks: NDArray[np.float64]) -> None:  # noqa: N803
    """Raise unless all cameras are pinhole cameras; numpy is the fastest for few numbers."""
    finite = np.isfinite(viewmats).all(axis=(1, 2)) & np.isfinite(Ks).all(axis=(1, 2))
    rotations = viewmats[:, :3, :3]
    volumes = np.linalg.det(rotations)
    sizes = np.maximum(np.abs(volumes), 1e-30)[:, None, None] ** (2 / 3)
    skews = np.abs(rotations @ rotations.swapaxes(1, 2) / sizes - np.eye(3)).max(axis=(1, 2))
    upright = (skews <= SKEW) & (volumes > 0)
    affine = np.abs(viewmats[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) <= SKEW
    pinhole = (Ks[:, 0, 0] > 0) & (Ks[:, 1, 1] > 0) & (Ks[:, 0, 1] == 0) & (Ks[:, 1, 0] == 0)
    plain = np.abs(Ks[:, 2] - [0.0, 0.0, 1.0]).max(axis=1) <= SKEW
    for good, wish in (
        (finite, "finite viewmats and Ks"),
        (upright, "viewmats that rotate, with at most a uniform scale"),
        (affine, "viewmats with the last row 0, 0, 0, 1"),
        (pinhole, "Ks of pinhole cameras, focal lengths above 0 and no skew"),
        (plain, "Ks with the last row 0, 0, 1"),
    ):
        bad = np.flatnonzero(~good)
        if bad.size:
            raise InvalidArgumentError(
                f"cameras must have {wish}; {bad.size} of {good.size} do not, "
                f"the first is camera {bad[0]}."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splats:
    """Gaussians projected to one image, front to back.

    The conic of 3DGS is ``steep (u + shear v)^2 + flat v^2``: exact for needles, never negative.
    """

    rows: Int[Tensor, "m"]  # row of the Gaussian in the scene
    centers: Float[Tensor, "m 2"]  # pixels
    ellipses: Float[Tensor, "m 3"]  # steep, shear (no unit), flat; in 1 / squared pixels
    opacities: Float[Tensor, "m"]  # at the centre, above 1/255
    colors: Float[Tensor, "m 3"]  # red, green, blue, at least 0
    depths: Float[Tensor, "m"]  # along the view axis, scene units, ascending


def project(scene: GaussianScene, camera: Pinhole, sh_degree: int) -> Splats:
    """Project the Gaussians in view by EWA splatting (Zwicker et al. 2001), as 3DGS does.

    The covariance is ``M M^T + 0.3 I`` with ``M = J W R S``; its determinant comes from the minors
    of ``M`` (Cauchy-Binet), which avoids subtracting large numbers. Memory: with gradients
    ``(150 + 6 k) n`` numbers for n Gaussians in view with k view-dependent SH coefficients.
    """
    beside = CameraTensors.of(camera, scene.means)
    rows = _candidates(scene, camera, beside)
    means = scene.means.index_select(0, rows)
    offsets = _offsets(means, beside)
    local = offsets @ beside.rotation.T
    axes = _image_axes(scene, rows, local, beside)
    ellipses, survival = _ellipses(axes, camera.dilation)
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, rows))
    if scene.antialiased and not camera.ignores_tag:
        opacities = opacities * survival
    slopes = local[:, :2] / local[:, 2:]
    centers = slopes * beside.focal + beside.principal
    order = _front_to_back(centers, ellipses, opacities, _depths(means, beside), camera)
    colors, finite = _colors(scene, rows[order], offsets[order], sh_degree)
    opacities = opacities[order]
    if colors.device.type != "cpu":  # the host would wait to learn how many are left
        opacities = torch.where(finite, opacities, 0)
    elif not bool(finite.all()):
        order, opacities, colors = order[finite], opacities[finite], colors[finite]
    return Splats(
        rows=rows[order],
        centers=centers[order],
        ellipses=ellipses[order],
        opacities=opacities,
        colors=colors,
        depths=local[:, 2][order],
    )


def pack(splats: Splats) -> Float[Tensor, "m 10"]:
    """Return x, y, -steep/2, shear, -flat/2, log opacity, red, green, blue, depth of each splat."""
    steep, shear, flat = splats.ellipses.unbind(1)
    columns = [-0.5 * steep, shear, -0.5 * flat, parameters.positive_log(splats.opacities)]
    exponents = torch.stack(columns, dim=1)
    return torch.cat([splats.centers, exponents, splats.colors, splats.depths[:, None]], dim=1)


@torch.no_grad()
def reach_of(opacities: Float[Tensor, "m"]) -> Float[Tensor, "m"]:
    """Return the squared Mahalanobis distance at which alpha falls to 1/255."""
    return (2 * parameters.positive_log(opacities / parameters.MIN_ALPHA)).clamp_min(0)


@torch.no_grad()
def half_sizes(
    ellipses: Float[Tensor, "m 3"], reach: Float[Tensor, "m"]
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Return half the width and half the height of the bounding boxes of ellipses, pixels."""
    steep, shear, flat = ellipses.unbind(1)
    return (reach / steep + reach * shear * shear / flat).sqrt(), (reach / flat).sqrt()


def _offsets(means: Float[Tensor, "n 3"], beside: CameraTensors) -> Float[Tensor, "n 3"]:
    """Return offsets from the camera, whose position float32 cannot hold far from the origin."""
    return (means.double() - beside.center).to(means.dtype)


@torch.no_grad()
def _depths(means: Float[Tensor, "n 3"], beside: CameraTensors) -> Float[Tensor, "n"]:
    """Return depths to sort by; in float32, different ones would often be equal."""
    return ((means.double() - beside.center) * beside.forward).sum(dim=1)


@torch.no_grad()
def _candidates(scene: GaussianScene, camera: Pinhole, beside: CameraTensors) -> Tensor:
    """Return the rows whose bounding sphere touches the image, except faint and invalid ones."""
    rotation = beside.rotation
    x, y, z = (_offsets(scene.means, beside) @ rotation.T).unbind(1)
    steepest = sum(max(abs(low), abs(high)) ** 2 for low, high in camera.slopes)
    stretch = rotation.norm() * max(camera.focal) * (1 + steepest) ** 0.5 / z
    largest = scene.log_scales.amax(dim=1).exp()
    # At 3.33 standard deviations even an opacity of 1 falls to 1/255.
    radius = 3.34 * stretch * largest + 3.34 * camera.dilation**0.5
    quats = scene.quats.abs().amax(dim=1)
    keep: Tensor = torch.isfinite(largest) & torch.isfinite(quats) & (quats > 0)
    keep &= (z >= parameters.NEAR_PLANE) & torch.isfinite(z)
    for way, focal, principal, size in zip(
        (x, y), camera.focal, camera.principal, camera.size, strict=True
    ):
        place = way / z * focal + principal
        keep &= (place + radius > 0) & (place - radius < size)
    keep &= parameters.opacity_from_logit(scene.logit_opacities) >= parameters.MIN_ALPHA
    return keep.nonzero()[:, 0]


def _image_axes(
    scene: GaussianScene, rows: Tensor, local: Tensor, beside: CameraTensors
) -> Float[Tensor, "m 2 3"]:
    """Return ``M = J W R S``: the axes of each Gaussian projected to first order."""
    quats = parameters.normalize_quats(scene.quats.index_select(0, rows))
    turned = beside.rotation @ parameters.quats_to_matrices(quats)
    slopes = torch.minimum(torch.maximum(local[:, :2] / local[:, 2:], beside.low), beside.high)
    stretch = beside.focal / local[:, 2:]
    jacobian = stretch[:, :, None] * (turned[:, :2] - slopes[:, :, None] * turned[:, 2:])
    axes = jacobian * torch.exp(scene.log_scales.index_select(0, rows))[:, None, :]
    longest = torch.finfo(axes.dtype).max ** 0.5 / 4  # squares of longer axes would overflow
    return axes.clamp(-longest, longest)


def _ellipses(axes: Float[Tensor, "m 2 3"], dilation: float) -> tuple[Tensor, Tensor]:
    """Return the ellipses, and the share of its opacity that an antialiased Gaussian keeps.

    One row of ``M`` is divided by ``sqrt(d)`` first, so the determinant stays in float32 range.
    """
    across, down = axes.unbind(1)
    bare_a = (across * across).sum(dim=1)
    d = (down * down).sum(dim=1) + dilation
    b = (across * down).sum(dim=1)
    minors = torch.linalg.cross(across, down / d.sqrt()[:, None])
    bare = (minors * minors).sum(dim=1)
    schur = bare + dilation * (bare_a + d) / d
    survival = (bare / schur).clamp_min(parameters.MIN_ALPHA**2 / 4).sqrt()
    return torch.stack([1 / schur, -b / d, 1 / d], dim=1), survival


@torch.no_grad()
def _front_to_back(
    centers: Tensor, ellipses: Tensor, opacities: Tensor, depths: Tensor, camera: Pinhole
) -> Tensor:
    """Return the indices of the splats that touch the image, sorted by depth."""
    keep = (opacities >= parameters.MIN_ALPHA) & torch.isfinite(ellipses).all(dim=1)
    halves = half_sizes(ellipses, reach_of(opacities))
    for place, half, size in zip(centers.unbind(1), halves, camera.size, strict=True):
        keep &= (place + half >= 0) & (place - half <= size)
    touching = keep.nonzero()[:, 0]
    return touching[torch.sort(depths[touching], stable=True).indices]


def _colors(
    scene: GaussianScene, rows: Tensor, offsets: Tensor, sh_degree: int
) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, "m"]]:
    """Return the colours, and whether they are finite; else they are black, without gradient."""
    count = spherical_harmonics.REST_COUNTS[sh_degree]
    parts = scene.sh0.index_select(0, rows), scene.shN[:, :count].index_select(0, rows)
    finite = rows_are_finite(*parts)
    sh0, shN = (part.where(finite[:, None, None], 0) for part in parts)  # noqa: N806
    # In float32, squares of more than 1e19 units are infinite.
    exact = torch.nn.functional.normalize(offsets.double(), dim=1) if count else offsets
    colors = spherical_harmonics.evaluate(sh0, shN, exact.to(offsets.dtype))
    if not count and shN.requires_grad:  # so that unused bands have a gradient, of zero
        colors = colors + shN.flatten(1).sum(dim=1, keepdim=True)
    is_small = rows_are_finite(colors)
    return colors.where(is_small[:, None], 0), finite & is_small


def rows_are_finite(*parts: Float[Tensor, "m ..."]) -> Bool[Tensor, "m"]:
    """Return for each row whether all of its numbers are finite; nothing waits for a device."""
    return torch.stack([part.isfinite().flatten(1).all(dim=1) for part in parts]).all(dim=0)


def warn_of_near_plane(scene: GaussianScene, cameras: Sequence[Cameras], *, name: str) -> None:
    """Warn if the near plane hides much of a scene from some single cameras."""
    points = scene.means[:: -(-len(scene) // SAMPLED)].double().cpu()
    shares = []
    for camera in cameras:
        view, intrinsics = camera.viewmats[0].to(points), camera.Ks[0].to(points)
        view = view / view_scales(camera.viewmats).to(points)
        x, y, depth = intrinsics @ (view[:3, :3] @ points.T + view[:3, 3:])
        # Behind the camera, no number is between 0 and a negative one.
        ahead = (x >= 0) & (x <= camera.width * depth) & (y >= 0) & (y <= camera.height * depth)
        hidden = ahead & (depth < parameters.NEAR_PLANE)
        shares.append(int(hidden.sum()) / max(1, int(ahead.sum())))
    share = sum(shares) / len(shares)
    if share > MOST_HIDDEN:
        warn(
            f"images of {name} lack {share:.0%} of the Gaussians before their cameras: renderers "
            f"draw nothing nearer than {parameters.NEAR_PLANE} units; scale it up.",
            CameraWarning,
        )
