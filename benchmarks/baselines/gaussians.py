"""Selection of the rows that baselines use and keep, covariances, and new Gaussians."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene
from cvtgs.validity import standardized, valid_part


def usable(scene: GaussianScene, count: int) -> GaussianScene:
    """Return the valid rows as standard Gaussians, at least ``count``.

    Invalid rows, extra columns and the layout of the file are dropped; opacities are clamped to
    the inside of (0, 1) and quaternions normalized. Comments stay, including the mip tag.

    Raises:
        InvalidArgumentError: ``count`` is below 1 or exceeds the number of valid rows.
    """
    valid = valid_part(replace(scene, extras={}, layout=()))
    if not 1 <= count <= len(valid):
        raise InvalidArgumentError(
            f"count must be between 1 and the {len(valid)} valid Gaussians, found {count}."
        )
    return standardized(valid)


def keep_largest(scene: GaussianScene, scores: Float[Tensor, "n"], *, count: int) -> GaussianScene:
    """Keep the rows with the largest scores, in their order; of equal scores the first."""
    best = torch.sort(scores, descending=True, stable=True).indices[:count]
    return scene.select(best.sort().values)


def covariances_of(scene: GaussianScene) -> Float[Tensor, "n 3 3"]:
    """Build covariances with positive eigenvalues: flat Gaussians get 1e-6 of their extent.

    Otherwise Kullback-Leibler divergences from flat Gaussians would be infinite. For the same
    reason no scale is below 1e-30.
    """
    scales = torch.exp(scene.log_scales.double()).clamp_min(1e-30)
    scales = torch.maximum(scales, 1e-6 * scales.amax(dim=1, keepdim=True))
    return parameters.build_covariances(scales, scene.quats.double())


def from_moments(
    scene: GaussianScene,
    means: Float[Tensor, "m 3"],
    shapes: Float[Tensor, "m 3 3"],
    appearance: dict[str, Tensor],
) -> GaussianScene:
    """Make Gaussians from moments and appearance, with dtype and comments of the scene."""
    scales, quats = parameters.decompose_covariances(shapes)
    tensors = {"means": means, "quats": quats, "log_scales": parameters.positive_log(scales)}
    return scene.with_tensors(
        {name: values.to(scene.dtype) for name, values in (tensors | appearance).items()}, {}
    )
