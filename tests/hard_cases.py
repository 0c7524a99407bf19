"""Numerically hard scenes: one function per case, with its source.

Sources are issue threads of other projects; "awkward input" is a list of inputs on which other
tools failed; "the limits of the format" are numbers that a file may hold. Every function takes the
number of Gaussians and their dtype, and returns a scene; :func:`valid_rows` is the mask of its rows
that a renderer can draw.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from cvtgs import GaussianScene, from_dict
from hard_scenes import ball, changed, every, flown, measured_in, spoiled

INF = math.inf
MakeScene = Callable[[int, torch.dtype], GaussianScene]


def needles(count: int, dtype: torch.dtype) -> GaussianScene:
    """A million times as long as wide. Source: stretched splats, spark 341 and 393."""
    scene = ball(count, dtype)
    thin = scene.log_scales[:, :1] + torch.tensor([0.0, -math.log(1e6), -math.log(1e6)])
    return changed(scene, log_scales=thin)


def pancakes(count: int, dtype: torch.dtype) -> GaussianScene:
    """A million times as wide as thick. Source: stretched splats, spark 341 and 393."""
    scene = ball(count, dtype)
    flat = scene.log_scales[:, :1] + torch.tensor([0.0, 0.0, -math.log(1e6)])
    return changed(scene, log_scales=flat)


def points(count: int, dtype: torch.dtype) -> GaussianScene:
    """Scales of e^-40, whose squares underflow in float32. Source: the limits of the format."""
    scene = ball(count, dtype)
    return changed(scene, log_scales=scene.log_scales * 0 - 40)


def giants(count: int, dtype: torch.dtype) -> GaussianScene:
    """Scales of e^20 around a ball of radius 1. Source: the limits of the format."""
    scene = ball(count, dtype)
    return changed(scene, log_scales=scene.log_scales * 0 + 20)


def points_amid_giants(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every third Gaussian has scales of e^-40, the others of e^20. Source: as of both cases."""
    scene = ball(count, dtype)
    return changed(scene, log_scales=every(3, count, (-40.0, 20.0))[:, None].expand(-1, 3))


def tiny_world(count: int, dtype: torch.dtype) -> GaussianScene:
    """A whole scene scaled by e^-40. Source: the limits of the format."""
    return measured_in(ball(count, dtype), -40.0)


def huge_world(count: int, dtype: torch.dtype) -> GaussianScene:
    """A whole scene scaled by e^20. Source: the limits of the format."""
    return measured_in(ball(count, dtype), 20.0)


