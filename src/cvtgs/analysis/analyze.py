"""SceneAnalysis, computed once for all stages: frame, areas, ambient visibility, contributions."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis.effects import (
    EffectPlan,
    drawn_rows,
    drop_unused_bands,
    haze_share,
    plan_effects,
    plan_haze,
)
from cvtgs.cameras import Cameras
from cvtgs.checks import checked
from cvtgs.config import SimplifyConfig, TessellationConfig
from cvtgs.devices import row_chunks
from cvtgs.errors import InvalidArgumentError, warn
from cvtgs.losses import SSIM_WINDOW
from cvtgs.math.frames import RobustFrame, group_radius, robust_frame
from cvtgs.math.parameters import NEAR_PLANE, divide
from cvtgs.rendering import ObservedViews, contributions, observe
from cvtgs.rendering.projection import warn_of_near_plane
from cvtgs.scene import GaussianScene
from cvtgs.text import short_repr, shown
from cvtgs.views import mixed_views

MIN_OPACITY = 1e-6  # floor of opacities in divisions

VOXEL = 0.04  # side of a voxel, in robust radii of contracted space
HALF_GRID = 64  # voxels from the middle of the grid to its border
REACH = 6  # number of voxels in each direction whose optical depth counts

MAX_DEPTH = 1e6
FIXED_POINT = 2**20

SLAB = 32
CHUNK = 1 << 16  # Gaussians per chunk, to bound memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneAnalysis:
    """The analysis of the valid Gaussians of a scene.

    Attributes:
        frame: Robust centre and radius of the scene.
        farthest: Largest distance to the centre, in robust radii.
        opacities: ``(n,)`` opacities in (0, 1).
        areas: ``(n,)`` mean projected areas, squared scene units, float64.
        apparent_areas: ``(n,)`` areas as they count in images: smaller for Gaussians far from the
            middle or enclosed by others.
        visibility: ``(n,)`` ambient visibility of every Gaussian, 0 (enclosed) to 1 (free);
            empty if neither weights nor the network use it.
        plan: The effects that the scene calls for.
        observed: Images of the scene and the contributions of these Gaussians to them; None if
            later stages do not use them.
    """

    frame: RobustFrame
    farthest: float
    opacities: Float[Tensor, "n"]
    areas: Float[Tensor, "n"]
    apparent_areas: Float[Tensor, "n"]
    visibility: Float[Tensor, "n_or_0"]
    plan: EffectPlan
    observed: ObservedViews | None = None

    __repr__ = short_repr

    @property
    def masses(self) -> Float[Tensor, "n"]:
        """Opacity times mean projected area, squared scene units, float64."""
        return self.areas * self.opacities

    def select(self, rows: Tensor) -> Self:
        """Return the values of some Gaussians; frame, farthest and plan remain of the scene."""
        observed = self.observed
        if observed is not None:
            observed = replace(observed, contributions=observed.contributions[rows])
        return replace(
            self,
            observed=observed,
            opacities=self.opacities[rows],
            areas=self.areas[rows],
            apparent_areas=self.apparent_areas[rows],
            visibility=self.visibility[rows] if len(self.visibility) else self.visibility,
        )


@checked
def analyze(
    scene: GaussianScene, config: SimplifyConfig, *, with_visibility: bool = False
) -> SceneAnalysis:
    """Analyze a scene without rendering it.

    Args:
        scene: The Gaussians; all rows must be valid.
        config: The configuration.
        with_visibility: Whether a network needs the ambient visibility.

    Returns:
        Frame, areas, visibility and effect plan.

    Raises:
        InvalidArgumentError: An argument has another type, or the scene is empty.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> analysis = analyze(make("object", 100, sh_degree=0, seed=0), SimplifyConfig())
        >>> analysis.plan.unbounded.active, len(analysis.areas)
        (False, 100)
    """
    if scene.means.numel() == 0:
        raise InvalidArgumentError(
            f"scene must be a GaussianScene of at least one Gaussian, found {shown(scene)}."
        )
    areas, opacities = scene.areas, scene.opacities
    frame = frame_of(scene.means, opacities)
    distances, masses = frame.distances(scene.means), areas * opacities
    visibility = masses[:0]
    if with_visibility or config.cvt.hidden_share < 1.0:
        visibility = ambient_visibility(scene.means, masses, frame)
    apparent = apparent_areas(areas, distances, visibility, config=config.cvt)
    plan = plan_effects(scene, masses, apparent * opacities, distances=distances, config=config)
    return SceneAnalysis(
        frame=frame,
        farthest=float(distances.amax()),
        opacities=opacities,
        areas=areas,
        apparent_areas=apparent,
        visibility=visibility,
        plan=plan,
    )


def frame_of(means: Float[Tensor, "n 3"], opacities: Float[Tensor, "n"]) -> RobustFrame:
    """Return the robust frame of the Gaussians that are drawn at all; of all if none is."""
    drawn = means[drawn_rows(opacities)]
    return replace(robust_frame(drawn), group_radius=group_radius(drawn))


def apparent_areas(
    areas: Float[Tensor, "n"],
    distances: Float[Tensor, "n"],
    visibility: Float[Tensor, "n"],
    *,
    config: TessellationConfig,
) -> Float[Tensor, "n"]:
    """Return areas as they count in images: smaller if far from the middle or enclosed."""
    apparent = areas
    if config.perspective:
        apparent = apparent * perspective_falloff(distances)
    if config.hidden_share < 1.0:
        apparent = apparent * (config.hidden_share + (1 - config.hidden_share) * visibility)
    return apparent


def perspective_falloff(distances: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return the factor on the area of a far Gaussian as seen from the middle of the scene.

    It is ``1 / max(1, d)^2`` of distances to the centre in robust radii, in their dtype.

    Example:
        >>> perspective_falloff(torch.tensor([2.0]).double()).tolist()
        [0.25]
    """
    return distances.clamp_min(1.0).pow_(-2)


