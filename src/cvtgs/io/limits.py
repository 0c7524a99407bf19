"""Limits of each format, and the data of a scene that is lost in it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from cvtgs.text import counted, first_of
from cvtgs.validity import coarse_step, lost_step, writable_rows

SPZ_STEPS = 1 << 23  # of the coordinates of a ``.spz``, on each side of the origin
SCALE_RANGE = (-87.34, 88.7)  # logarithms of the scales that float32 holds with full precision


@dataclass(frozen=True, slots=True, kw_only=True)
class Losses:
    """The data of a scene that a file will not hold.

    Attributes:
        dropped: Data that are left out or clamped, one phrase each; they deserve a warning.
        changed: Data that are rounded or reordered, as in every file of the format; lost comments.
        count: Number of Gaussians in the file.
        sh_degree: Their SH degree in the file.
    """

    dropped: tuple[str, ...]
    changed: tuple[str, ...]
    count: int
    sh_degree: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FormatLimits:
    """The limits of files of a format, and phrases for what is rounded or reordered."""

    sh_degree: int = 3
    antialiased: bool = True  # whether files record that a scene was trained with anti-aliasing
    comments: bool = False
    two_scales: bool = False  # whether files record flatness without comments or anti-aliasing
    ranges: Mapping[str, tuple[float, float]]  # of the values of a tensor, by its name
    fixed_point: bool = False  # of positions, so that coordinates are limited
    changed: tuple[str, ...]
    changed_bands: str = ""  # of the SH above the constant band


LOST_DIGITS = "digits of positions"
_USUAL_SPZ_STEP = 1 / 4096
_SPZ = FormatLimits(  # of versions 3 and 4
    ranges={
        "log_scales": (-10 - 1 / 32, 255 / 16 - 10 + 1 / 32),
        "sh0": (-3.3464, 3.3464),
        "shN": (-1.0625, 1.0625),
    },
    fixed_point=True,
    changed=(
        "positions in steps of 1/4096 (finer in scenes below 8 units, coarser beyond 2,048 units "
        "from the origin)",
        "scales in steps of 6.4 %",
        "rotations in steps of 1/723 per component",
        "opacities in steps of 1/255",
        "colours in steps of 0.0074",
    ),
    changed_bands="view-dependent SH coefficients in steps of 1/16 (degree 1) and 1/8",
)

SPZ_2 = replace(_SPZ, changed=tuple(one.replace("1/723", "1/127") for one in _SPZ.changed))

_GLTF = FormatLimits(
    comments=True,
    ranges={"log_scales": SCALE_RANGE},  # scales are stored as float32
    changed=("scales and opacities as float32 instead of their logarithms and logits",),
)

FORMAT_LIMITS: Mapping[str, FormatLimits] = {  # by suffix; ``.ply`` has none
    ".compressed.ply": FormatLimits(
        comments=True,
        ranges={"log_scales": (-20.0, 20.0), "shN": (-4.0, 4.0)},
        changed=(
            "rows in Morton order",
            "positions and scales in 2048 steps (y: 1024) and colours in 256 steps between the "
            "minimum and maximum of each 256 Gaussians",
            "rotations in steps of 1/723 per component",
            "opacities in steps of 1/255",
        ),
        changed_bands="view-dependent SH coefficients in steps of 1/32",
    ),
    ".spz": _SPZ,
    ".spz.glb": replace(_SPZ, comments=True),
    ".glb": _GLTF,
    ".gltf": _GLTF,
    ".usda": _GLTF,
    ".splat": FormatLimits(
        sh_degree=0,
        antialiased=False,
        # colours in [0, 1] plus half a step; scales are stored as float32
        ranges={"sh0": (-1.7794, 1.7794), "log_scales": SCALE_RANGE},
        changed=(
            "colours and opacities in steps of 1/255",
            "rotations in steps of 1/128 per component",
        ),
    ),
    ".sog": FormatLimits(
        two_scales=True,
        ranges={},
        changed=(
            "rows in Morton order",
            "positions in 65,536 steps of sign(x) log(1 + |x|) between minimum and maximum",
            "scales and colours limited to 256 different values each",
            "rotations in steps of 1/180 per component",
            "opacities in steps of 1/255",
        ),
        changed_bands="view-dependent SH coefficients limited to 256 different values, in a "
        "palette of at least half as many entries as Gaussians and at most 65,536",
    ),
}

_VALUES = {
    "means": "coordinates",
    "log_scales": "log-scales",
    "sh0": "colours (SH band 0)",
    "shN": "view-dependent SH coefficients",
}


def losses_within(scene: GaussianScene, limits: FormatLimits) -> Losses:
    """Report which data of a scene a format loses."""
    changed = list(limits.changed)
    if scene.sh_degree > 0 and limits.changed_bands:
        changed.append(limits.changed_bands)
    others = ANTIALIASED.removed_from(TWO_SCALES.removed_from(scene.comments))
    if others and not limits.comments:
        changed.append(f"without {counted(len(others), 'comment')}")
    return Losses(
        dropped=phrases(dropped_within(scene, limits)),
        changed=tuple(changed),
        count=int(writable_rows(scene).sum()),
        sh_degree=min(scene.sh_degree, limits.sh_degree),
    )


def phrases(dropped: Mapping[str, int]) -> tuple[str, ...]:
    """Return the phrases of :func:`dropped_within` with their numbers of Gaussians."""
    return tuple(
        f"{what} ({counted(count, 'Gaussian')})" if count else what
        for what, count in dropped.items()
    )


def dropped_within(scene: GaussianScene, limits: FormatLimits) -> dict[str, int]:
    """Return the lost data, and of clamped data the number of Gaussians, otherwise 0."""
    dropped = {}
    if scene.extras:
        names = first_of([*map(repr, scene.extras)])
        dropped[f"extra {'columns' if len(scene.extras) > 1 else 'column'} {names}"] = 0
    if scene.sh_degree > limits.sh_degree:
        own = f"the scene has degree {scene.sh_degree}"
        dropped[f"SH bands above degree {limits.sh_degree} ({own})"] = 0
    if scene.antialiased and not limits.antialiased:
        tag = f"the tag '{ANTIALIASED.text}', without which viewers show the scene too sharp"
        dropped[tag] = 0
    keeps_flatness = limits.comments or (limits.two_scales and not scene.antialiased)
    if scene.has_two_scales and not keeps_flatness:
        tag = f"the tag '{TWO_SCALES.text}', without which merged Gaussians of the file are thick"
        dropped[tag] = 0
    if scene.dtype == torch.float64:
        dropped["double precision"] = 0
    rows = writable_rows(scene)
    if not bool(rows.all()):
        count = int((~rows).sum())
        verbs = "is not finite or has" if count == 1 else "are not finite or have"
        dropped[f"{counted(count, 'Gaussian')} that {verbs} no rotation"] = 0
    ranges = _ranges(scene, limits)
    step = lost_step(scene, in_file=True) if scene.dtype == torch.float64 else 0.0
    if limits.fixed_point and (spz_step := ranges["means"][1] / SPZ_STEPS) > _USUAL_SPZ_STEP:
        step = max(step, coarse_step(scene, spz_step))
    if step > 0:
        far = f"steps of {step:.3g} so far from the origin; convert --translate moves a scene"
        dropped[f"{LOST_DIGITS} ({far})"] = 0
    for name, (low, high) in ranges.items():
        held = REST_COUNTS[limits.sh_degree] if name == "shN" else None
        values = getattr(scene, name)[:, :held][rows]
        beyond = (values < low) | (values > high)
        count = int(beyond.reshape(len(values), -1).any(dim=1).sum()) if values.numel() else 0
        if count:
            dropped[f"{_VALUES[name]} outside [{low:.5g}, {high:.5g}], which are clamped"] = count
    return dropped


def clamped_within(scene: GaussianScene, limits: FormatLimits) -> GaussianScene:
    """Return the rows that a file holds, with their values clamped to its ranges."""
    rows = scene.select(writable_rows(scene))
    ranges = _ranges(scene, limits).items()
    return rows.with_tensors({name: getattr(rows, name).clamp(*ends) for name, ends in ranges})


def _ranges(scene: GaussianScene, limits: FormatLimits) -> dict[str, tuple[float, float]]:
    """Return the minimum and maximum of each limited tensor in a file of the scene."""
    ranges = dict(limits.ranges)
    if limits.fixed_point:
        from cvtgs.io.spz import fractional_bits  # noqa: PLC0415 (only where written)

        largest = SPZ_STEPS / (1 << fractional_bits(scene))
        ranges["means"] = (-largest, largest)
    return ranges
