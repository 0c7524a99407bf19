"""Pinhole cameras, and view matrices from camera positions and targets."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.checks import Rows, check_kinds, checked, row_numbers
from cvtgs.counts import checked_whole, spread_rows, whole_number
from cvtgs.devices import full_precision, usable_device
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import unit_vectors
from cvtgs.math.parameters import NEAR_PLANE
from cvtgs.text import shown


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class Cameras:
    """Pinhole cameras of one image size.

    Attributes:
        viewmats: ``(c, 4, 4)`` from world to camera; OpenCV axes: x right, y down, z forward.
        Ks: ``(c, 3, 3)`` intrinsics in pixels; pixel centres are at half-integers.
        width: Image width, pixels.
        height: Image height, pixels.
        names: Name of each camera, such as its photograph's file name; empty if they have none.
        strides: For each camera, a number s: its image holds every s-th pixel of a finer one, in
            both directions, and is as sharp (:meth:`every`); ``Ks``, width and height are those of
            the coarser grid. Empty, or all 1, for whole images.
        ignores_tag: For each camera, whether images of scenes tagged ``SplatRenderMode: mip`` lack
            its opacity compensation, as in viewers that ignore the tag; empty if no camera does.

    Raises:
        InvalidArgumentError: Shapes, dtypes, devices or sizes do not fit together.

    Example:
        >>> cameras = Cameras(
        ...     viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=64, height=48
        ... )
        >>> len(cameras)
        1
    """

    viewmats: Float[Tensor, "c 4 4"]
    Ks: Float[Tensor, "c 3 3"]
    width: int
    height: int
    names: tuple[str, ...] = ()
    strides: tuple[int, ...] = ()
    ignores_tag: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        kinds = {"viewmats": Float[Tensor, "c 4 4"], "Ks": Float[Tensor, "c 3 3"]}
        check_kinds(kinds, {"viewmats": self.viewmats, "Ks": self.Ks})
        count = len(self.viewmats)
        if self.viewmats.device != self.Ks.device or self.viewmats.dtype != self.Ks.dtype:
            raise InvalidArgumentError(
                f"viewmats and Ks must share device and dtype, found {self.viewmats.dtype} on "
                f"{self.viewmats.device} and {self.Ks.dtype} on {self.Ks.device}."
            )
        for name in ("width", "height"):
            object.__setattr__(self, name, checked_whole(getattr(self, name), name))
        for name, kind in (("names", str), ("strides", int), ("ignores_tag", bool)):
            values = getattr(self, name)
            is_list = isinstance(values, Sequence) and not isinstance(values, str)
            if is_list and kind is int:
                values = tuple(checked_whole(value, "every stride") for value in values)
            if not is_list or not all(isinstance(value, kind) for value in values):
                raise InvalidArgumentError(
                    f"{name} must be a tuple of type {kind.__name__}, found {shown(values)}."
                )
            if len(values) not in (0, count):
                raise InvalidArgumentError(
                    f"{name} must hold one entry per camera, {count}; found {len(values)}."
                )
            object.__setattr__(self, name, tuple(values))

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {self.width} x {self.height} pixels, {self.Ks.device})"

    def __len__(self) -> int:
        return len(self.viewmats)

    @property
    def view_names(self) -> tuple[str, ...]:
        """Names of the views; ``view 1`` and so on if the cameras have none."""
        return self.names or tuple(f"view {number}" for number in range(1, len(self) + 1))

    @property
    @full_precision()
    def centers(self) -> Float[Tensor, "c 3"]:
        """Positions of the cameras in the world, where renderers put them."""
        viewmats = self.viewmats.double()
        found: Tensor = torch.linalg.solve_ex(viewmats[:, :3, :3], -viewmats[:, :3, 3:]).result
        return found[:, :, 0].to(self.viewmats.dtype)

    def select(self, rows: Rows) -> Self:
        """Return some of the cameras, as ``cameras[rows]`` does.

        Args:
            rows: A slice, indices of the cameras, or a mask.

        Returns:
            The selected cameras.

        Raises:
            InvalidArgumentError: A mask has not one entry per camera, or an index is out of range.
        """
        device = rows.device if isinstance(rows, Tensor) else torch.device("cpu")
        chosen = row_numbers(rows, len(self), things="cameras", device=device)
        entries: dict[str, Any] = {
            name: tuple(values[row] for row in chosen.tolist())
            for name in ("names", "strides", "ignores_tag")
            if (values := getattr(self, name))
        }
        return replace(self, viewmats=self.viewmats[chosen], Ks=self.Ks[chosen], **entries)

    __getitem__ = select

    def __iter__(self) -> Iterator[Self]:
        return iter(self.singles())

    def singles(self) -> list[Self]:
        """Return one :class:`Cameras` per camera, in order, as ``for one in cameras`` does."""
        if len(self) == 1:  # a selection would copy the row number to the device
            return [self]
        return [self[[row]] for row in range(len(self))]

    def to(self, device: torch.device | str) -> Self:
        """Move the cameras to a device.

        Args:
            device: The target device.

        Returns:
            The cameras on that device.

        Raises:
            DeviceError: The device cannot be used.
        """
        target = usable_device(device)
        return replace(self, viewmats=self.viewmats.to(target), Ks=self.Ks.to(target))

    def resized(self, width: int, height: int) -> Self:
        """Return cameras with the same field of view and another image size.

        Args:
            width: Image width, pixels.
            height: Image height, pixels.

        Returns:
            Cameras with scaled intrinsics.

        Raises:
            InvalidArgumentError: A length is no whole number above 0.
        """
        width = checked_whole(width, "width")
        height = checked_whole(height, "height")
        factors = self.Ks.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, Ks=self.Ks * factors[:, None], width=width, height=height)

    def fitted(self, side: int, *, least: int = 1) -> Self:
        """Return cameras with the same field of view and a given longer image side.

        Args:
            side: Longer side of the images, pixels.
            least: Smallest length of either side, pixels.

        Returns:
            Cameras with scaled intrinsics.

        Raises:
            InvalidArgumentError: A length is no whole number above 0.
        """
        side = checked_whole(side, "side")
        least = checked_whole(least, "least")
        factor = side / max(self.width, self.height)
        return self.resized(
            max(least, round(factor * self.width)), max(least, round(factor * self.height))
        )

    def every(self, stride: int, *, first: tuple[int, int] = (0, 0)) -> Self:
        """Return cameras that see only every ``stride``-th pixel, as sharp as in the whole image.

        They render ``image[:, row::stride, column::stride]``, but for slight differences of splats
        centred far outside. Splats are as wide as in the image, and wider in :meth:`resized` ones.

        Args:
            stride: Step between pixels, along rows and columns.
            first: Column and row of the first pixel, each below the stride and in the image.
        """
        stride = checked_whole(stride, "stride")
        starts = tuple(map(whole_number, first)) if isinstance(first, Sequence) else ()
        sides = self.width, self.height
        ends = [min(stride, side) for side in sides]
        if len(starts) != 2 or not all(0 <= at < end for at, end in zip(starts, ends, strict=True)):
            raise InvalidArgumentError(
                f"first must be a column from 0 to {ends[0] - 1} and a row from 0 to "
                f"{ends[1] - 1}, found {shown(first)}."
            )
        width, height = (-((at - side) // stride) for at, side in zip(starts, sides, strict=True))
        return self._strided(stride, self.Ks.new_tensor([starts]), width=width, height=height)

    def interleaved(self, stride: int) -> Self:
        """Return cameras like those of :meth:`every`, with first pixels that differ."""
        stride = checked_whole(stride, "stride")
        if stride == 1:
            return self
        rows = torch.arange(len(self), device=self.Ks.device)
        firsts = torch.stack([rows % stride, rows // stride % stride], dim=1).to(self.Ks)
        width, height = max(1, self.width // stride), max(1, self.height // stride)
        return self._strided(stride, firsts, width=width, height=height)

    def _strided(
        self, stride: int, firsts: Float[Tensor, "c_or_1 2"], *, width: int, height: int
    ) -> Self:
        """Return cameras of every ``stride``-th pixel, given the column and row of the first."""
        Ks = self.Ks.clone()  # noqa: N806 (the name that gsplat gives it)
        Ks[:, :2] /= stride
        Ks[:, :2, 2] += 0.5 - (firsts + 0.5) / stride
        strides = tuple(before * stride for before in self.strides or (1,) * len(self))
        return replace(self, Ks=Ks, width=width, height=height, strides=strides)

    def in_two_sizes(self, factor: int) -> Self:
        """Return cameras of which about every second one sees pixels of a larger image.

        Its image is as sharp as one that is ``factor`` times as wide and high, and has as many
        pixels as before. What fits images of both kinds fits screens of both sizes, while splats
        are wider in small images. Multiples of an irrational number decide which cameras these are.

        Args:
            factor: Ratio of the two sizes; 1 changes nothing.

        Returns:
            The same cameras otherwise.

        Raises:
            InvalidArgumentError: The factor is no whole number above 0.
        """
        factor = checked_whole(factor, "factor")
        if factor == 1:
            return self
        strides = tuple(
            stride * (factor if math.sqrt(3.0) * row % 1.0 < 0.5 else 1)
            for row, stride in enumerate(self.strides or (1,) * len(self), start=1)
        )
        return replace(self, strides=strides)

    def in_both_modes(self) -> Self:
        """Return cameras of which about every third one ignores the tag ``SplatRenderMode: mip``.

        Multiples of an irrational number decide, so that every eighth or ninth camera, as is held
        out elsewhere, is not always of the same kind. A given ``ignores_tag`` stays.
        """
        if self.ignores_tag:
            return self
        modes = tuple(math.sqrt(2.0) * row % 1.0 < 1 / 3 for row in range(1, len(self) + 1))
        return replace(self, ignores_tag=modes)

    @full_precision()
    @checked
    def shows_any(self, points: Float[Tensor, "n 3"]) -> bool:
        """Check whether any point lies within any of the images.

        Args:
            points: Positions in the units of the cameras.

        Returns:
            Whether one is at least 0.01 before a camera (the near plane) and within its image.

        Raises:
            InvalidArgumentError: ``points`` is no tensor of floats of this shape.
        """
        scales = view_scales(self.viewmats).to(points)[:, None, None]
        for view, matrix in zip(self.viewmats.to(points) / scales, self.Ks.to(points), strict=True):
            x, y, depth = matrix @ (view[:3, :3] @ points.T + view[:3, 3:])
            inside = (depth >= NEAR_PLANE) & (x >= 0) & (x <= self.width * depth)
            if bool((inside & (y >= 0) & (y <= self.height * depth)).any()):
                return True
        return False

    def spread(self, count: int) -> Self:
        """Return some of the cameras, evenly spaced in their order.

        Args:
            count: Number of cameras, at least 1; all are returned if there are no more.

        Returns:
            The selected cameras.

        Raises:
            InvalidArgumentError: The count is no whole number above 0.
        """
        return self.select(spread_rows(len(self), checked_whole(count, "count")))


def join_cameras(parts: Sequence[Cameras]) -> Cameras:
    """Return cameras of one image size together, without names."""
    strides = [part.strides or (1,) * len(part) for part in parts]
    modes = [part.ignores_tag or (False,) * len(part) for part in parts]
    return Cameras(
        viewmats=torch.cat([part.viewmats for part in parts]),
        Ks=torch.cat([part.Ks for part in parts]),
        width=parts[0].width,
        height=parts[0].height,
        strides=tuple(chain(*strides)) if any(part.strides for part in parts) else (),
        ignores_tag=tuple(chain(*modes)) if any(part.ignores_tag for part in parts) else (),
    )


def checked_cameras(cameras: object) -> Cameras:
    """Return cameras unchanged; raise for anything else."""
    if not isinstance(cameras, Cameras):
        raise InvalidArgumentError(
            f"cameras must be Cameras, for example of cvtgs.load_cameras or "
            f"cvtgs.views.automatic_views; found {shown(cameras)}."
        )
    return cameras


def view_scales(viewmats: Float[Tensor, "c 4 4"]) -> Float[Tensor, "c"]:
    """Return the uniform scale of each view matrix; exactly 1 for rotations up to rounding."""
    scales = viewmats[:, :3, :3].square().sum(dim=(1, 2)).div(3).sqrt()
    return torch.where((scales - 1).abs() > 1e-3, scales, 1.0)


@full_precision()
@checked
def look_at(
    eyes: Float[Tensor, "c 3"],
    targets: Float[Tensor, "c 3"] | Float[Tensor, "1 3"],
    up: Float[Tensor, "3"] | Int[Tensor, "3"],
) -> Float[Tensor, "c 4 4"]:
    """Return world-to-camera matrices, with OpenCV axes, of cameras that look at points.

    A camera that looks along ``up`` gets another up.

    Args:
        eyes: Positions of the cameras.
        targets: Point in the middle of each image, or one for all; none may be at its camera.
        up: Direction that is up in the images, of any length but 0.

    Example:
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> look_at(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 5.0]]), up)[0, 2, :3].tolist()
        [0.0, 0.0, 1.0]
    """
    dtype = torch.promote_types(torch.promote_types(eyes.dtype, targets.dtype), up.dtype)
    eyes, targets, up = eyes.to(dtype), targets.to(dtype), up.to(dtype)
    forward = unit_vectors(targets - eyes)
    upright = unit_vectors(up[None]).expand_as(forward)
    for vectors, wish in (
        (forward, "targets must be finite and differ from the positions of their cameras"),
        (upright, "up must be a finite direction other than 0"),
    ):
        bad = (~(vectors.norm(dim=1) > 0.5)).nonzero()[:, 0].tolist()
        if bad:
            raise InvalidArgumentError(
                f"{wish}; found {len(bad)} of {len(vectors)} cameras for which this does not hold, "
                f"the first is camera {bad[0]}."
            )
    parallel = (forward * upright).sum(dim=1, keepdim=True).abs() > 1 - 1e-6
    other = torch.eye(3, dtype=eyes.dtype, device=eyes.device)[upright.abs().argmin(dim=1)]
    upright = torch.where(parallel, other, upright)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, upright), dim=1)
    down = torch.linalg.cross(forward, right)
    viewmats = torch.eye(4, dtype=eyes.dtype, device=eyes.device).repeat(len(eyes), 1, 1)
    viewmats[:, :3, :3] = torch.stack([right, down, forward], dim=1)
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] @ eyes[:, :, None])[:, :, 0]
    return viewmats