def ambient_visibility(
    means: Float[Tensor, "n 3"], masses: Float[Tensor, "n"], frame: RobustFrame
) -> Float[Tensor, "n"]:
    """Return how freely every Gaussian can be seen from a quarter of a robust radius around it.

    Gaussians inside a solid would take a share of the cells and are never seen. The masses in a
    voxel give its optical depth; the transmittance of the next voxels is averaged over the six
    axis directions. The reach is short, so that the walls of a room stay visible from the inside,
    and haze from everywhere. This is our own rule, not part of CVT-GS.

    Args:
        means: Positions, scene units.
        masses: Opacity times mean projected area, squared scene units.
        frame: Centre and radius of the scene.

    Returns:
        Numbers from 0 (enclosed) to 1 (free) in float64; 1 beyond the grid. Memory is about 35 MB
        for the grid, plus ``12 n`` bytes.

    Example:
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)
        >>> ambient_visibility(torch.zeros(1, 3), torch.ones(1).double(), frame).tolist()
        [1.0]
    """
    depths = empty_depth_grid(means.device)
    voxels = add_depths(depths, means, masses, frame)
    return visibility_grid(depths).index_select(0, voxels).double()


def empty_depth_grid(device: torch.device) -> Int[Tensor, "voxels"]:
    """Return an empty grid of optical depths: whole numbers, whose sums have no order."""
    return torch.zeros((2 * HALF_GRID) ** 3 + 1, dtype=torch.int64, device=device)


def add_depths(
    sums: Int[Tensor, "voxels"],
    means: Float[Tensor, "n 3"],
    masses: Float[Tensor, "n"],
    frame: RobustFrame,
) -> Int[Tensor, "n"]:
    """Add the optical depths of some Gaussians to a grid, in place; return the voxel of each."""
    voxels = torch.empty(len(means), dtype=torch.int32, device=means.device)
    for part in row_chunks(len(means), CHUNK, means.device):
        voxel, shrinkage = _voxels_of(means[part], frame)
        voxels[part] = voxel.to(torch.int32)
        depths = masses[part] * (shrinkage / (frame.radius * VOXEL)).square()
        # Integer sums do not depend on the order, so every device gives the same grid.
        whole = (depths.clamp_max(MAX_DEPTH) * FIXED_POINT).round().to(torch.int64)
        sums.index_add_(0, voxel, whole)
    return voxels


def visibility_grid(sums: Int[Tensor, "voxels"]) -> Float[Tensor, "voxels"]:
    """Return the ambient visibility of every voxel of a finished grid, and 1 for all beyond it."""
    size = 2 * HALF_GRID
    grid = (sums[:-1].to(torch.float32) / FIXED_POINT).reshape(size, size, size)
    visible = torch.zeros_like(grid)
    for axis in range(3):  # the transmittance of the next voxels, averaged over six directions
        across = 1 if axis == 0 else 0  # slabs along another axis, to bound memory
        slabs = zip(grid.split(SLAB, across), visible.split(SLAB, across), strict=True)
        for slab, target in slabs:
            through = torch.exp(-_windows(slab, axis))
            target.add_(through.narrow(axis, 0, size))
            target.add_(through.narrow(axis, REACH + 1, size))
    return torch.nn.functional.pad(visible.div_(6).flatten(), (0, 1), value=1.0)


