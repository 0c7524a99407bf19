"""Detection of rows that renderers cannot draw, and standardization of valid rows."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from cvtgs.checks import checked
from cvtgs.devices import chunk_length
from cvtgs.errors import DroppedDataWarning, InvalidSceneError, warn
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene

__all__ = ["CheckedScene", "check_rows", "invalid_rows", "standardized"]

UNIT_TOLERANCE = 1e-5  # largest difference from 1 of the squared length of a unit quaternion
MAX_MEAN = torch.finfo(torch.float32).max  # files and renderers hold float32
MAX_LOG_SCALE = 88.72  # its exponential is finite in float32
_FAR = 1e6  # distance from the origin at which float32 has a resolution of a sixteenth of a unit
_HARMLESS = 1 / 16  # share of a standard deviation by which a Gaussian may move unseen


class CheckedScene(NamedTuple):
    """The valid rows of a scene, and the number of dropped rows.

    Attributes:
        scene: The valid Gaussians.
        invalid_rows: Number of dropped rows, by the attribute that is NaN, infinite or zero.
        invalid_count: Number of dropped rows.
        is_valid: ``(n,)`` mask of the valid rows; None if no row was dropped.
    """

    scene: GaussianScene
    invalid_rows: dict[str, int]
    invalid_count: int
    is_valid: Bool[Tensor, "n"] | None = None


@checked
def check_rows(scene: GaussianScene) -> CheckedScene:
    """Drop invalid rows (:func:`invalid_rows`), and warn about them.

    Args:
        scene: The Gaussians.

    Returns:
        The valid rows, and counts of the dropped ones.

    Raises:
        InvalidSceneError: No row is valid.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> checked = check_rows(make("object", 100, seed=0))
        >>> len(checked.scene), checked.invalid_count
        (100, 0)
    """
    if len(scene) == 0:
        raise InvalidSceneError("a scene needs at least one Gaussian to be simplified; found none.")
    invalid = invalid_rows(scene)
    if not invalid:
        return CheckedScene(scene, {}, 0)
    dropped = any_row(scene, invalid)
    count = int(dropped.sum())
    reasons = {name: int(mask.sum()) for name, mask in invalid.items()}
    if count == len(scene):
        raise InvalidSceneError(
            f"none of the {len(scene):,} Gaussians is valid; "
            f"found NaN, infinite or zero values in {_listed(reasons)}."
        )
    warn_of_dropped(count, len(scene), reasons)
    return CheckedScene(scene.select(~dropped), reasons, count, ~dropped)


def warn_of_dropped(count: int, total: int, reasons: Mapping[str, int]) -> None:
    """Warn that invalid rows were dropped; the reasons are numbers of rows by attribute."""
    warn(
        f"dropped {count:,} of {total:,} Gaussians with NaN, infinite or zero values "
        f"({_listed(reasons)}).",
        DroppedDataWarning,
    )


def _listed(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {number:,}" for name, number in reasons.items())


def invalid_rows(scene: GaussianScene) -> dict[str, Bool[Tensor, "n"]]:
    """Find the rows that no renderer can draw.

    NaN or infinite means, scales and SH coefficients, NaN opacities, and quaternions that are
    zero, NaN or infinite are invalid. Means and scales beyond float32 count as infinite.
    Log-scales of minus infinity, which are scales of 0, are invalid too. Infinite opacity logits
    are valid.

    Args:
        scene: Any scene.

    Returns:
        One mask per attribute that has bad rows; empty for a clean scene.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> invalid_rows(scene("object", 10, sh_degree=0, seed=0))
        {}
    """
    masks: dict[str, Tensor] = {}
    longest = chunk_length(1 << 16, scene.device)
    for name, values in scene.tensors().items():
        if name == "logit_opacities":
            masks[name] = values.isnan()
            continue
        # Avoids a boolean array with an entry per value: a finite number times 0 is 0, any other
        # is NaN, and a sum with a NaN is NaN.
        flat = values.flatten(start_dim=1)
        parts = flat.split(max(1 << 16, longest // max(1, flat.shape[1])))
        masks[name] = torch.cat([(part * 0).sum(dim=1) != 0 for part in parts])
    masks["quats"] |= (scene.quats == 0).all(dim=1)
    if scene.dtype == torch.float64:
        masks["means"] |= (scene.means.abs() > MAX_MEAN).any(dim=1)
    masks["log_scales"] |= (scene.log_scales > MAX_LOG_SCALE).any(dim=1)
    # All masks at once, so that the host synchronises with the device only once.
    any_bad = torch.stack([mask.any() for mask in masks.values()]).tolist()
    return {name: mask for (name, mask), bad in zip(masks.items(), any_bad, strict=True) if bad}


def valid_rows(scene: GaussianScene) -> Bool[Tensor, "n"]:
    """Return a mask of the rows that renderers can draw."""
    return ~any_row(scene, invalid_rows(scene))


def any_row(scene: GaussianScene, masks: Mapping[str, Bool[Tensor, "n"]]) -> Bool[Tensor, "n"]:
    """Return a mask of the rows of a scene that any mask names."""
    nothing = torch.zeros(len(scene), dtype=torch.bool, device=scene.device)
    return torch.stack([nothing, *masks.values()]).any(dim=0)


def valid_part(scene: GaussianScene) -> GaussianScene:
    """Return the rows that renderers can draw, without a warning; the scene itself if all are."""
    valid = valid_rows(scene)
    return scene if bool(valid.all()) else scene.select(valid)


def writable_rows(scene: GaussianScene) -> Bool[Tensor, "n"]:
    """Return a mask of the rows that compact formats can hold."""
    rows = ~scene.logit_opacities.isnan() & (scene.quats != 0).any(dim=1)
    for name, tensor in scene.tensors().items():
        if name != "logit_opacities" and tensor.numel():
            rows &= tensor.float().isfinite().reshape(len(scene), -1).all(dim=1)
    return rows


def with_finite_opacities(scene: GaussianScene) -> GaussianScene:
    """Replace infinite opacity logits, which are valid input, by those of 1e-6 and 1 - 1e-6."""
    logits = scene.logit_opacities
    infinite = logits.isinf()
    if not bool(infinite.any()):
        return scene
    finite = torch.where(infinite, parameters.clamp_logits(logits), logits)
    return scene.with_tensors({"logit_opacities": finite})


def standardized(scene: GaussianScene) -> GaussianScene:
    """Clamp opacities to strictly inside (0, 1), and scales to finite ones; normalize quaternions.

    Args:
        scene: A scene with valid rows.

    Returns:
        The scene; rows that already satisfy this are unchanged, bit for bit.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 10, sh_degree=0, seed=0)
        >>> bool((standardized(scene).quats == scene.quats).all())
        True
    """
    squared_norms = scene.quats.double().square().sum(dim=1)
    is_unit = ((squared_norms - 1).abs() <= UNIT_TOLERANCE)[:, None]
    quats = torch.where(is_unit, scene.quats, parameters.normalize_quats(scene.quats))
    logits = parameters.clamp_logits(scene.logit_opacities)
    log_scales = scene.log_scales.clamp(max=MAX_LOG_SCALE)
    tensors = {"quats": quats, "log_scales": log_scales, "logit_opacities": logits}
    return scene.with_tensors(tensors)


def lost_step(scene: GaussianScene, *, in_file: bool = False) -> float:
    """Return the step between float32 coordinates far from the origin; 0 where it is harmless."""
    if len(scene) == 0 or (scene.dtype == torch.float64 and not in_file):  # files have float32
        return 0.0
    far = float(scene.means.nanmedian(dim=0).values.abs().amax())
    if not _FAR <= far < math.inf:
        return 0.0
    return coarse_step(scene, 2.0 ** (math.floor(math.log2(far)) - 23))


def coarse_step(scene: GaussianScene, step: float) -> float:
    """Return a step between coordinates; 0 if the median standard deviation is far larger."""
    typical = math.exp(float(scene.log_scales.amax(dim=1).nanmedian().clamp(max=MAX_LOG_SCALE)))
    return step if step > _HARMLESS * typical else 0.0


def warn_of_lost_digits(scene: GaussianScene) -> None:
    """Warn if a scene is so far from its origin that float32 loses small differences."""
    step = lost_step(scene)
    if step:
        middle = scene.means.nanmedian(dim=0).values.double()
        shift = ",".join(f"{-round(value)}" for value in middle.tolist())
        warn(
            f"positions lie {float(middle.abs().amax()):.3g} from the origin, where float32 only "
            f"resolves steps of {step:.3g}: precision is already lost. Write the scene again from "
            f"its source, with positions shifted by {shift} before they become float32, and keep a "
            f"record of the shift.",
        )
