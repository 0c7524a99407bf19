"""The filter, which drops faint Gaussians and flyaways before the tessellation."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.analysis import SceneAnalysis, perspective_falloff
from cvtgs.analysis.effects import drawn_rows
from cvtgs.checks import check_range, checked
from cvtgs.config import FilterConfig
from cvtgs.counts import check_share, checked_whole
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.parameters import divide
from cvtgs.math.segments import running_sums, true_rows
from cvtgs.scene import GaussianScene

__all__ = ["FilteredRows", "filter_rows", "flyaway_rows", "visible_rows"]

FLYAWAY_RADII = 100.0
"""Distance beyond which a Gaussian may be a flyaway, in robust radii; no sky lies so far."""


class FilteredRows(NamedTuple):
    """The Gaussians that enter the tessellation.

    Attributes:
        rows: ``(k,)`` their row numbers, ascending.
        left_out: Number of dropped Gaussians.
        left_out_mass_share: Share of the mass that the dropped Gaussians hold.
    """

    rows: Int[Tensor, "k"]
    left_out: int
    left_out_mass_share: float


@checked
def filter_rows(
    scene: GaussianScene, analysis: SceneAnalysis, target: int, config: FilterConfig
) -> FilteredRows:
    """Drop faint Gaussians and flyaways, but keep at least the target number of Gaussians.

    All faint Gaussians are dropped; where they hold much mass together (haze), only the faintest.

    Args:
        scene: The Gaussians; all rows must be valid.
        analysis: Areas and effect plan of the scene.
        target: Minimum number of Gaussians to keep.
        config: Thresholds.

    Returns:
        The rows that stay, and statistics of the dropped ones.

    Raises:
        InvalidArgumentError: The analysis is of another scene, or ``target`` is outside 1 to n.

    Example:
        >>> from cvtgs.analysis import analyze
        >>> from cvtgs.config import SimplifyConfig
        >>> from cvtgs.synthetic import scene as make
        >>> scene, config = make("object", 100, seed=0), SimplifyConfig()
        >>> found = filter_rows(scene, analyze(scene, config), 10, config.filter)
        >>> len(found.rows) + found.left_out
        100
    """
    opacities = analysis.opacities
    if len(opacities) != len(scene):
        raise InvalidArgumentError(
            f"analysis must be that of the {len(scene):,} Gaussians of the scene, "
            f"found one of {len(opacities):,}."
        )
    target = checked_whole(target, "target", most=len(scene), things="Gaussians of the scene")
    keep, is_hazy = opacities >= config.min_opacity, analysis.plan.haze.active
    if is_hazy or int(keep.sum()) < target:
        keep = visible_rows(
            opacities,
            analysis.apparent_areas * opacities,
            min_opacity=config.min_opacity,
            max_mass_share=config.max_mass_share if is_hazy else 1.0,
            at_least=target,
        )
    masses = analysis.masses
    if config.max_flyaway_share > 0.0 and analysis.farthest > FLYAWAY_RADII:
        distances = analysis.frame.distances(scene.means)
        seen = masses * perspective_falloff(distances)
        fewer = keep & ~flyaway_rows(distances, seen, max_share=config.max_flyaway_share)
        keep = fewer if int(fewer.sum()) >= target else keep
    mass_share = divide(torch.where(keep, 0.0, masses).sum(), masses.sum())
    count, share = torch.stack([keep.sum().double(), mass_share.double()]).tolist()
    return FilteredRows(true_rows(keep, int(count)), len(keep) - int(count), share)


@checked
def visible_rows(
    opacities: Float[Tensor, "n"],
    masses: Float[Tensor, "n"],
    *,
    min_opacity: float,
    max_mass_share: float,
    at_least: int,
) -> Bool[Tensor, "n"]:
    """Drop the faintest Gaussians up to a share of the mass.

    Gaussians that are never drawn count as having no mass.

    With ``max_mass_share = 1`` this is the filter of CVT-GS: everything below ``min_opacity`` is
    dropped. A smaller share keeps haze, which is many faint Gaussians with real mass.

    Args:
        opacities: Opacities.
        masses: Opacity times mean projected area, any unit.
        min_opacity: Gaussians at or above this opacity always stay.
        max_mass_share: The faintest are dropped while their mass is at most this share of the
            total; of equally faint ones, the lightest are dropped first.
        at_least: If fewer than this many would stay, the heaviest of the dropped ones stay too,
            those first that images can show.

    Returns:
        Mask of the Gaussians that stay.

    Raises:
        InvalidArgumentError: Shapes do not fit together, a number is out of range, or (on the host)
            an opacity is not from 0 to 1.

    Example:
        >>> opacities = torch.tensor([0.01, 0.05, 0.9])
        >>> masses = torch.tensor([0.1, 5.0, 90.0])
        >>> visible_rows(
        ...     opacities, masses, min_opacity=0.1, max_mass_share=0.01, at_least=1
        ... ).tolist()
        [False, True, True]
    """
    check_share(min_opacity, "min_opacity")
    check_share(max_mass_share, "max_mass_share")
    at_least = checked_whole(at_least, "at_least", least=0, most=len(opacities), things="Gaussians")
    check_range(opacities, 1, "opacities")
    faint = (opacities < min_opacity).nonzero()[:, 0]
    faint = faint[torch.sort(masses[faint], stable=True).indices]  # breaks ties of opacity
    faint = faint[torch.sort(opacities[faint], stable=True).indices]
    dropped, drawn = faint, masses.double() * drawn_rows(opacities)
    if max_mass_share < 1:
        dropped = faint[running_sums(drawn[faint]) <= max_mass_share * drawn.sum()]
    missing = at_least - (len(opacities) - len(dropped))
    if missing > 0:
        dropped = dropped[torch.sort(masses[dropped], stable=True, descending=True).indices]
        heaviest_first = torch.sort(drawn[dropped], stable=True, descending=True).indices
        dropped = dropped[heaviest_first[missing:]]
    keep = torch.ones(len(opacities), dtype=torch.bool, device=opacities.device)
    keep[dropped] = False
    return keep


def most_flyaways(total: int) -> int:
    """Return the largest number of flyaways of a scene; a scene of few may have ten."""
    return max(10, total // 100)


@checked
def flyaway_rows(
    distances: Float[Tensor, "n"], masses: Float[Tensor, "n"], *, max_share: float
) -> Bool[Tensor, "n"]:
    """Find Gaussians beyond 100 robust radii that contribute next to nothing.

    Merging them with others would give one huge blob. A sky has real mass, and stays. If more than
    a hundredth of all Gaussians (and more than ten) lie there, they are what stands around a small
    detailed object, and none is a flyaway.

    Args:
        distances: Distances from the middle of the scene, in robust radii.
        masses: Masses as seen from the middle.
        max_share: Share of the total mass up to which the lightest far Gaussians are flyaways.

    Returns:
        Mask of the flyaways.

    Raises:
        InvalidArgumentError: Shapes do not fit together, or ``max_share`` is not from 0 to 1.

    Example:
        >>> flyaway_rows(
        ...     torch.tensor([1.0, 1e6]), torch.tensor([1.0, 1e-12]), max_share=1e-3
        ... ).tolist()
        [False, True]
    """
    check_share(max_share, "max_share")
    far = (distances > FLYAWAY_RADII).nonzero()[:, 0]
    found = torch.zeros(len(distances), dtype=torch.bool, device=distances.device)
    if len(far) > most_flyaways(len(distances)):
        return found
    far = far[torch.sort(masses[far], stable=True).indices]
    lost = running_sums(masses[far].double())
    found[far[lost <= max_share * masses.double().sum()]] = True
    return found
