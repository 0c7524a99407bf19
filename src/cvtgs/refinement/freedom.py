"""How far a refinement may move each Gaussian."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.analysis import ambient_visibility
from cvtgs.cvt import nearest_backend
from cvtgs.math.frames import robust_frame
from cvtgs.math.parameters import divide
from cvtgs.scene import GaussianScene
from cvtgs.validity import valid_rows


@torch.no_grad()
def freedom(small: GaussianScene, full: GaussianScene) -> Float[Tensor, "n"]:
    """Return how far each Gaussian of a simplified scene may move, from 0 to 1.

    What is enclosed moves less (:func:`cvtgs.cvt.ambient_visibility`): it may be all one sees from
    elsewhere. A Gaussian that is still what it was in the full scene moves by the share of the mass
    around it that is not its own: where it stands for itself alone it is right from everywhere,
    and whatever a few images gain by moving it is lost in others. What no renderer can draw does
    not move.
    """
    valid = valid_rows(small)
    some = small.select(valid)
    light = ambient_visibility(some.means, some.masses, robust_frame(some.means))
    factors = torch.zeros_like(small.logit_opacities)
    factors[valid] = (light * (1.0 - _own_shares(some, full))).to(small.dtype)
    return factors


def _own_shares(small: GaussianScene, full: GaussianScene) -> Float[Tensor, "n"]:
    """Return the share of the nearest mass that is the Gaussian's own; 0 if it has changed."""
    _, nearest = nearest_backend("auto", small.device)
    labels, _ = nearest(full.means, small.means)
    same = torch.ones_like(labels, dtype=torch.bool)
    for name in ("means", "log_scales", "logit_opacities", "sh0"):
        before, now = getattr(full, name), getattr(small, name)
        same &= (before == now[labels]).reshape(len(full), -1).all(dim=1)
    labels, masses, same = labels.cpu(), full.masses.double().cpu(), same.cpu()
    around = torch.bincount(labels, masses, minlength=len(small))
    own = torch.zeros_like(around)
    own.scatter_reduce_(0, labels[same], masses[same], "amax")
    return divide(own, around).clamp(0.0, 1.0).to(small.device)
