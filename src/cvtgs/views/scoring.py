"""Score candidate cameras by small rendered images."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.cameras import Cameras, look_at
from cvtgs.devices import HOST, full_precision, in_chunks
from cvtgs.math import parameters
from cvtgs.rendering import choose_backend, render
from cvtgs.rendering.render import contributions_to_each
from cvtgs.scene import GaussianScene
from cvtgs.views.layout import SceneLayout

PIXELS = 64  # longer side of the small images
_SOLID = 0.5
_NEAR = 0.3  # a surface nearer than this share of the distance to the subject is an obstacle
_MOST_NEAR = 0.08
_MOST_BLOCKED = 0.3
_LEAST_FILLED = {False: 0.12, True: 0.8}  # least mean alpha, by whether the camera is inside a room
_VISIBLE = 0.25
# Largest splats of smooth sides that images were taken of, in robust radii. Sampling makes scenes
# of any number of Gaussians comparable.
SMOOTH = 0.05
_SPARSE = 4  # splats are measured on every fourth Gaussian of a sample, of four times the area
_FEW = 20_000  # samples of fewer Gaussians are used whole
_TOGETHER = 64  # cameras of which contributions are kept at a time
_ENCLOSING = 2.5  # a camera within this many standard deviations of a Gaussian is inside it


def cameras_at(
    eyes: Float[Tensor, "c 3"],
    directions: Float[Tensor, "c 3"],
    up: Float[Tensor, "3"],
    *,
    size: tuple[int, int],
    field: float,
) -> Cameras:
    """Return cameras of one size; ``field`` is the field of view of the shorter side, degrees."""
    width, height = size
    focal = 0.5 * min(size) / math.tan(math.radians(0.5 * field))
    intrinsics = [[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]
    return Cameras(
        viewmats=look_at(eyes, eyes + directions, up),
        Ks=torch.tensor(intrinsics, dtype=eyes.dtype, device="cpu").repeat(len(eyes), 1, 1),
        width=width,
        height=height,
    )


def image_device(layout: SceneLayout) -> torch.device:
    """Return where to render small images: on the device of the scene if gsplat works there."""
    if layout.device.type == "cpu":
        return HOST
    return layout.device if choose_backend("auto", layout.device)[0] == "gsplat" else HOST


def score_cameras(
    layout: SceneLayout, cameras: Cameras, *, distances: Float[Tensor, "c"]
) -> tuple[Bool[Tensor, "c"], Float[Tensor, "c"]]:
    """Return which cameras are good by small images, and penalties (0 is best) of all of them."""
    small = cameras.fitted(PIXELS, least=8)
    images = render(layout.sample.to(image_device(layout)), small, depth=True)
    alpha = images.alpha.cpu()
    depth = alpha.new_zeros(()) if images.depth is None else images.depth.cpu()
    near = (alpha > _VISIBLE) & (depth < _NEAR * distances.to(depth)[:, None, None])
    near_share = near.double().mean(dim=(1, 2))
    rows, columns = (slice(side // 4, side - side // 4) for side in (small.height, small.width))
    halfway = (alpha > _SOLID) & (depth < 0.45 * distances.to(depth)[:, None, None])
    blocked = halfway[:, rows, columns].double().mean(dim=(1, 2))
    filled = alpha.double().mean(dim=(1, 2))
    lacking = (_LEAST_FILLED[layout.room is not None] - filled).clamp_min(0)
    enclosed = _inside_gaussians(layout, small)
    good = (near_share <= _MOST_NEAR) & (blocked <= _MOST_BLOCKED) & (lacking == 0) & ~enclosed
    return good, 2 * near_share + blocked + 2 * lacking + enclosed.double()


class SplatSizes(NamedTuple):
    """Median sizes of the Gaussians in images, weighted by their contributions, float64."""

    in_image: Float[Tensor, "c"]  # projected standard deviations, as a share of the image
    in_scene: Float[Tensor, "c"]  # standard deviations, as a share of the robust radius
    finest: Float[Tensor, "c"]  # their lower decile instead of the median


def splat_sizes(layout: SceneLayout, cameras: Cameras) -> SplatSizes:
    """Return the median size of the splats that each camera shows, for at least one camera."""
    step = _SPARSE if len(layout.sample) >= _FEW else 1
    sample = layout.sample[::step].to(image_device(layout))
    widths = splat_widths(sample)
    enlarged = sample.log_scales + 0.5 * math.log(step)
    sample = sample.with_tensors({"log_scales": enlarged}, {})
    return measure_splats(sample, widths, layout.frame.radius, cameras.fitted(PIXELS, least=8))


def splat_widths(scene: GaussianScene) -> Float[Tensor, "n"]:
    """Return the geometric mean of the larger two standard deviations, float64."""
    return scene.log_scales.double().sort(dim=1).values[:, 1:].mean(dim=1).exp()


@full_precision()
def measure_splats(
    scene: GaussianScene, widths: Float[Tensor, "n"], radius: float, cameras: Cameras
) -> SplatSizes:
    """Return the sizes of the splats that cameras show; ``widths`` need not be as drawn."""
    starts = range(0, len(cameras), _TOGETHER)
    parts = (cameras[start : start + _TOGETHER] for start in starts)
    found = torch.cat([_splat_quantiles(scene, widths, part) for part in parts])
    share_of_image = cameras.Ks[:, 0, 0].double().cpu() / max(cameras.width, cameras.height)
    in_image, in_scene, finest = found.unbind(1)
    return SplatSizes(in_image * share_of_image, in_scene / radius, finest / radius)


def _splat_quantiles(
    scene: GaussianScene, widths: Float[Tensor, "n"], cameras: Cameras
) -> Float[Tensor, "c 3"]:
    """Return medians of widths over depths and of widths, and lower deciles of widths."""
    painted = torch.stack(list(contributions_to_each(scene, cameras)))
    means, (by_width, order) = scene.means.double(), widths.sort()
    forwards = cameras.viewmats[:, 2].to(means)

    def measure(part: slice) -> Float[Tensor, "p 3"]:
        weights, forward = painted[part], forwards[part]
        ahead = forward[:, :3] @ means.T + forward[:, 3:]
        near, rows = (widths / ahead.clamp_min(1e-9)).sort(dim=1)
        near_shares = weights.gather(1, rows).cpu().cumsum(dim=1)
        shares = weights[:, order].cpu().cumsum(dim=1)
        ascending = by_width.cpu().expand(shares.shape)
        quantiles = [
            _weighted_quantile(near.cpu(), near_shares, 0.5),
            _weighted_quantile(ascending, shares, 0.5),
            _weighted_quantile(ascending, shares, 0.1),
        ]
        return torch.stack(quantiles, dim=1)

    return torch.cat(in_chunks(measure, len(cameras), 1, scene.device))


def _weighted_quantile(
    ascending: Float[Tensor, "c n"], summed: Float[Tensor, "c n"], share: float
) -> Float[Tensor, "c"]:
    """Return a quantile of every row of values, given the running sums of their weights."""
    # Values of weight 0 are never found, unless all have: an empty image shows no size.
    places = torch.searchsorted(summed, share * summed[:, -1:])
    return ascending.gather(1, places)[:, 0]


def _inside_gaussians(layout: SceneLayout, cameras: Cameras) -> Bool[Tensor, "c"]:
    """Return which cameras are inside a Gaussian that is not faint."""
    sample = layout.sample.select(layout.sample.opacities > _VISIBLE)
    means = sample.means.double()
    largest = sample.scales.amax(dim=1)
    found = []
    for eye in cameras.centers.to(means):
        offsets = (eye - means).to(sample.dtype)
        near = torch.linalg.vector_norm(offsets, dim=1) < _ENCLOSING * largest
        frames = parameters.rotation_matrices(sample.quats[near])
        local = (frames.transpose(1, 2) @ offsets[near][:, :, None])[:, :, 0]
        squares = (local / sample.scales[near].clamp_min(1e-12)).square().sum(dim=1)
        found.append(bool((squares < _ENCLOSING**2).any()))
    return torch.tensor(found, device="cpu")
