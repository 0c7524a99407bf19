"""Small scenes for tests: random ones, and moved or scaled versions of a scene."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import oracles
from cvtgs import GaussianScene, concatenate, synthetic

REST_COUNTS = (0, 3, 8, 15)


def random_scene(
    count: int,
    *,
    seed: int = 0,
    degree: int = 1,
    dtype: torch.dtype = torch.float32,
    spread: float = 1.0,
    size: float = 0.1,
) -> GaussianScene:
    """Return Gaussians scattered over a box, of various shapes, with quaternions of any length."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    tensors = {
        "means": spread * normal(count, 3),
        "quats": normal(count, 4) + 0.1,
        "log_scales": math.log(size) + 0.7 * normal(count, 3),
        "logit_opacities": 2.0 * normal(count),
        "sh0": normal(count, 1, 3),
        "shN": 0.3 * normal(count, REST_COUNTS[degree], 3),
    }
    return GaussianScene(**{name: tensor.to(dtype) for name, tensor in tensors.items()})


def moved(
    scene: GaussianScene,
    *,
    quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    shift: Sequence[float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> GaussianScene:
    """Rotate, then scale, then shift a scene, colours included, with the oracles' arithmetic."""
    matrix = oracles.rotation(quat)
    length = math.hypot(*quat)
    unit = [part / length for part in quat]
    sh = scene.sh.double().numpy()
    turned = {
        "means": scale * scene.means.double().numpy() @ matrix.T + np.array(shift),
        "quats": np.array([oracles.quaternion_product(unit, q) for q in scene.quats.tolist()]),
        "log_scales": scene.log_scales.double().numpy() + math.log(scale),
        "sh0": sh[:, :1],
        "shN": oracles.rotated_sh(sh, matrix)[:, 1:],
    }
    tensors = {
        name: torch.from_numpy(array.copy()).to(scene.dtype) for name, array in turned.items()
    }
    return scene.with_tensors(tensors, scene.extras)


def oracle_rows(scene: GaussianScene, rows: Sequence[int]) -> list[oracles.Gaussian]:
    """Return some Gaussians in the form that the oracles take."""
    return [
        oracles.gaussian(
            scene.means[row].tolist(),
            scene.quats[row].tolist(),
            scene.log_scales[row].tolist(),
            scene.logit_opacities[row].item(),
            scene.sh[row].double().numpy(),
        )
        for row in rows
    ]


def covariances_of(scene: GaussianScene) -> Tensor:
    """Return ``(n, 3, 3)`` covariances, which do not depend on how axes are named."""
    matrices = [
        oracles.covariance(log_scales, quat)
        for log_scales, quat in zip(scene.log_scales.tolist(), scene.quats.tolist(), strict=True)
    ]
    return torch.from_numpy(np.stack(matrices))


def same_bits(first: GaussianScene, second: GaussianScene) -> bool:
    """Return whether all tensors, extras included, are equal bit for bit."""
    ours = {**first.tensors(), **first.extras}
    theirs = {**second.tensors(), **second.extras}
    return ours.keys() == theirs.keys() and all(
        ours[name].dtype == theirs[name].dtype
        and ours[name].shape == theirs[name].shape
        and ours[name].numpy().tobytes() == theirs[name].numpy().tobytes()
        for name in ours
    )


def assert_same_gaussians(
    first: GaussianScene, second: GaussianScene, *, tolerance: float = 1e-4
) -> None:
    """Compare scenes as sets of Gaussians: in the order of their means along x, then y and z."""
    a, b = (
        s.select(torch.from_numpy(np.lexsort(s.means.double().numpy().T[::-1])))
        for s in (first, second)
    )
    extent = float((a.means.amax(dim=0) - a.means.amin(dim=0)).amax())
    torch.testing.assert_close(a.means, b.means, rtol=tolerance, atol=tolerance * extent)
    ours, theirs = covariances_of(a), covariances_of(b)
    worst = (ours - theirs).abs().amax(dim=(1, 2)) / ours.abs().amax(dim=(1, 2))
    assert float(worst.amax()) < tolerance
    torch.testing.assert_close(a.opacities, b.opacities, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(a.sh, b.sh, rtol=tolerance, atol=tolerance)


def assert_standard(scene: GaussianScene) -> None:
    """Check for finite values, unit quaternions and opacities strictly between 0 and 1."""
    for name, tensor in scene.tensors().items():
        assert bool(tensor.isfinite().all()), name
    norms = torch.linalg.vector_norm(scene.quats.double(), dim=1)
    assert bool(((norms - 1).abs() < 1e-5).all())
    opacities = torch.sigmoid(scene.logit_opacities)  # those of the scene itself are clamped
    assert bool(((opacities > 0) & (opacities < 1)).all())


def under_sky(count: int, *, distance: float, color: Tensor) -> GaussianScene:
    """An object of 20,000 Gaussians under a sky of few, as wide as they are apart."""
    thing = synthetic.scene("object", 20_000, sh_degree=0, seed=0)
    generator = torch.Generator().manual_seed(1)
    ways = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    sky = GaussianScene(
        means=thing.means.median(dim=0).values + distance * ways,
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), math.log(2.0 * distance / math.sqrt(count))),
        logit_opacities=torch.full((count,), 2.0),
        sh0=color.expand(count, 1, 3).clone(),
        shN=torch.zeros(count, 0, 3),
    )
    return concatenate([thing.with_tensors({}, {}), sky], fill=True)
