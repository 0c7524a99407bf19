"""What baselines start from and pruning ends with: rows of a scene."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.scene import GaussianScene
from cvtgs.validity import invalid_rows, standardized


def usable(scene: GaussianScene, count: int) -> GaussianScene:
    """Return the valid rows as standard Gaussians, of which ``count`` can be kept.

    Invalid rows, extra columns and the layout of the file are left out; opacities are brought
    inside (0, 1) and quaternions to unit length. The comments stay, and the mip tag with them.

    Raises:
        InvalidArgumentError: ``count`` is below 1 or there are fewer valid rows.
    """
    valid = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
    for mask in invalid_rows(scene).values():
        valid &= ~mask
    if not 1 <= count <= int(valid.sum()):
        raise InvalidArgumentError(
            f"count must be between 1 and the {int(valid.sum())} valid Gaussians, found {count}."
        )
    return standardized(replace(scene, extras={}, layout=()).select(valid))


def keep_largest(scene: GaussianScene, scores: Float[Tensor, "n"], *, count: int) -> GaussianScene:
    """Keep the rows with the largest scores, in their order; of equal ones the first."""
    best = torch.sort(scores, descending=True, stable=True).indices[:count]
    return scene.select(best.sort().values)
