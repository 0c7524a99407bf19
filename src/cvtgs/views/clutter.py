"""Clutter: floaters before the sides of a capture that no image shows."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.scene import GaussianScene
from cvtgs.views.layout import SceneLayout, covering_sample, valid_part
from cvtgs.views.scoring import PIXELS, cameras_at, measure_splats, splat_sizes, splat_widths

_ASKED = 32
_MEASURED = (16, 64)
"""Numbers of positions to look closely from: first a few, then more where these see clutter."""

_SAMPLE = 60_000
_FEW = 20_000
"""Scenes of fewer Gaussians are coarse from everywhere."""

_COARSE = 2.0
"""The finest tenth of an image of clutter is over this many times that of clear images."""

_SUSPECT, _SUSPECTED = 0.03, 0.25
_LARGE, _CLUTTERED = 0.015, 0.4
"""Least size of the finest splats of clutter, robust radii, and least share of such positions."""

_FIELD = 50.0


def split_by_clutter(
    scene: GaussianScene, layout: SceneLayout, eyes: Float[Tensor, "p 3"]
) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "k 3"]]:
    """Return positions with a clear view of the middle, and others that look through clutter.

    A wall or a street is photographed from one side. From all others, large floaters hide it: even
    the finest splats of an image are large. A few of them before an object are no clutter.

    Returns:
        All positions and none; or, in a capture from one side, at most 64 together.
    """
    none = eyes[:0]
    if len(scene) < _FEW:
        return eyes, none
    few = eyes[:: -(-len(eyes) // _ASKED)]
    finest = splat_sizes(layout, _facing_middle(layout, few)).finest
    if not _many(_are_coarse(finest, _SUSPECT), _SUSPECTED):
        return eyes, none  # the sample, which has larger splats, shows as much
    sample, enlargement = covering_sample(valid_part(scene), _SAMPLE)
    widths = splat_widths(sample) * torch.exp(-enlargement[:, 0].double())
    for most in _MEASURED:
        few = eyes[:: -(-len(eyes) // most)]
        sizes = measure_splats(sample, widths, layout.frame.radius, _facing_middle(layout, few))
        coarse = _are_coarse(sizes.finest, _LARGE)
        if not _many(coarse, _CLUTTERED):
            return eyes, none
    return few[~coarse], few[coarse]


def _facing_middle(layout: SceneLayout, eyes: Float[Tensor, "p 3"]) -> Cameras:
    middle = layout.center if layout.room is None else layout.room
    return cameras_at(eyes, middle - eyes, layout.up, size=(PIXELS, PIXELS), field=_FIELD)


def _are_coarse(finest: Float[Tensor, "p"], least: float) -> Bool[Tensor, "p"]:
    return finest > (_COARSE * finest.quantile(0.1)).clamp_min(least)


def _many(mask: Bool[Tensor, "p"], share: float) -> bool:
    return float(mask.double().mean()) >= share
