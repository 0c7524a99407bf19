"""What a format holds, and what of a scene it therefore loses."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from cvtgs.io.arrays import writable_rows
from cvtgs.scene import ANTIALIASED_TAG, GaussianScene

_NAMES = {
    "means": "centre",
    "log_scales": "logarithm of a scale",
    "sh0": "constant SH band",
    "shN": "view-dependent SH coefficient",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Losses:
    """What a file will not hold of a scene.

    Attributes:
        dropped: What is left out or cut off, a phrase each; worth a warning.
        changed: What is rounded or reordered, as in every file of the format.
        count: Gaussians that will be in the file.
        sh_degree: Their SH degree there.
    """

    dropped: tuple[str, ...]
    changed: tuple[str, ...]
    count: int
    sh_degree: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Holds:
    """What files of a format hold.

    Attributes:
        sh_degree: The highest SH band.
        tag: Whether they say that a scene was trained with anti-aliasing.
        comments: Whether they hold other comments.
        limits: Least and largest value of a tensor, by its name.
        reach: Gives the largest coordinate that a file of this scene holds; None if any fits.
        changed: What is rounded or reordered.
    """

    sh_degree: int
    tag: bool
    comments: bool = False
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reach: Callable[[GaussianScene], float] | None = None
    changed: tuple[str, ...] = ()


def losses_of(scene: GaussianScene, holds: Holds) -> Losses:
    """Report what of a scene will be lost in a file."""
    changed = list(holds.changed)
    others = [line for line in scene.comments if ANTIALIASED_TAG.lower() not in line.lower()]
    if others and not holds.comments:
        changed.append(f"without {_counted(len(others), 'comment')}")
    return Losses(
        dropped=tuple(_dropped(scene, holds)),
        changed=tuple(changed),
        count=int(writable_rows(scene).sum()),
        sh_degree=min(scene.sh_degree, holds.sh_degree),
    )


def _dropped(scene: GaussianScene, holds: Holds) -> Iterator[str]:
    if scene.extras:
        names = ", ".join(map(repr, scene.extras))
        yield f"extra {'columns' if len(scene.extras) > 1 else 'column'} {names}"
    if scene.sh_degree > holds.sh_degree:
        yield f"SH bands above degree {holds.sh_degree} (the scene has degree {scene.sh_degree})"
    if scene.antialiased and not holds.tag:
        yield f"the tag '{ANTIALIASED_TAG}', without which viewers show the scene too sharp"
    if scene.dtype == torch.float64:
        yield "double precision"
    rows = writable_rows(scene)
    if not bool(rows.all()):
        yield f"{_counted(int((~rows).sum()), 'Gaussian')} that are not finite or have no rotation"
    limits = dict(holds.limits)
    if holds.reach is not None:
        reach = holds.reach(scene)
        limits["means"] = (-reach, reach)
    for name, (low, high) in limits.items():
        held = (0, 3, 8, 15)[holds.sh_degree] if name == "shN" else None
        beyond = _beyond(getattr(scene, name)[:, :held][rows], low, high)
        if beyond:
            yield (
                f"what lies beyond [{low:.5g}, {high:.5g}] in a {_NAMES[name]} of "
                f"{_counted(beyond, 'Gaussian')}"
            )


def _beyond(values: Tensor, low: float, high: float) -> int:
    wrong = (values < low) | (values > high)
    return int(wrong.reshape(len(values), -1).any(dim=1).sum()) if values.numel() else 0


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"
