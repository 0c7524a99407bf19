"""Kernels: Gaussians activated and set against one another, pair by pair."""

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


class Kernels(NamedTuple):
    """Some Gaussians, activated, in the dtype of the scene; their centres in float64."""

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
        return Kernels(*(values.index_select(0, ids) for values in self))


def kernels_of(scene: GaussianScene, rows: Int[Tensor, "r"]) -> Kernels:
    """Activate some Gaussians.

    Args:
        scene: All of them.
        rows: ``(r,)`` which ones.

    Returns:
        One row for each in every tensor; the rotations have the axes as columns, and colours are
        those of the constant band, less the 0.5 that all colours have.
    """
    log_scales = scene.log_scales.index_select(0, rows)
    return Kernels(
        means=scene.means.index_select(0, rows).double(),
        rotations=quaternions.to_matrices(quaternions.normalize(scene.quats.index_select(0, rows))),
        log_scales=log_scales,
        log_areas=covariances.log_mean_projected_area(log_scales),
        logits=activations.clamp_logits(scene.logit_opacities.index_select(0, rows)),
        colors=scene.sh0[:, 0].index_select(0, rows) * SH_C0,
    )


def places_in(frames: Kernels, shifts: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Express shifts in frames and in their standard deviations.

    Args:
        frames: One Gaussian for each shift.
        shifts: From its centre, scene units.

    Returns:
        Coordinates along its axes, limited to 1e4.
    """
    turned = torch.einsum("nij,ni->nj", frames.rotations, shifts.to(frames.rotations.dtype))
    units = torch.exp((-frames.log_scales).clamp(-LARGEST_LOG, LARGEST_LOG))
    return (turned * units).clamp(-LARGEST_PLACE, LARGEST_PLACE)


def contrasts_of(some: Kernels, others: Kernels) -> Float[Tensor, "n"]:
    """Tell how far colours are apart.

    Args:
        some: Gaussians.
        others: As many others.

    Returns:
        Root of the mean square over the channels, at most 2.
    """
    return (some.colors - others.colors).square().mean(dim=1).sqrt().clamp_max(2.0)


def extents_in(frames: Kernels, others: Kernels) -> Float[Tensor, "n 3"]:
    """Tell how far Gaussians extend along the axes of frames.

    Args:
        frames: One Gaussian for each of the others.
        others: Gaussians.

    Returns:
        Logarithms of standard deviations in units of those of the frame, from -9 to 9.
    """
    cosines = torch.einsum("nij,nik->njk", frames.rotations, others.rotations)
    largest = others.log_scales.amax(dim=1, keepdim=True)
    scales = torch.exp(others.log_scales - largest)
    squares = (cosines * scales[:, None, :]).square().sum(dim=2)
    logs = 0.5 * activations.positive_log(squares) + largest - frames.log_scales
    return logs.clamp(-9, 9)
