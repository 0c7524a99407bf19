"""The fast backend on CUDA: gsplat (Ye et al. 2024); the only file that imports it.

Never run by this project's tests, which have no GPU: written against the documentation of
gsplat 1.5. It differs from the rules of 3DGS in this: alpha is at most 0.999 instead of 0.99.
"""

from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, MissingDependencyError
from cvtgs.math.spherical_harmonics import REST_COUNTS, evaluate
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.rendering.backends import STAGE, RasterOutput, contributions_by_gradient
from cvtgs.rendering.projection import DILATION, NEAR_PLANE, to_pinholes
from cvtgs.scene import GaussianScene


def require(device: torch.device) -> None:
    """Check that this backend works on a device, by a tiny image.

    gsplat imports without CUDA and without a compiler, and fails only when it is used; it may
    also compile its kernels then, which takes minutes, once. The outcome is remembered.
    """
    if device.type != "cuda":
        raise DeviceError(
            f"backend 'gsplat' works on CUDA only, found a scene on {device}; "
            f"use 'torch' or 'auto', or move the scene."
        )
    failure = _failure(str(device))
    if failure:
        raise MissingDependencyError(
            f"backend 'gsplat' needs a working gsplat, but {failure}; "
            f"install it with: pip install 'cvtgs[gsplat]', or use backend='torch'."
        )


def rasterize(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    sh_degree: int,
    listener: ProgressListener = silent,
) -> RasterOutput:
    """Render with gsplat, in float32, all cameras at once.

    Memory: gsplat's, linear in cameras times Gaussians, and in intersections.
    """
    to_pinholes(cameras)  # checks them
    listener(ProgressEvent(stage=STAGE, done=0, total=len(cameras)))
    if len(scene) and len(cameras):
        layers, alpha = _rasterize_all(scene, cameras, sh_degree)
    else:
        layers = scene.means.new_zeros(len(cameras), cameras.height, cameras.width, 4)
        alpha = layers[..., :1]
    listener(ProgressEvent(stage=STAGE, done=len(cameras), total=len(cameras)))
    layers, alpha = layers.to(scene.dtype), alpha.to(scene.dtype)
    return RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=alpha[..., 0])


def contributions(scene: GaussianScene, camera: Cameras) -> Tensor:
    """Return every Gaussian's sum of weights ``alpha * T`` over one image."""
    return contributions_by_gradient(rasterize, scene, camera)


def _rasterize_all(scene: GaussianScene, cameras: Cameras, sh_degree: int) -> tuple[Tensor, Tensor]:
    """Return colours with depths, times what they hide, and alpha."""
    rest = scene.shN[:, : REST_COUNTS[sh_degree]]
    if sh_degree:
        colors = torch.cat([scene.sh0, rest], dim=1)
    else:
        colors = evaluate(scene.sh0, rest, scene.means)
    means, viewmats = _about_cameras(scene, cameras)
    layers, alpha, _ = _gsplat().rasterization(
        means=means.float(),
        quats=scene.quats.float(),
        scales=scene.scales.float(),
        opacities=scene.opacities.float(),
        colors=colors.float(),
        viewmats=viewmats.float(),
        Ks=cameras.Ks.float(),
        width=cameras.width,
        height=cameras.height,
        near_plane=NEAR_PLANE,
        eps2d=DILATION,
        sh_degree=sh_degree or None,
        packed=False,
        render_mode="RGB+D",
        rasterize_mode="antialiased" if scene.antialiased else "classic",
    )
    return layers, alpha


def _about_cameras(scene: GaussianScene, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return means and view matrices about the middle of the cameras, in float64.

    Far from the origin float32, in which gsplat works, holds neither.
    """
    viewmats = cameras.viewmats.double().clone()
    middle = cameras.centers.double().mean(dim=0)
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ middle
    return scene.means.double() - middle, viewmats


def _gsplat() -> Any:
    return import_module("gsplat")


@cache
def _failure(device: str) -> str:
    """Render one Gaussian and its gradient; say why that failed, or nothing if it did not."""
    try:
        gsplat = _gsplat()
        means = torch.tensor([[0.0, 0.0, 1.0]], device=device, requires_grad=True)
        colors, _, _ = gsplat.rasterization(
            means=means,
            quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
            scales=torch.full((1, 3), 0.1, device=device),
            opacities=torch.full((1,), 0.5, device=device),
            colors=torch.ones(1, 3, device=device),
            viewmats=torch.eye(4, device=device)[None],
            Ks=torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]], device=device),
            width=8,
            height=8,
            packed=False,
        )
        colors.sum().backward()
        lit = float(colors.detach().amax())
    except ImportError as error:
        return f"it cannot be imported ({_first_line(error)})"
    except Exception as error:  # whatever a build or a driver may raise
        return f"it failed to render ({type(error).__name__}: {_first_line(error)})"
    return "" if 0.4 < lit < 0.6 else f"it rendered {lit:.3g} where 0.5 was expected"


def _first_line(error: Exception) -> str:
    """Shorten the message of a failed build, which may hold the compiler's whole output."""
    return next(iter(str(error).splitlines()), "no reason given")
