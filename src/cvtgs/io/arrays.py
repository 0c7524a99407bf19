"""Scenes as numpy arrays, and the conversions of parameters that compact formats share."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from cvtgs.errors import InvalidSceneError
from cvtgs.io.limits import SCALE_RANGE
from cvtgs.math import parameters
from cvtgs.math.frames import morton_order
from cvtgs.math.spherical_harmonics import REST_COUNTS, SH_C0
from cvtgs.scene import GaussianScene
from cvtgs.validity import writable_rows

Floats = NDArray[np.float32]

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
HALF_RANGE = np.float32(np.sqrt(0.5))  # bounds the three smaller components of a unit quaternion


class Arrays(NamedTuple):
    """The standard tensors of a scene, float32, on the CPU, and the values that files store."""

    means: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]
    log_scales: Float[np.ndarray, "n 3"]
    logit_opacities: Float[np.ndarray, "n"]
    sh0: Float[np.ndarray, "n 3"]
    shN: Float[np.ndarray, "n k 3"]  # noqa: N815 (the name that scenes give it)

    @classmethod
    def of(cls, scene: GaussianScene, *, sh_degree: int = 3) -> Self:
        """Return the rows of a scene that a compact format can hold."""
        rows = writable_rows(scene)
        if not bool(rows.any()):
            raise InvalidSceneError(
                f"a scene to write must hold a Gaussian with finite values, found 0 of "
                f"{len(scene):,}."
            )
        whole = bool(rows.all())
        own = {
            name: (tensor if whole else tensor[rows]).detach().cpu().float().numpy()
            for name, tensor in scene.tensors().items()
        }
        own["quats"] = unit_quats(own["quats"])
        own["sh0"] = own["sh0"][:, 0]
        own["shN"] = own["shN"][:, : REST_COUNTS[sh_degree]]
        return cls(**own)

    def scene(self, *, comments: Sequence[str] = ()) -> GaussianScene:
        """Build a scene."""
        tensors = {
            name: torch.from_numpy(np.require(values, np.float32, ["C", "W"]))
            for name, values in self._asdict().items()
        }
        tensors["sh0"] = tensors["sh0"][:, None, :]
        return GaussianScene(**tensors, extras={}, comments=tuple(comments), layout=())

    def chunks(self, rows: int) -> Iterator["Arrays"]:
        """Yield consecutive rows, at most so many at a time, without copying them."""
        for start in range(0, len(self.means), rows):
            yield Arrays(*(values[start : start + rows] for values in self))

    @property
    def scales(self) -> Float[np.ndarray, "n 3"]:
        """Scales of clamped logarithms, as formats with scales store them."""
        return np.asarray(np.exp(np.clip(self.log_scales, *SCALE_RANGE)))

    @property
    def opacities(self) -> Float[np.ndarray, "n"]:
        """Opacities from 0 to 1."""
        return parameters.opacity_from_logit(torch.from_numpy(self.logit_opacities)).numpy()

    @property
    def opacity_bytes(self) -> UInt8[np.ndarray, "n"]:
        """Opacities as bytes."""
        return to_bytes(255 * self.opacities)

    @property
    def colors(self) -> Float[np.ndarray, "n 3"]:
        """Colours of the constant SH band, the inverse of :func:`sh0_of_colors`."""
        return np.float32(0.5) + np.float32(SH_C0) * self.sh0


def unit_quats(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Scale quaternions to unit length; zero becomes the identity, infinity becomes NaN."""
    with np.errstate(invalid="ignore"):
        largest = np.abs(quats).max(axis=1, keepdims=True)
        nothing = largest == 0
        scaled = np.where(nothing, quats.dtype.type(0), quats / np.where(nothing, 1, largest))
        scaled[nothing[:, 0], 0] = 1
        length = np.linalg.norm(scaled, axis=1, keepdims=True)
        return np.asarray(scaled / length, dtype=quats.dtype)


def to_bytes(values: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Round to the nearest integer from 0 to 255."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def log_scales_of(scales: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the logarithms of scales; those below the smallest float32 count as that."""
    with np.errstate(invalid="ignore"):  # of NaN; rows are checked later
        return np.asarray(np.log(np.maximum(scales, np.finfo(np.float32).tiny)))


def logits_of(opacities: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the logits of opacities."""
    return parameters.logit_from_opacity(torch.from_numpy(opacities)).numpy()


def logits_of_bytes(opacities: UInt8[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the logits of opacities that are stored as bytes."""
    return logits_of(opacities.astype(np.float32) / np.float32(255))


def sh0_of_colors(colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the constant SH band of colours."""
    return (colors - np.float32(0.5)) / np.float32(SH_C0)


def drop_largest(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Remove the component of largest magnitude, after flipping signs to make it positive."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(quats[rows, largest] < 0, -1, 1).astype(quats.dtype)
    others = quats[rows[:, None], _OTHERS[largest]] * signs[:, None]
    return largest, others


def restore_largest(
    largest: Int[np.ndarray, "n"], others: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4"]:
    """Restore the largest component, the inverse of :func:`drop_largest`."""
    quats = np.empty((len(others), 4), others.dtype)
    rows = np.arange(len(others))
    quats[rows[:, None], _OTHERS[largest]] = others
    squares = np.einsum("ij,ij->i", others, others)
    quats[rows, largest] = np.sqrt(np.maximum(1 - squares, 0))
    return quats


def in_radii(means: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return positions about the middle of the scene, in radii that contain 90 %; all finite."""
    quarters = means / 4  # exact, and no difference or sum of two of them overflows
    away = quarters - np.median(quarters, axis=0)
    radius = np.quantile(np.abs(away).max(axis=1), 0.9) or 0.25
    with np.errstate(over="ignore"):
        inside: Float[np.ndarray, "n 3"] = np.nan_to_num(away / np.float32(radius))
    return inside


def morton_rows(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Return the order along a Morton curve; distant Gaussians do not coarsen it."""
    away = in_radii(means)
    shrunk = np.sign(away) * np.log1p(np.abs(away))
    return morton_order(torch.from_numpy(shrunk)).numpy()
