"""The MergeNet of CVT-GS as published: descriptor, network and residuals."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from cvtgs.cells import Partition
from cvtgs.config.base import Record
from cvtgs.math import parameters
from cvtgs.math.segments import segment_ids, segment_max, segment_sum
from cvtgs.mergenet.model import CellNetwork, CellWidth, Linear, MergeNet, Width, two_layers
from cvtgs.scene import GaussianScene

SH_COEFFICIENTS = 16
"""Coefficients per colour channel of degree 3; scenes of a lower degree have zeros for the rest."""

PUBLISHED_FEATURES = 3 + 3 + 4 + 1 + 1 + 3 * SH_COEFFICIENTS
"""Number of features of a member: position, log scale, quaternion, opacity, share, SH."""

PUBLISHED_RESIDUALS = 3 + 3 + 3 + 1 + 3 * SH_COEFFICIENTS
"""Number of outputs of the decoder: position, log scale, rotation, opacity logit, SH."""

LARGEST_FEATURE = 50.0
"""Positions and differences of log scales are clamped to this, so that all values stay finite."""

LARGEST_LOG = 80.0  # limit of a logarithm, whose exponential float32 holds


class PublishedArchitecture(Record):
    """The architecture of a MergeNet as published; the publication does not give its widths.

    Attributes:
        kind: Distinguishes it from :class:`cvtgs.mergenet.MergeNet`.
        member_features: Number of features of a member.
        width: Units of the layers of members.
        cell_width: Units of the layers of the decoder.
    """

    kind: Literal["published"] = "published"
    member_features: int = PUBLISHED_FEATURES
    width: Width = 64
    cell_width: CellWidth = 128


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PublishedDescriptors:
    """The input of the published network: members of some cells, relative to the merged Gaussian.

    Attributes:
        members: ``(n, 60)`` position in the frame and the standard deviations of the merged
            Gaussian (3), log scales minus those of the merged one (3), the relative quaternion of
            non-negative real part (4), opacity (1), its share of the sum of opacities of the cell
            (1), and SH coefficients of all bands minus those of the merged one (48).
        shares: ``(n,)`` the same shares; those of one cell sum to 1.
        offsets: ``(m + 1,)`` start of each cell, and the end of the last one.
    """

    members: Float[Tensor, "n 60"]
    shares: Float[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PublishedResiduals:
    """Unlimited changes of the merged Gaussians, else as :class:`cvtgs.mergenet.Residuals`.

    Attributes:
        d_sh: ``(m, 16, 3)`` changes of the SH coefficients of all bands.
    """

    d_means: Float[Tensor, "m 3"]
    d_log_scales: Float[Tensor, "m 3"]
    d_rotvecs: Float[Tensor, "m 3"]
    d_logit_opacities: Float[Tensor, "m"]
    d_sh: Float[Tensor, "m 16 3"]


def describe_published(
    scene: GaussianScene, merged: GaussianScene, part: Partition, *, cells: Int[Tensor, "m"]
) -> PublishedDescriptors:
    """Compute the descriptors of some cells as CVT-GS does.

    Memory: about ``1 kB`` per member.
    """
    rows, ids = part.order, segment_ids(part.offsets, len(part.order))
    own = cells.index_select(0, ids)
    own_quats = parameters.normalize_quats(merged.quats).index_select(0, own)
    axes = parameters.quats_to_matrices(own_quats)
    shifts = scene.means.index_select(0, rows) - merged.means.index_select(0, own)
    log_scales = merged.log_scales.index_select(0, own)
    units = torch.exp((-log_scales).clamp_max(LARGEST_LOG))
    positions = torch.einsum("nji,nj->ni", axes, shifts) * units
    quats = parameters.normalize_quats(scene.quats.index_select(0, rows))
    relative = parameters.multiply_quats(own_quats * own_quats.new_tensor([1, -1, -1, -1]), quats)
    relative = torch.where(relative[:, :1] < 0, -relative, relative)
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, rows))
    growths = scene.log_scales.index_select(0, rows) - log_scales
    totals = segment_sum(opacities.double(), part.offsets).to(opacities.dtype)
    shares = opacities / totals.index_select(0, ids)
    columns = [
        positions.clamp(-LARGEST_FEATURE, LARGEST_FEATURE),
        growths.clamp(-LARGEST_FEATURE, LARGEST_FEATURE),
        relative,
        opacities[:, None],
        shares[:, None],
        (scene.sh0.index_select(0, rows) - merged.sh0.index_select(0, own)).flatten(1),
        (scene.shN.index_select(0, rows) - merged.shN.index_select(0, own)).flatten(1),
    ]
    members = torch.cat(columns, dim=1)
    missing = PUBLISHED_FEATURES - members.shape[1]
    return PublishedDescriptors(
        members=nn.functional.pad(members, (0, missing)), shares=shares, offsets=part.offsets
    )


class PublishedMergeNet(CellNetwork):
    """MergeNet as CVT-GS (Li et al. 2026) describes it.

    A pointwise network shared by all members is pooled by mean, maximum and opacity. A decoder,
    whose last layer starts at zero, returns unlimited residuals of position, log scale, rotation,
    opacity and all SH coefficients. Neither neighbours nor the size of a cell are inputs.
    Widths and activations, which the publication leaves open, are ours.

    Args:
        architecture: Kind and layer sizes.

    Example:
        >>> net = PublishedMergeNet(PublishedArchitecture())
        >>> sum(parameter.numel() for parameter in net.parameters())
        56762
    """

    sees_surroundings = False

    def __init__(self, architecture: PublishedArchitecture) -> None:
        super().__init__()
        self.architecture = architecture
        width, cell_width = architecture.width, architecture.cell_width
        self.member_layers: nn.Sequential = two_layers(architecture.member_features, width)
        self.decoder: nn.Sequential = two_layers(3 * width, cell_width)
        self.residuals: Linear = Linear(cell_width, PUBLISHED_RESIDUALS)
        nn.init.zeros_(self.residuals.weight)
        nn.init.zeros_(self.residuals.bias)

    def forward(self, descriptors: PublishedDescriptors) -> PublishedResiduals:
        """Predict the residuals of some cells.

        Args:
            descriptors: Any number of cells, each with at least one member.

        Returns:
            Residuals of each cell.
        """
        offsets = descriptors.offsets
        members = self.member_layers(descriptors.members)
        pooled = [
            segment_sum(members, offsets) / offsets.diff()[:, None],
            segment_max(members, offsets),
            segment_sum(members, offsets, descriptors.shares),
        ]
        changes = self.residuals(self.decoder(torch.cat(pooled, dim=1)))
        return PublishedResiduals(
            d_means=changes[:, :3],
            d_log_scales=changes[:, 3:6],
            d_rotvecs=changes[:, 6:9],
            d_logit_opacities=changes[:, 9],
            d_sh=changes[:, 10:].unflatten(1, (SH_COEFFICIENTS, 3)),
        )


Net = MergeNet | PublishedMergeNet
"""A network of either kind, of this library or as published."""