def visibility_at(
    grid: Float[Tensor, "voxels"], means: Float[Tensor, "n 3"], frame: RobustFrame
) -> Float[Tensor, "n"]:
    """Look up the ambient visibility of Gaussians in a :func:`visibility_grid`."""
    chunks = row_chunks(len(means), CHUNK, means.device)
    parts = [grid[_voxels_of(means[part], frame)[0]] for part in chunks]
    return torch.cat([grid[:0], *parts]).double()


def _voxels_of(
    means: Float[Tensor, "n 3"], frame: RobustFrame
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the voxel of each position, and the factor by which contraction shrinks it there."""
    size, local = 2 * HALF_GRID, frame.normalize(means)
    distance = torch.linalg.vector_norm(local, dim=1).clamp_min(1.0)
    shrinkage = (1.0 + torch.log(distance)) / distance
    voxels = (local * shrinkage[:, None] / VOXEL).floor().to(torch.int64) + HALF_GRID
    inside = ((voxels >= 0) & (voxels < size)).all(dim=1)
    i, j, k = voxels.unbind(1)
    return torch.where(inside, (i * size + j) * size + k, size**3), shrinkage


def _windows(slab: Float[Tensor, "a b c"], axis: int) -> Float[Tensor, "d e f"]:
    """Sum every run of ``REACH`` voxels, including runs that leave the grid at either end."""
    padded = torch.nn.functional.pad(slab, [0, 0] * (2 - axis) + [REACH, REACH])
    count = slab.shape[axis] + REACH + 1
    sums = padded.narrow(axis, 0, count).clone()
    for start in range(1, REACH):
        sums.add_(padded.narrow(axis, start, count))
    return sums


def measure_contributions(
    scene: GaussianScene,
    analysis: SceneAnalysis,
    config: SimplifyConfig,
    *,
    cameras: Cameras | None = None,
    on_image: Callable[[int], None] = lambda done: None,
) -> SceneAnalysis:
    """Correct apparent areas, and the haze effect, by the contributions to images of the scene."""
    used, observed = drop_unused_bands(scene, analysis.plan), None
    views = visibility_cameras(used, config, cameras=cameras)
    if config.match.enabled or (cameras is not None and config.match.error_power > 0.0):
        observed = observe(used, views, on_image=on_image)
        rendered = observed.contributions
    else:
        rendered = contributions(used, views)
    opacities, apparent = analysis.opacities, analysis.apparent_areas
    if float(rendered.sum()) > 0.0:
        if cameras is None:  # others were checked before
            warn_of_near_plane(scene, views.singles(), name="the scene")
        share = config.visibility.mass_share
        apparent = measured_areas(apparent, opacities, rendered, share=share)
    else:
        warn_of_empty_images()
    haze = plan_haze(float(haze_share(opacities, apparent * opacities, config)), config)
    plan = analysis.plan.model_copy(update={"haze": haze})
    return replace(analysis, apparent_areas=apparent, plan=plan, observed=observed)


def warn_of_empty_images() -> None:
    """Warn that no image of the scene shows anything."""
    warn(
        "images of the scene show nothing, so they change nothing: Gaussians are too faint, or "
        f"the scene is so small that they are nearer to cameras than {NEAR_PLANE} units, where "
        "renderers draw nothing; scale it up."
    )


def visibility_cameras(
    scene: GaussianScene, config: SimplifyConfig, *, cameras: Cameras | None = None
) -> Cameras:
    """Return the cameras of the images that contributions are measured in, of two sizes."""
    choices = config.visibility
    least = SSIM_WINDOW * choices.stride
    if cameras is None:
        side = max(choices.size, least)
        views = mixed_views(scene, choices.views, size=side, seed=config.seed)
    else:
        side = min(choices.size, max(cameras.width, cameras.height))
        views = cameras.spread(choices.views).fitted(side, least=least)
    views = views.interleaved(choices.stride).in_two_sizes(choices.fine_factor)
    return views.in_both_modes()


def measured_areas(
    areas: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    contributions: Float[Tensor, "n"],
    *,
    share: float,
    mass_per_pixel: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n"]:
    """Return apparent areas that are corrected by the contributions to images."""
    if mass_per_pixel is None:  # else that of a larger scene
        mass_per_pixel = (areas * opacities).double().sum() / contributions.sum()
    shown = (1.0 - share) * contributions * mass_per_pixel
    blended = share * (areas * opacities).double() + shown
    return divide(blended, opacities.double().clamp_min(MIN_OPACITY)).to(areas.dtype)
