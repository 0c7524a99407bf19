"""ActivatedGaussians: Gaussians activated and set against one another, pair by pair.

What belongs to one component of all of them lies in one run of memory: sums of products over
three components are then as fast as memory, and many times as fast as products of small matrices.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

LARGEST_PLACE = 1e4
LARGEST_LOG = 80.0
"""Places and scales are limited so that no product of them leaves float32."""

LARGEST_CONTRAST = 1.0
"""That of black and white: networks have hardly seen more, and take it for reasons to grow."""


class ActivatedGaussians(NamedTuple):
    """Some Gaussians, activated, in the dtype of the scene."""

    means: Tensor
    rotations: Tensor
    log_scales: Tensor
    log_areas: Tensor
    logits: Tensor
    colors: Tensor

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Opacities in (0, 1)."""
        return torch.sigmoid(self.logits)

    def take(self, ids: Int[Tensor, "r"]) -> "ActivatedGaussians":
        """Take some rows."""
        return ActivatedGaussians(*(take(values, ids) for values in self))


def activate_rows(scene: GaussianScene, rows: Int[Tensor, "r"]) -> ActivatedGaussians:
    """Activate some Gaussians."""
    log_scales = gather(scene.log_scales, rows)
    return ActivatedGaussians(
        means=gather(scene.means, rows),
        rotations=parameters.quats_to_matrices(
            parameters.normalize_quats(gather(scene.quats, rows))
        ),
        log_scales=log_scales,
        log_areas=parameters.log_mean_projected_area(log_scales),
        logits=parameters.clamp_logits(scene.logit_opacities.index_select(0, rows)),
        colors=gather(scene.sh0[:, 0], rows) * SH_C0,
    )


def gather(values: Float[Tensor, "n c"], rows: Int[Tensor, "r"]) -> Float[Tensor, "r c"]:
    """Take rows from all over a table."""
    return values.index_select(0, rows).T.contiguous().T


def take(values: Float[Tensor, "n *c"], rows: Int[Tensor, "r"]) -> Float[Tensor, "r *c"]:
    """Take rows of what lies in memory component by component, as the result does."""
    columns = values.reshape(-1, math.prod(values.shape[1:])).T.contiguous()
    return columns.index_select(1, rows).T.reshape(-1, *values.shape[1:])


def places_in(frames: ActivatedGaussians, shifts: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Express shifts in frames and in their standard deviations."""
    turned = coordinates(frames.rotations, shifts[:, :, None])[:, :, 0]
    units = torch.exp((-frames.log_scales).clamp(-LARGEST_LOG, LARGEST_LOG))
    return (turned * units).clamp(-LARGEST_PLACE, LARGEST_PLACE)


def coordinates(
    rotations: Float[Tensor, "n 3 3"], vectors: Float[Tensor, "n 3 k"]
) -> Float[Tensor, "n 3 k"]:
    """Express vectors in frames."""
    rows = zip(rotations[:, :, :, None].unbind(1), vectors[:, :, None, :].unbind(1), strict=True)
    first, second, third = rows
    return (first[0] * first[1]).addcmul_(*second).addcmul_(*third)


def squared_lengths(vectors: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k"]:
    """Return the squared lengths of vectors."""
    x, y, z = vectors.unbind(-1)
    return x.square().addcmul_(y, y).addcmul_(z, z)


def contrasts_of(some: ActivatedGaussians, others: ActivatedGaussians) -> Float[Tensor, "n"]:
    """Return how far colours are apart."""
    return (some.colors - others.colors).square().mean(dim=1).sqrt().clamp_max(LARGEST_CONTRAST)


def extents_in(frames: ActivatedGaussians, others: ActivatedGaussians) -> Float[Tensor, "n 3"]:
    """Return how far Gaussians extend along the axes of frames."""
    cosines = coordinates(frames.rotations, others.rotations)
    largest = others.log_scales.amax(dim=1, keepdim=True)
    scales = torch.exp(others.log_scales - largest)
    squares = squared_lengths(cosines * scales[:, None, :])
    logs = 0.5 * parameters.positive_log(squares) + largest - frames.log_scales
    return logs.clamp(-9, 9)
