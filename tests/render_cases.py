"""Scenes, cameras and comparisons that the tests of the renderer share."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch

import render_oracle as oracle
from cvtgs import GaussianScene
from cvtgs.cameras import Cameras, look_at
from cvtgs.rendering import render

BACKENDS = ["torch", *(["numba"] if find_spec("numba") else [])]
backends = pytest.mark.parametrize("backend", BACKENDS)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
C0 = 0.28209479177387814
MIP = ("SplatRenderMode: mip",)


def straight(width=9, height=7, focal=20.0, *, dtype=torch.float64):
    """A camera at the origin that looks along z, its axis through the middle of a pixel."""
    return Cameras(
        viewmats=torch.eye(4, dtype=dtype)[None],
        Ks=torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=dtype),
        width=width,
        height=height,
    )


def one_camera(width: int, height: int) -> Cameras:
    """Look along z from five units away."""
    eye = torch.tensor([[0.0, 0.0, -5.0]], dtype=torch.float64)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    focal = 1.5 * width
    matrix = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Cameras(
        viewmats=look_at(eye, torch.zeros_like(eye), up),
        Ks=torch.tensor([matrix], dtype=torch.float64),
        width=width,
        height=height,
    )


def around(count=2, width=37, height=29, focal=40.0):
    """Cameras around the origin, their principal points off the middle."""
    turns = torch.arange(count, dtype=torch.float64) * 2.1 + 0.3
    eyes = torch.stack([5 * turns.cos(), turns.sin() - 1.5, 5 * turns.sin()], dim=1)
    viewmats = look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, -1, 0]).double())
    rows = [[focal, 0, width / 2 + 1.7], [0, focal * 1.1, height / 2 - 0.6], [0, 0, 1.0]]
    return Cameras(
        viewmats=viewmats,
        Ks=torch.tensor(rows).double().expand(count, 3, 3),
        width=width,
        height=height,
    )


def scene_of(*rows, dtype=torch.float64, comments=()):
    """Rows are mean, scales, opacity, colour (of every direction) and optionally a quaternion."""
    quats = [row[4] if len(row) > 4 else (1.0, 0, 0, 0) for row in rows]
    return GaussianScene(
        means=torch.tensor([row[0] for row in rows], dtype=dtype).reshape(-1, 3),
        quats=torch.tensor(quats, dtype=dtype).reshape(-1, 4),
        log_scales=torch.tensor([row[1] for row in rows]).double().log().to(dtype).reshape(-1, 3),
        logit_opacities=torch.tensor([row[2] for row in rows]).double().logit().to(dtype),
        sh0=((torch.tensor([row[3] for row in rows], dtype=dtype) - 0.5) / C0).reshape(-1, 1, 3),
        shN=torch.zeros(len(rows), 0, 3, dtype=dtype),
        comments=comments,
    )  # fmt: skip


def oracle_images(scene, cameras, **options):
    gaussians = [
        oracle.Gaussian(
            mean=scene.means[row].tolist(),
            quat=scene.quats[row].tolist(),
            log_scales=scene.log_scales[row].tolist(),
            logit=scene.logit_opacities[row].item(),
            sh=scene.sh[row].double().numpy(),
        )
        for row in range(len(scene))
    ]
    images = [
        oracle.render(
            gaussians,
            oracle.Camera(
                viewmat=viewmat.double().numpy(),
                K=K.double().numpy(),
                width=cameras.width,
                height=cameras.height,
            ),
            antialiased=scene.antialiased,
            **options,
        )
        for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True)
    ]
    return tuple(torch.from_numpy(np.stack(layer)) for layer in zip(*images, strict=True))


def assert_oracle(scene, cameras, backend, *, atol):
    """Compare all three layers; depth only where it is not a quotient of tiny numbers."""
    rgb, alpha, depth = oracle_images(scene, cameras)
    found = render(scene, cameras, backend=backend, depth=True)
    torch.testing.assert_close(found.rgb.double(), rgb, rtol=0, atol=atol)
    torch.testing.assert_close(found.alpha.double(), alpha, rtol=0, atol=atol)
    solid = alpha > 0.05
    torch.testing.assert_close(
        found.depth.double()[solid], depth[solid], rtol=100 * atol, atol=100 * atol
    )
