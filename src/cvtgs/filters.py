"""Which Gaussians enter the tessellation, and the mass that is left out."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.scene import GaussianScene


def invalid_rows(scene: GaussianScene) -> dict[str, Bool[Tensor, "n"]]:
    """Find the rows that no renderer can draw.

    NaN or infinite means, scales and SH coefficients, NaN opacities, and quaternions that are
    zero, NaN or infinite are invalid. Scales beyond float32 count as infinite, and those of
    minus infinity, which are 0, are invalid too. Infinite opacity logits are valid.

    Args:
        scene: Any scene.

    Returns:
        One mask per attribute that has bad rows; empty for a clean scene.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> invalid_rows(scene("object", 10, sh_degree=0, seed=0))
        {}
    """
    masks = {
        "means": ~_finite(scene.means),
        "quats": ~_finite(scene.quats) | (scene.quats == 0).all(dim=1),
        "log_scales": ~_finite(scene.log_scales) | (scene.log_scales > MAX_LOG_SCALE).any(dim=1),
        "logit_opacities": scene.logit_opacities.isnan(),
        "sh0": ~_finite(scene.sh0),
        "shN": ~_finite(scene.shN),
    }
    return {name: mask for name, mask in masks.items() if bool(mask.any())}


def valid_rows(scene: GaussianScene) -> Bool[Tensor, "n"]:
    """Return which rows renderers can draw.

    Args:
        scene: Any scene.

    Returns:
        Mask of the valid rows.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> bool(valid_rows(scene("object", 10, sh_degree=0, seed=0)).all())
        True
    """
    valid = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
    for mask in invalid_rows(scene).values():
        valid &= ~mask
    return valid


def visible_rows(
    opacities: Float[Tensor, "n"],
    masses: Float[Tensor, "n"],
    *,
    min_opacity: float,
    max_mass_share: float,
    at_least: int,
) -> Bool[Tensor, "n"]:
    """Leave out the faintest Gaussians, as long as hardly any mass goes with them.

    With ``max_mass_share = 1`` this is the filter of CVT-GS: everything below ``min_opacity``
    goes. A smaller share keeps haze, which is many faint Gaussians with real mass.

    Args:
        opacities: Opacities.
        masses: Opacity times mean projected area, any unit.
        min_opacity: Gaussians at or above this opacity always stay.
        max_mass_share: The faintest go while their mass is at most this share of the total; of
            equally faint ones, those of least mass go first.
        at_least: If fewer than this many would stay, the heaviest of the others stay too.

    Returns:
        Mask of the Gaussians that stay.

    Example:
        >>> opacities = torch.tensor([0.01, 0.05, 0.9])
        >>> masses = torch.tensor([0.1, 5.0, 90.0])
        >>> visible_rows(
        ...     opacities, masses, min_opacity=0.1, max_mass_share=0.01, at_least=1
        ... ).tolist()
        [False, True, True]
    """
    faint = (opacities < min_opacity).nonzero()[:, 0]
    faint = faint[torch.sort(masses[faint], stable=True).indices]  # of equally faint ones
    faint = faint[torch.sort(opacities[faint], stable=True).indices]
    lost = masses[faint].double().cumsum(0)
    limit = max_mass_share * float(masses.double().sum()) if max_mass_share < 1 else math.inf
    dropped = faint[lost <= limit]
    missing = at_least - (len(opacities) - len(dropped))
    if missing > 0:
        heaviest_first = torch.sort(masses[dropped], stable=True, descending=True).indices
        dropped = dropped[heaviest_first[missing:]]
    keep = torch.ones(len(opacities), dtype=torch.bool, device=opacities.device)
    keep[dropped] = False
    return keep


def flyaway_rows(
    distances: Float[Tensor, "n"], masses: Float[Tensor, "n"], *, max_share: float
) -> Bool[Tensor, "n"]:
    """Find Gaussians that lie absurdly far away and paint next to nothing.

    Merged with others they would become one huge blob. A sky has real mass, and stays.

    Args:
        distances: Distances from the middle of the scene, in robust radii.
        masses: Masses as seen from there.
        max_share: The least massive ones are found, while they hold at most this share.

    Returns:
        Mask of the flyaways.

    Example:
        >>> flyaway_rows(
        ...     torch.tensor([1.0, 1e6]), torch.tensor([1.0, 1e-12]), max_share=1e-3
        ... ).tolist()
        [False, True]
    """
    far = (distances > FLYAWAY_RADII).nonzero()[:, 0]
    far = far[torch.sort(masses[far], stable=True).indices]
    lost = masses[far].double().cumsum(0)
    found = torch.zeros(len(distances), dtype=torch.bool, device=distances.device)
    found[far[lost <= max_share * masses.double().sum()]] = True
    return found


FLYAWAY_RADII = 100.0
"""In robust radii: no sky lies so far."""


def with_finite_opacities(scene: GaussianScene) -> GaussianScene:
    """Replace infinite opacity logits, which are valid input, by the largest finite ones.

    Args:
        scene: A scene with valid rows.

    Returns:
        The scene itself if there is nothing to replace.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=0, seed=0)
        >>> with_finite_opacities(scene) is scene
        True
    """
    logits = scene.logit_opacities
    infinite = logits.isinf()
    if not bool(infinite.any()):
        return scene
    finite = torch.where(infinite, parameters.clamp_logits(logits), logits)
    return scene.with_tensors({"logit_opacities": finite}, scene.extras)


def standardized(scene: GaussianScene) -> GaussianScene:
    """Bring opacities strictly inside (0, 1) and quaternions to unit length.

    Args:
        scene: A scene with valid rows.

    Returns:
        A scene in which rows that were so already are unchanged, bit for bit.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=0, seed=0)
        >>> bool((standardized(scene).quats == scene.quats).all())
        True
    """
    squared_norms = scene.quats.double().square().sum(dim=1)
    is_unit = ((squared_norms - 1).abs() <= UNIT_TOLERANCE)[:, None]
    quats = torch.where(is_unit, scene.quats, parameters.normalize_quats(scene.quats))
    logits = parameters.clamp_logits(scene.logit_opacities)
    return scene.with_tensors({"quats": quats, "logit_opacities": logits}, scene.extras)


UNIT_TOLERANCE = 1e-5
"""Quaternions whose squared length is this near 1 count as unit quaternions."""


MAX_LOG_SCALE = math.log(torch.finfo(torch.float32).max)
"""The logarithm of the largest scale that files and renderers, which hold float32, can express."""


def _finite(values: Tensor) -> Tensor:
    """Return the rows without NaN or infinity, without an array of booleans per value.

    A finite number times 0 is 0, any other is NaN, and a sum with a NaN is NaN.
    """
    flat = values.flatten(start_dim=1)
    return torch.cat([(part * 0).sum(dim=1) == 0 for part in flat.split(1 << 16)])
