"""Points that lie exactly on the one before share its search of the nearest site."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.cvt.nearest import NearestSite


def once_per_place(nearest: NearestSite) -> NearestSite:
    """Search for each place only once, with the same answers."""

    def search(points: Tensor, sites: Tensor) -> tuple[Tensor, Tensor]:
        is_first = first_of_each(points)
        labels, squared = nearest(points[is_first], sites)
        places = is_first.cumsum(0) - 1
        return labels[places], squared[places]

    return search


def first_of_each(points: Float[Tensor, "n d"]) -> Bool[Tensor, "n"]:
    """Return which points differ from the one before."""
    first = torch.ones(len(points), dtype=torch.bool, device=points.device)
    first[1:] = points[1:, 0] != points[:-1, 0]
    maybe = (~first).nonzero()[:, 0]
    first[maybe] = (points[maybe] != points[maybe - 1]).any(dim=1)
    return first
