"""Edits of scenes: crop, drop, move and concatenate. Unaffected values stay bit-identical."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cvtgs.boxes import Box, Corner, Sphere, inside, listed
from cvtgs.checks import checked
from cvtgs.counts import finite_numbers, real_number
from cvtgs.devices import full_precision
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, InvalidSceneError, warn
from cvtgs.math.parameters import multiply_quats, rotation_matrices
from cvtgs.math.spherical_harmonics import REST_COUNTS, rotated_rest
from cvtgs.scene import NORMALS, GaussianScene
from cvtgs.tags import TWO_SCALES
from cvtgs.text import shown

__all__ = ["Motion", "concatenate", "crop", "drop_faint", "drop_large", "move"]

_NO_TURN = (1.0, 0.0, 0.0, 0.0)
_NO_SHIFT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A similarity transform: ``x`` becomes ``scale * R x + shift``.

    Attributes:
        quat: The rotation ``R`` as a quaternion, w first, of any length from 1e-100 to 1e100.
        scale: Factor of all lengths, above 0.
        shift: Translation, scene units, applied last.

    Raises:
        InvalidArgumentError: A number is not finite, the factor is not above 0, or the quaternion
            is too short or too long.

    Example:
        >>> Motion(scale=2.0).shift
        (0.0, 0.0, 0.0)
    """

    quat: tuple[float, float, float, float] = _NO_TURN
    scale: float = 1.0
    shift: Corner = _NO_SHIFT

    def __post_init__(self) -> None:
        quat, scale = finite_numbers(self.quat, 4), finite_numbers([self.scale], 1)
        shift = finite_numbers(self.shift, 3)
        # the square of the length must be a float64
        is_usable = quat and scale and scale[0] > 0 and 1e-100 <= math.hypot(*quat) <= 1e100
        if quat is None or scale is None or shift is None or not is_usable:
            found = ", ".join(map(shown, (self.quat, self.scale, self.shift)))
            raise InvalidArgumentError(
                "a motion must consist of finite numbers: 4 of a quaternion of length 1e-100 to "
                f"1e100, a scale above 0, and 3 of a shift, found {found}."
            )
        for name, value in (("quat", quat), ("scale", scale[0]), ("shift", shift)):
            object.__setattr__(self, name, value)

    @classmethod
    def of_angles(
        cls, angles: Corner, *, scale: float = 1.0, shift: Corner = _NO_SHIFT
    ) -> "Motion":
        """Build a motion from angles.

        Args:
            angles: Degrees about x, then y, then z; the axes are fixed (extrinsic rotations).
            scale: Factor of all lengths.
            shift: Translation.

        Returns:
            The motion.

        Raises:
            InvalidArgumentError: A number is not finite, or the factor is not above 0.
        """
        degrees = finite_numbers(angles, 3)
        if degrees is None:
            raise InvalidArgumentError(
                f"angles must be 3 finite numbers in degrees, found {shown(angles)}."
            )
        quat = torch.tensor([_NO_TURN], dtype=torch.float64, device="cpu")
        for axis, angle in enumerate(degrees):
            turn = torch.zeros(1, 4, dtype=torch.float64, device="cpu")
            # exact for quarter turns, unlike the sine of rounded radians
            turn[0, 0], turn[0, 1 + axis] = _cos_sin(angle / 2)
            quat = multiply_quats(turn, quat)
        w, x, y, z = quat[0].tolist()
        return cls(quat=(w, x, y, z), scale=scale, shift=shift)


