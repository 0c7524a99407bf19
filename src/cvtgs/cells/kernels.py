"""Kernels: Gaussians activated and set against one another, pair by pair.

What belongs to one component of all of them lies in one run of memory: sums of products over
three components are then as fast as memory, and many times as fast as products of small matrices.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.math import activations, covariances, quaternions
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

LARGEST_PLACE = 1e4
LARGEST_LOG = 80.0
"""Places and scales are limited so that no product of them leaves float32."""

LARGEST_CONTRAST = 1.0
"""That of black and white: networks have hardly seen more, and take it for reasons to grow."""


class Kernels(NamedTuple):
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

    def take(self, ids: Int[Tensor, "r"]) -> "Kernels":
        """Take some rows.

        Args:
            ids: Which ones.

        Returns:
            Those rows of every tensor.
        """
        return Kernels(*(take(values, ids) for values in self))


def kernels_of(scene: GaussianScene, rows: Int[Tensor, "r"]) -> Kernels:
    """Activate some Gaussians.

    Args:
        scene: All of them.
        rows: ``(r,)`` which ones.

    Returns:
        One row for each in every tensor; the rotations have the axes as columns, and colours are
        those of the constant band, less the 0.5 that all colours have.
    """
    log_scales = gather(scene.log_scales, rows)
    return Kernels(
        means=gather(scene.means, rows),
        rotations=quaternions.to_matrices(quaternions.normalize(gather(scene.quats, rows))),
        log_scales=log_scales,
        log_areas=covariances.log_mean_projected_area(log_scales),
        logits=activations.clamp_logits(scene.logit_opacities.index_select(0, rows)),
        colors=gather(scene.sh0[:, 0], rows) * SH_C0,
    )


def gather(values: Float[Tensor, "n c"], rows: Int[Tensor, "r"]) -> Float[Tensor, "r c"]:
    """Take rows from all over a table.

    Args:
        values: The table.
        rows: Which rows.

    Returns:
        Those rows, in memory component by component.
    """
    return values.index_select(0, rows).T.contiguous().T


def take(values: Float[Tensor, "n *c"], rows: Int[Tensor, "r"]) -> Float[Tensor, "r *c"]:
    """Take rows of what lies in memory component by component, as the result does.

    Args:
        values: The table.
        rows: Which rows.

    Returns:
        Those rows.
    """
    columns = values.reshape(-1, math.prod(values.shape[1:])).T.contiguous()
    return columns.index_select(1, rows).T.reshape(-1, *values.shape[1:])


def places_in(frames: Kernels, shifts: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Express shifts in frames and in their standard deviations.

    Args:
        frames: One Gaussian for each shift.
        shifts: From its centre, scene units.

    Returns:
        Coordinates along its axes, limited to 1e4.
    """
    turned = coordinates(frames.rotations, shifts[:, :, None])[:, :, 0]
    units = torch.exp((-frames.log_scales).clamp(-LARGEST_LOG, LARGEST_LOG))
    return (turned * units).clamp(-LARGEST_PLACE, LARGEST_PLACE)


def coordinates(
    rotations: Float[Tensor, "n 3 3"], vectors: Float[Tensor, "n 3 k"]
) -> Float[Tensor, "n 3 k"]:
    """Express vectors in frames.

    Args:
        rotations: Frames, with their axes as columns.
        vectors: As columns, any number for each frame.

    Returns:
        Coordinates along the axes: the products of transposed rotations and vectors.
    """
    rows = zip(rotations[:, :, :, None].unbind(1), vectors[:, :, None, :].unbind(1), strict=True)
    first, second, third = rows
    return (first[0] * first[1]).addcmul_(*second).addcmul_(*third)


def squared_lengths(vectors: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k"]:
    """Give the squared lengths of vectors.

    Args:
        vectors: As rows, any number for each frame.

    Returns:
        Sums of three squares; many times as fast as a reduction where components lie in runs.
    """
    x, y, z = vectors.unbind(-1)
    return x.square().addcmul_(y, y).addcmul_(z, z)


def contrasts_of(some: Kernels, others: Kernels) -> Float[Tensor, "n"]:
    """Tell how far colours are apart.

    Args:
        some: Gaussians.
        others: As many others.

    Returns:
        Root of the mean square over the channels, at most 1.
    """
    return (some.colors - others.colors).square().mean(dim=1).sqrt().clamp_max(LARGEST_CONTRAST)


def extents_in(frames: Kernels, others: Kernels) -> Float[Tensor, "n 3"]:
    """Tell how far Gaussians extend along the axes of frames.

    Args:
        frames: One Gaussian for each of the others.
        others: Gaussians.

    Returns:
        Logarithms of standard deviations in units of those of the frame, from -9 to 9.
    """
    cosines = coordinates(frames.rotations, others.rotations)
    largest = others.log_scales.amax(dim=1, keepdim=True)
    scales = torch.exp(others.log_scales - largest)
    squares = squared_lengths(cosines * scales[:, None, :])
    logs = 0.5 * activations.positive_log(squares) + largest - frames.log_scales
    return logs.clamp(-9, 9)
