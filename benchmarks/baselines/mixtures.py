"""A scene as a mixture of Gaussian densities, which methods that merge work on, in float64."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.scene import GaussianScene


def covariances_of(scene: GaussianScene) -> Float[Tensor, "n 3 3"]:
    """Build covariances with positive eigenvalues: flat Gaussians get 1e-6 of their extent.

    Without that no Kullback-Leibler divergence from a flat Gaussian would be finite. For the same
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
    """Make Gaussians of moments and appearance, with the dtype and the comments of the scene."""
    scales, quats = parameters.decompose_covariances(shapes)
    tensors = {"means": means, "quats": quats, "log_scales": parameters.positive_log(scales)}
    return scene.with_tensors(
        {name: values.to(scene.dtype) for name, values in (tensors | appearance).items()}, {}
    )