def _cos_sin(degrees: float) -> tuple[float, float]:
    if degrees % 90 == 0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(degrees // 90) % 4]
    radians = math.radians(degrees)
    return math.cos(radians), math.sin(radians)


@checked
def crop(scene: GaussianScene, regions: Sequence[Box | Sphere] | Box | Sphere) -> GaussianScene:
    """Keep the Gaussians whose centres lie in a region; centres with NaN lie in none.

    Args:
        scene: The scene; it is not changed.
        regions: A box or sphere, or several; Gaussians in any of them are kept.

    Returns:
        The kept Gaussians, in their order, bit for bit; the same object if all are kept.

    Raises:
        InvalidArgumentError: There is no region, one is neither a box nor a sphere, or ``scene`` is
            no scene.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> len(crop(scene, [Sphere(center=(0.0, 0.0, 0.0), radius=1e6)]))
        100
    """
    regions = listed(regions, Box | Sphere, required="regions must be boxes or spheres")
    if not regions:
        raise InvalidArgumentError("crop needs at least one box or sphere, found none.")
    return _kept(scene, inside(regions, scene.means))


@checked
def drop_faint(scene: GaussianScene, least: float) -> GaussianScene:
    """Drop the Gaussians below an opacity; invalid ones stay.

    Args:
        scene: The scene; it is not changed.
        least: Smallest opacity to keep, 0 to 1.

    Returns:
        The others, in their order, bit for bit; the same object if none is dropped.

    Raises:
        InvalidArgumentError: The opacity is not from 0 to 1, or ``scene`` is no scene.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> bool((drop_faint(scene, 0.5).opacities >= 0.5).all())
        True
    """
    if not 0 <= real_number(least) <= 1:
        raise InvalidArgumentError(
            f"the lowest opacity to keep must be from 0 to 1, found {shown(least)}."
        )
    # Opacities are not clamped here: clamped ones end at 1 - 1e-6 and never reach 1.
    return _kept(scene, ~(torch.sigmoid(scene.logit_opacities.double()) < least))


@checked
def drop_large(scene: GaussianScene, largest: float) -> GaussianScene:
    """Drop the Gaussians above a size; invalid ones stay.

    Args:
        scene: The scene; it is not changed.
        largest: Largest standard deviation to keep, scene units, above 0.

    Returns:
        The others, in their order, bit for bit; the same object if none is dropped.

    Raises:
        InvalidArgumentError: The size is not above 0, or ``scene`` is no scene.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=0, seed=0)
        >>> len(drop_large(scene, 1e6))
        100
    """
    if not real_number(largest) > 0:
        raise InvalidArgumentError(
            f"the largest size to keep must be above 0, found {shown(largest)}."
        )
    return _kept(scene, ~(scene.log_scales.double() > math.log(largest)).any(dim=1))


def _kept(scene: GaussianScene, keep: Tensor) -> GaussianScene:
    return scene if bool(keep.all()) else scene.select(keep)


@full_precision()
@checked
def move(scene: GaussianScene, motion: Motion) -> GaussianScene:
    """Rotate, scale and translate a scene; view-dependent colours and normals rotate with it.

    Args:
        scene: The scene; it is not changed.
        motion: The transform.

    Returns:
        The moved scene. Only tensors that change are computed: a translation changes the centres
        alone, a scale factor the centres and scales alone.

    Raises:
        InvalidArgumentError: Coordinates would leave the range of the dtype or shrink to 0, or an
            argument has another type.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> one = make("object", 1, sh_degree=0, seed=0)
        >>> (move(one, Motion(shift=(1.0, 0.0, 0.0))).means - one.means).tolist()
        [[1.0, 0.0, 0.0]]
    """
    means, changes, extras = scene.means.double(), {}, scene.extras
    quat = torch.tensor([motion.quat], dtype=torch.float64, device=scene.device)
    if bool((quat[0, 1:] != 0).any()):
        turn = quat / torch.linalg.vector_norm(quat)
        matrix = rotation_matrices(turn)[0]
        means = means @ matrix.T
        quats = multiply_quats(turn.expand(len(scene), 4), scene.quats.double())
        changes["quats"] = quats.to(scene.dtype)
        changes["shN"] = rotated_rest(scene.shN, matrix)
        extras = turned_normals(scene.extras, matrix)
    if motion.scale != 1.0:
        means = motion.scale * means
        tiny = torch.finfo(scene.dtype).tiny
        if bool((scene.means.abs() > 0).any()) and not bool((means.abs() >= tiny).any()):
            raise InvalidArgumentError(
                f"a motion must not shrink all coordinates below {tiny:.3g}, the range of "
                f"{str(scene.dtype).removeprefix('torch.')}, found a scale of {motion.scale:g}."
            )
        log_scales = scene.log_scales.double() + math.log(motion.scale)
        if scene.has_two_scales:  # the third one only says that Gaussians are flat
            log_scales[:, 2] = scene.log_scales[:, 2]
        changes["log_scales"] = log_scales.to(scene.dtype)
    if motion.shift != _NO_SHIFT:
        means = means + means.new_tensor(motion.shift)
    moved = means.to(scene.dtype)
    if bool((moved.isinf() & scene.means.isfinite()).any()):
        raise InvalidArgumentError(
            f"a motion must keep coordinates within {torch.finfo(scene.dtype).max:.3g}, the range "
            f"of {str(scene.dtype).removeprefix('torch.')}, found larger ones."
        )
    return scene.with_tensors({"means": moved, **changes}, extras)


def turned_normals(extras: Mapping[str, Tensor], matrix: Tensor) -> dict[str, Tensor]:
    """Return extra columns with their normals multiplied by a 3 x 3 matrix, if there are any."""
    if not all(name in extras and extras[name].is_floating_point() for name in NORMALS):
        return dict(extras)
    normals = torch.stack([extras[name].double() for name in NORMALS], dim=1)
    turned = normals @ matrix.to(normals).T
    columns = {name: turned[:, k].to(extras[name].dtype) for k, name in enumerate(NORMALS)}
    return {**extras, **columns}


def concatenate(scenes: Iterable[GaussianScene], *, fill: bool = False) -> GaussianScene:
    """Return the Gaussians of several scenes as one scene.

    A warning says if only some were trained with anti-aliasing: viewers cannot show all correctly.

    Args:
        scenes: At least one, all on one device. Without ``fill``, they must have the same SH
            degree, number of scales, dtype and extra columns.
        fill: Whether missing SH bands and normals are filled with zeros; the result is float64 if
            any scene is. Other extra columns that a scene lacks are left out, with a warning.

    Returns:
        All Gaussians, in the order of the scenes, with the comments of all, equal ones once; the
        layout is that of the scenes if it is the same.

    Raises:
        InvalidSceneError: There is no scene, or the scenes do not fit together.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scenes = make("object", 10, sh_degree=0), make("object", 5, sh_degree=2)
        >>> concatenate(scenes, fill=True)
        GaussianScene(15 Gaussians, SH degree 2, float32, cpu)
    """
    first, *others = scenes = _listed(scenes)
    if not others:
        return first
    are_flat = [scene.has_two_scales for scene in scenes]
    parts = _filled(scenes) if fill else scenes
    for number, part in enumerate(parts):
        if _kind(part) != _kind(parts[0]):
            raise InvalidSceneError(
                f"scenes to concatenate must be alike, or filled (fill=True); the first has "
                f"{_kind(first)}, scene {number} {_kind(part)}."
            )
    if any(other.antialiased != first.antialiased for other in others):
        warn(
            "some of the scenes to concatenate are tagged SplatRenderMode: mip and others are not; "
            "viewers will show one of the two kinds too soft or too sharp."
        )
    layout = first.layout if all(other.layout == first.layout for other in others) else ()
    comments = tuple(dict.fromkeys(line for scene in scenes for line in scene.comments))
    if not all(are_flat):
        comments = TWO_SCALES.removed_from(comments)
    elif not layout and not TWO_SCALES.is_in(comments):  # then no layout says so
        comments = (*comments, TWO_SCALES.text)
    tensors = [part.tensors() for part in parts]
    return replace(
        first,
        **{name: torch.cat([each[name] for each in tensors]) for name in tensors[0]},
        extras={name: _joined([part.extras[name] for part in parts]) for name in parts[0].extras},
        comments=comments,
        layout=layout,
    )


def _listed(scenes: Iterable[object]) -> list[GaussianScene]:
    """Return several scenes as a list; raise if there is none, or not all are on one device."""
    given = list(scenes) if isinstance(scenes, Iterable) else [scenes]
    found = [scene for scene in given if isinstance(scene, GaussianScene)]
    if not found or len(found) < len(given):
        raise InvalidSceneError(f"concatenate needs at least one scene, found {shown(scenes)}.")
    devices = sorted({str(scene.device) for scene in found})
    if len(devices) > 1:
        raise InvalidSceneError(f"concatenate needs one device, found {', '.join(devices)}.")
    return found


def _filled(scenes: Sequence[GaussianScene]) -> list[GaussianScene]:
    """Return scenes of one SH degree, dtype, number of scales and set of extra columns."""
    found = {name for scene in scenes for name in scene.extras}
    common = found.intersection(*({*scene.extras, *NORMALS} for scene in scenes))
    missing = sorted(found - common)
    if missing:
        warn(
            f"left out {'columns' if len(missing) > 1 else 'column'} "
            f"{', '.join(map(repr, missing))}, which not all of the scenes have.",
            DroppedDataWarning,
        )
    dtype = torch.float64 if any(s.dtype == torch.float64 for s in scenes) else torch.float32
    degree = max(scene.sh_degree for scene in scenes)
    plain = [replace(s, comments=TWO_SCALES.removed_from(s.comments), layout=()) for s in scenes]
    return [_widened(scene, degree, dtype, common) for scene in plain]


def _joined(columns: list[Tensor]) -> Tensor:
    """Join columns; floats and integers become float64, since float32 would round large ids."""
    if len({column.is_floating_point() for column in columns}) > 1:
        columns = [column.double() for column in columns]
    return torch.cat(columns)


def _kind(scene: GaussianScene) -> str:
    scales, extras = 2 if scene.has_two_scales else 3, sorted(scene.extras) or "none"
    return f"SH degree {scene.sh_degree}, {scales} scales, {scene.dtype}, extra columns {extras}"


def _widened(
    scene: GaussianScene, degree: int, dtype: torch.dtype, extras: set[str]
) -> GaussianScene:
    tensors = {name: tensor.to(dtype) for name, tensor in scene.tensors().items()}
    missing = REST_COUNTS[degree] - scene.shN.shape[1]
    tensors["shN"] = torch.nn.functional.pad(tensors["shN"], (0, 0, 0, missing))
    zero = torch.zeros_like(tensors["means"][:, 0])
    zeros = {name: zero for name in NORMALS if name in extras}
    kept = {name: column for name, column in scene.extras.items() if name in extras}
    return scene.with_tensors(tensors, zeros | kept)