def isotropic_cells(count: int, dtype: torch.dtype) -> GaussianScene:
    """Groups on the corners of octahedra: equal eigenvalues, so any frame is right.

    Source: eigenvectors of equal eigenvalues are arbitrary (Golub and Van Loan, section 8.1).
    """
    scene = ball(count, dtype)
    corners = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    rows = torch.arange(count)
    middles = 20.0 * ball(count, torch.float64, seed=1).means[rows // 6]
    same = {name: getattr(scene, name)[rows - rows % 6] for name in ("quats", "sh0", "shN")}
    return changed(
        scene,
        means=middles + corners[rows % 6],
        log_scales=torch.full((count, 3), -1.0),
        logit_opacities=torch.full((count,), 3.0),
        **same,
    )


def coincident(count: int, dtype: torch.dtype) -> GaussianScene:
    """All centres coincide. Source: hang on coincident points, splat-transform PR 272."""
    scene = ball(count, dtype)
    return changed(scene, means=torch.full((count, 3), 3.0))


def on_a_line(count: int, dtype: torch.dtype) -> GaussianScene:
    """Centres are on an oblique line. Source: awkward input (a flat tree, a flat bounding box)."""
    scene = ball(count, dtype)
    askew = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    return changed(scene, means=scene.means[:, :1].double() * askew)


def on_a_plane(count: int, dtype: torch.dtype) -> GaussianScene:
    """All centres are on the plane z = 0. Source: awkward input (a flat bounding box)."""
    scene = ball(count, dtype)
    return changed(scene, means=scene.means * torch.tensor([1.0, 1.0, 0.0]))


def duplicates(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every Gaussian is there five times. Source: splat-transform PR 272, merged captures."""
    return ball(count, dtype).select(torch.arange(count) // 5)


def two_clusters(count: int, dtype: torch.dtype) -> GaussianScene:
    """Two balls a million radii apart. Source: flyaways cost 3 h, splat-transform PR 286."""
    scene = ball(count, dtype)
    return changed(scene, means=scene.means + every(2, count, (1e6, 0.0))[:, None])


def flyaways(count: int, dtype: torch.dtype) -> GaussianScene:
    """Five Gaussians a million radii away. Source: splat-transform PR 286; awkward input."""
    return flown(count, dtype, 1e6)


def far_flyaways(count: int, dtype: torch.dtype) -> GaussianScene:
    """Five Gaussians 1e30 radii away. Source: splat-transform PR 286; awkward input."""
    return flown(count, dtype, 1e30)


def georeferenced(count: int, dtype: torch.dtype) -> GaussianScene:
    """Detail of 1e-2 at 6e6, as on a map in metres; float32 resolves 0.5 there.

    Source: UTM northings of non-standard PLYs, MetalSplatter 69 and splat-transform PR 119.
    """
    scene = ball(count, torch.float64)
    offset = torch.tensor([6e6, 5e5, 100.0], dtype=torch.float64)
    tensors = {**scene.tensors(), "means": 0.1 * scene.means + offset}
    tensors["log_scales"] = scene.log_scales + math.log(0.1)
    return GaussianScene(**{name: values.to(dtype) for name, values in tensors.items()})


def all_faint(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every opacity is 0.018. Source: awkward input; "asked 500,000, got 107", LichtFeld 1470."""
    logit = math.log(0.018 / 0.982)
    return changed(ball(count, dtype), logit_opacities=torch.full((count,), logit).double())


def all_opaque(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every opacity is exactly 1. Source: inf in real files, LichtFeld-Studio 1615."""
    return changed(ball(count, dtype), logit_opacities=torch.full((count,), INF))


def all_transparent(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every opacity is exactly 0. Source: inf in real files, LichtFeld-Studio 1615."""
    return changed(ball(count, dtype), logit_opacities=torch.full((count,), -INF))


def opaque_or_transparent(count: int, dtype: torch.dtype) -> GaussianScene:
    """Opacities of exactly 0 and 1 side by side. Source: LichtFeld-Studio 1615, spz 22."""
    return changed(ball(count, dtype), logit_opacities=every(2, count, (INF, -INF)))


def extreme_logits(count: int, dtype: torch.dtype) -> GaussianScene:
    """Logits of 700 and -700, whose exponentials overflow. Source: LichtFeld-Studio 1615."""
    return changed(ball(count, dtype), logit_opacities=every(2, count, (700.0, -700.0)))


def odd_quaternions(count: int, dtype: torch.dtype) -> GaussianScene:
    """Tiny, huge and negated quaternions. Source: quantized files, spz 22."""
    scene = ball(count, dtype)
    factors = torch.tensor([1e-30, -1.0, 1e30, 1e-38, -1e-3]).double()
    return changed(scene, quats=scene.quats.double() * factors[torch.arange(count) % 5, None])


def zero_quaternions(count: int, dtype: torch.dtype) -> GaussianScene:
    """Every seventh quaternion is zero. Source: inf and NaN in real files, spz 22."""
    scene = ball(count, dtype)
    return changed(scene, quats=scene.quats * every(7, count, (0.0, 1.0))[:, None])


def nan_means(count: int, dtype: torch.dtype) -> GaussianScene:
    """NaN centres. Source: awkward input; LichtFeld-Studio 1615."""
    return spoiled(count, dtype, "means")


def nan_quats(count: int, dtype: torch.dtype) -> GaussianScene:
    """NaN rotations. Source: LichtFeld-Studio 1615, spz 22."""
    return spoiled(count, dtype, "quats")


def nan_log_scales(count: int, dtype: torch.dtype) -> GaussianScene:
    """NaN scales. Source: LichtFeld-Studio 1615, spz 22."""
    return spoiled(count, dtype, "log_scales")


def nan_logit_opacities(count: int, dtype: torch.dtype) -> GaussianScene:
    """NaN opacities. Source: LichtFeld-Studio 1615."""
    return spoiled(count, dtype, "logit_opacities")


def nan_sh0(count: int, dtype: torch.dtype) -> GaussianScene:
    """NaN colours. Source: awkward input (another tool never ends)."""
    return spoiled(count, dtype, "sh0")


def nan_shN(count: int, dtype: torch.dtype) -> GaussianScene:  # noqa: N802 (the tensor's name)
    """NaN in the view-dependent bands. Source: awkward input; spz 22."""
    return spoiled(count, dtype, "shN")


def huge_colours(count: int, dtype: torch.dtype) -> GaussianScene:
    """SH coefficients of 1e4. Source: diverged trainings, LichtFeld-Studio 1615."""
    scene = ball(count, dtype)
    return changed(scene, sh0=1e4 * scene.sh0, shN=1e4 * scene.shN)


def crowd_beside_loners(count: int, dtype: torch.dtype) -> GaussianScene:
    """Nearly all Gaussians are in a small cluster, beside at most ten large ones far apart.

    Source: 5.3 M became 1, LightGaussian 27; memory by scene, not chunk, splat-transform PR 276.
    """
    scene, loners = ball(count, dtype), torch.arange(count) < min(10, count // 2)
    places = 10.0 * ball(count, torch.float64, seed=1).means
    speck = 1e-3 * scene.means.double() - 5
    return changed(
        scene,
        means=torch.where(loners[:, None], places, speck),
        log_scales=torch.where(loners, 0.0, -8.0)[:, None].expand(-1, 3),
        logit_opacities=torch.where(loners, 4.0, -1.0),
    )


def one(count: int, dtype: torch.dtype) -> GaussianScene:
    """A single Gaussian. Source: awkward input (small scenes fail elsewhere)."""
    return ball(1, dtype)


def two(count: int, dtype: torch.dtype) -> GaussianScene:
    """Two Gaussians. Source: awkward input (small scenes fail elsewhere)."""
    return ball(2, dtype)


def three(count: int, dtype: torch.dtype) -> GaussianScene:
    """Three Gaussians. Source: awkward input (small scenes fail elsewhere)."""
    return ball(3, dtype)


def denormals(count: int, dtype: torch.dtype) -> GaussianScene:
    """Centres, colours and quaternions that are denormal numbers. Source: the limits of float32."""
    scene, smallest = ball(count, dtype), torch.finfo(dtype).smallest_normal
    tensors = {name: getattr(scene, name) * smallest for name in ("means", "sh0", "shN")}
    return changed(scene, **tensors, quats=scene.quats * smallest * 1e-3)


def half_precision(count: int, dtype: torch.dtype) -> GaussianScene:
    """The tensors of a model in float16. Source: models trained or stored in half, spz 22."""
    scene = ball(count, dtype)
    names = {"log_scales": "scales", "logit_opacities": "opacities"}
    half = {names.get(name, name): values.half() for name, values in scene.tensors().items()}
    return changed(scene, **from_dict(half).tensors())


def antialiased(count: int, dtype: torch.dtype) -> GaussianScene:
    """A scene of Mip-Splatting. Source: mip tag lost, gaussian-splatting 1209."""
    return replace(ball(count, dtype), comments=("SplatRenderMode: mip",))


def flat_file(count: int, dtype: torch.dtype) -> GaussianScene:
    """A 2DGS scene, whose file has no scale_2.

    Source: non-standard PLYs, splat-transform PR 119.
    """
    kind = "double" if dtype == torch.float64 else "float"
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", *(f"rot_{i}" for i in range(4))]
    return replace(flat_scales(count, dtype), layout=tuple((name, kind) for name in names))


def flat_scales(count: int, dtype: torch.dtype) -> GaussianScene:
    """A 2DGS scene with a third log-scale of -20. Source: as exporters of 2DGS write it."""
    scene = ball(count, dtype)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = -20.0
    return changed(scene, log_scales=log_scales)


CASES: dict[str, MakeScene] = {
    make.__name__: make
    for make in (
        ball, needles, pancakes, points, giants, points_amid_giants, tiny_world, huge_world,
        isotropic_cells, coincident, on_a_line, on_a_plane, duplicates, two_clusters, flyaways,
        far_flyaways, georeferenced,
        all_faint, all_opaque, all_transparent, opaque_or_transparent, extreme_logits,
        odd_quaternions, zero_quaternions, nan_means, nan_quats, nan_log_scales,
        nan_logit_opacities, nan_sh0, nan_shN, huge_colours, crowd_beside_loners, one, two, three,
        denormals, half_precision, antialiased, flat_file, flat_scales,
    )
}  # fmt: skip

each_case = pytest.mark.parametrize("make", CASES.values(), ids=CASES)
