"""GaussianScene: the Gaussians of a scene in stored (not activated) parameters."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any, BinaryIO, Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.checks import Rows, row_numbers
from cvtgs.counts import whole_number
from cvtgs.devices import row_chunks, usable_device
from cvtgs.errors import InvalidArgumentError, InvalidSceneError
from cvtgs.math import parameters, spherical_harmonics
from cvtgs.tags import ANTIALIASED, TWO_SCALES
from cvtgs.text import counted, shown

FLAT_LOG_SCALE = -20.0
"""Third log-scale of Gaussians with two scales (2DGS): two billionths of a scene unit."""
NORMALS = ("nx", "ny", "nz")
"""Extra columns that are a direction. 3DGS writes zeros, which are not read."""
_CHUNK = 1 << 16
_NOT_INDEXABLE = (torch.uint16, torch.uint32, torch.uint64)  # torch cannot select their rows
_TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


def _are_texts(values: object) -> bool:
    return isinstance(values, tuple | list) and all(isinstance(value, str) for value in values)


def _are_pairs(values: object) -> bool:
    if not isinstance(values, tuple | list):
        return False
    return all(_are_texts(value) and len(value) == 2 for value in values)


def _rebuilt(kind: type["GaussianScene"], values: dict[str, Any]) -> "GaussianScene":
    """Return a scene of its fields, from a pickle or for a deep copy."""
    return kind(**values)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class GaussianScene:
    """A 3D Gaussian Splatting scene of ``n`` Gaussians, as files and optimisers store it.

    Only shapes, dtypes and devices are checked, not values: a scene may hold the NaN rows of its
    file. :func:`cvtgs.validity.invalid_rows` finds unusable rows.

    Attributes:
        means: ``(n, 3)`` centres, scene units.
        quats: ``(n, 4)`` rotations, w first, not necessarily of unit length.
        log_scales: ``(n, 3)`` natural logarithms of the standard deviations, scene units.
        logit_opacities: ``(n,)`` logits of the opacities; infinities are valid.
        sh0: ``(n, 1, 3)`` constant SH band of red, green, blue.
        shN: ``(n, k, 3)`` view-dependent SH bands, k in {0, 3, 8, 15}.
        extras: Further columns ``(n,)`` by name, of floats, bool, uint8 or signed integers; carried
            along.
        comments: Comment lines of the file, such as ``SplatRenderMode: mip``.
        layout: Property names and types of the file, in order; empty if there was no file.
            ``cvtgs.io`` writes the scene with the same layout; a file without a third scale holds
            flat Gaussians.

    Raises:
        InvalidSceneError: Shapes, dtypes or devices do not fit together, or a comment is no text.

    Example:
        >>> scene = GaussianScene(
        ...     means=torch.zeros(2, 3), quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        ...     log_scales=torch.zeros(2, 3), logit_opacities=torch.zeros(2),
        ...     sh0=torch.zeros(2, 1, 3), shN=torch.zeros(2, 0, 3),
        ... )
        >>> len(scene), scene.sh_degree
        (2, 0)
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 3"]
    logit_opacities: Float[Tensor, "n"]
    sh0: Float[Tensor, "n 1 3"]
    shN: Float[Tensor, "n k 3"]  # noqa: N815 (the name that gsplat gives it)
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    comments: tuple[str, ...] = ()
    layout: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        """Check that shapes, dtypes and devices fit together."""
        tensors = self.tensors()
        for name, tensor in tensors.items():
            if not isinstance(tensor, Tensor):
                raise InvalidSceneError(
                    f"{name} must be a torch.Tensor, found {type(tensor).__name__}; "
                    f"use cvtgs.from_dict for numpy arrays."
                )
        n = len(self.means) if self.means.ndim else 0
        dtype, device = self.means.dtype, self.means.device
        if dtype not in (torch.float32, torch.float64):
            raise InvalidSceneError(f"means must be float32 or float64, found {dtype}.")
        bands = self.shN.shape[1] if self.shN.ndim == 3 else 0
        shapes = (n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, bands, 3)
        for (name, tensor), shape in zip(tensors.items(), shapes, strict=True):
            if tuple(tensor.shape) != shape:
                wanted = {"means": "(n, 3)", "shN": f"({n}, k, 3)"}.get(name, shape)
                raise InvalidSceneError(
                    f"{name} must have shape {wanted}, found {tuple(tensor.shape)}."
                )
            if tensor.dtype != dtype or tensor.device != device:
                raise InvalidSceneError(
                    f"{name} must be {dtype} on {device} like means, "
                    f"found {tensor.dtype} on {tensor.device}."
                )
        if bands not in spherical_harmonics.REST_COUNTS:
            raise InvalidSceneError(
                f"shN must hold 0, 3, 8 or 15 coefficients per channel, found {bands}."
            )
        names = tuple(self.extras) if isinstance(self.extras, Mapping) else self.extras
        for wanted, lines, fits in (
            ("comments must be a tuple of texts", self.comments, _are_texts),
            ("names of extra columns must be a tuple of texts", names, _are_texts),
            ("layout must be a tuple of pairs of texts", self.layout, _are_pairs),
        ):
            if not fits(lines):
                raise InvalidSceneError(f"{wanted}, found {shown(lines)}.")
        for name, column in self.extras.items():
            found = getattr(column, "dtype", type(column).__name__)
            if not isinstance(column, Tensor) or found in _NOT_INDEXABLE:
                wanted = "a tensor of floats, bool, uint8 or signed integers"
                raise InvalidSceneError(f"extra column {name!r} must be {wanted}, found {found}.")
            if column.shape != (n,) or column.device != device:
                raise InvalidSceneError(
                    f"extra column {name!r} must have shape ({n},) on {device}, "
                    f"found {tuple(column.shape)} on {column.device}."
                )
        object.__setattr__(self, "extras", MappingProxyType(dict(self.extras)))
        object.__setattr__(self, "comments", tuple(self.comments))
        object.__setattr__(self, "layout", tuple(map(tuple, self.layout)))

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return int(self.means.shape[0])

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the axes of each Gaussian, scene units."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Opacities in [1e-6, 1 - 1e-6]."""
        return parameters.opacity_from_logit(self.logit_opacities)

    @property
    def areas(self) -> Float[Tensor, "n"]:
        """Mean projected areas of the one-sigma ellipsoids, squared scene units, float64."""
        areas = self.log_scales.new_empty(len(self.means), dtype=torch.float64)
        for part in row_chunks(len(areas), _CHUNK, areas.device):
            areas[part] = parameters.mean_projected_area(torch.exp(self.log_scales[part].double()))
        return areas

    @property
    def masses(self) -> Float[Tensor, "n"]:
        """Opacity times mean projected area, squared scene units, float64."""
        return self.areas.mul_(self.opacities)

    @property
    def sh(self) -> Float[Tensor, "n k_plus_1 3"]:
        """All SH coefficients, the constant band first."""
        return torch.cat([self.sh0, self.shN], dim=1)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return spherical_harmonics.REST_COUNTS.index(self.shN.shape[1])

    @property
    def antialiased(self) -> bool:
        """Whether the scene was trained with anti-aliasing and must be rendered with it."""
        return ANTIALIASED.is_in(self.comments)

    @property
    def has_two_scales(self) -> bool:
        """Whether the file had surfels of 2DGS (Huang et al. 2024): two scales, or their tag."""
        has_third = not self.layout or "scale_2" in dict(self.layout)
        return not has_third or TWO_SCALES.is_in(self.comments)

    @property
    def device(self) -> torch.device:
        """The device that holds every tensor."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """float32 or float64."""
        return self.means.dtype

    def tensors(self) -> dict[str, Tensor]:
        """Return the six standard tensors by name: means, quats and so on, in this order."""
        return {name: getattr(self, name) for name in _TENSORS}

    def select(self, rows: Rows) -> Self:
        """Return some of the Gaussians, with all their tensors and extra columns.

        ``scene[rows]`` does the same.

        Args:
            rows: A slice, row numbers, of which negative ones count from the end, or a mask.

        Returns:
            A scene with a copy of those rows.

        Raises:
            InvalidArgumentError: The rows do not fit; numbers are checked on a CPU only.
        """
        chosen = row_numbers(rows, len(self), things="Gaussians", device=self.device)
        return self.with_tensors(
            {name: tensor.index_select(0, chosen) for name, tensor in self.tensors().items()},
            {name: column.index_select(0, chosen) for name, column in self.extras.items()},
        )

    __getitem__ = select

    def save(
        self,
        path: str | os.PathLike[str] | BinaryIO,
        *,
        format: str | None = None,
        overwrite: bool = False,
        axes: str | None = None,
        spz_version: Literal[2, 3, 4] = 3,
    ) -> None:
        """Write the scene to a file, as :func:`cvtgs.save` does.

        Args:
            path: Path of the file, whose suffix chooses the format, or an open binary file.
            format: Suffix of the format, if the file name does not have it.
            overwrite: Whether an existing file may be replaced.
            axes: Directions of x, y and z in the file; None for the axes of the format.
            spz_version: Version of the format in a ``.spz``: 2, 3 or 4, as for :func:`cvtgs.save`.
        """
        resolve_name("cvtgs.io.formats:save")(
            self, path, format=format, overwrite=overwrite, axes=axes, spz_version=spz_version
        )

    def with_sh_degree(self, degree: int) -> Self:
        """Drop the SH bands above a degree, which makes files of the scene smaller.

        Args:
            degree: 0 to 3.

        Returns:
            The same Gaussians with fewer bands; the same object if there are none above the degree.

        Raises:
            InvalidArgumentError: The degree is not from 0 to 3.
        """
        if whole_number(degree) not in range(len(spherical_harmonics.REST_COUNTS)):
            raise InvalidArgumentError(f"the SH degree must be from 0 to 3, found {degree!r}.")
        if degree >= self.sh_degree:
            return self
        count = spherical_harmonics.REST_COUNTS[degree]
        # A contiguous copy, since sums over cells read whole rows.
        return self.with_tensors({"shN": self.shN[:, :count].contiguous()})

    def with_tensors(
        self,
        tensors: Mapping[str, Tensor] | None = None,
        extras: Mapping[str, Tensor] | None = None,
        **named: Tensor,
    ) -> Self:
        """Return a scene with some tensors replaced, and the comments and layout of this one.

        Args:
            tensors: Some or all of the six standard tensors by name.
            extras: All extra columns; None for those of this scene.
            named: Standard tensors by keyword: ``scene.with_tensors(sh0=colors)``.

        Returns:
            The new scene.

        Raises:
            InvalidSceneError: A tensor name is unknown, or tensors do not fit together.
        """
        if not isinstance(tensors, Mapping | None):
            raise InvalidSceneError(f"tensors must be a mapping by name, found {shown(tensors)}.")
        given = {**(tensors or {}), **named}
        unknown = sorted(given.keys() - set(_TENSORS))
        if unknown:
            raise InvalidSceneError(
                f"tensors of a scene are {', '.join(_TENSORS)}, found {unknown[0]}; give other "
                f"columns as extras."
            )
        changes: dict[str, Any] = {**given, "extras": self.extras if extras is None else extras}
        return replace(self, **changes)

    def to(self, device: torch.device | str) -> Self:
        """Move the scene to a device.

        Args:
            device: The target device.

        Returns:
            The same object if it is already there, else a copy.

        Raises:
            DeviceError: The device cannot be used.
        """
        target = usable_device(device)
        if target == self.device:
            return self
        return self.with_tensors(
            {name: tensor.to(target) for name, tensor in self.tensors().items()},
            {name: column.to(target) for name, column in self.extras.items()},
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling and deep copies, which mapping proxies do not."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.init}
        values["extras"] = dict(self.extras)
        return _rebuilt, (type(self), values)

    def __repr__(self) -> str:
        """Return count, degree, dtype and device, not the values."""
        return (
            f"GaussianScene({counted(len(self), 'Gaussian')}, SH degree {self.sh_degree}, "
            f"{str(self.dtype).removeprefix('torch.')}, {self.device})"
        )

    def _repr_html_(self) -> str:
        """Return HTML with an image and facts, for notebooks."""
        return str(resolve_name("cvtgs.notebooks:scene_html")(self))


SceneLike = GaussianScene | str | os.PathLike[str]
"""A scene, or the path of its file or folder."""


def check_scene(scene: object, name: str = "scene") -> None:
    """Raise unless a value is a scene that holds values."""
    if not isinstance(scene, GaussianScene):
        raise InvalidArgumentError(f"{name} must be a GaussianScene, found {shown(scene)}.")
    if scene.device.type == "meta":
        raise InvalidSceneError(f"{name} must hold values, found tensors on the device meta.")


def as_scene(scene: SceneLike, name: str = "scene") -> GaussianScene:
    """Return a scene unchanged, or read it from a path; raise for anything else."""
    is_path = isinstance(scene, str | os.PathLike)
    found = resolve_name("cvtgs.io.formats:load")(scene) if is_path else scene
    if not isinstance(found, GaussianScene):
        kind = type(scene).__name__ + " (use cvtgs.from_dict)" * isinstance(scene, Mapping)
        raise InvalidArgumentError(
            f"{name} must be a GaussianScene or the path of one, found {kind}."
        )
    check_scene(found, name)
    return found
