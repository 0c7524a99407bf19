"""The fast backend on CUDA: gsplat (Ye et al. 2024); the only file that imports it.

Written for gsplat 1.5.3. Without a GPU, the tests run against a stand-in with its signature and
arithmetic (tests/gsplat_stand_in.py). One rule differs from 3DGS: alpha is limited to 0.999 instead
of 0.99.
"""

from collections.abc import Callable
from functools import cache, partial
from importlib import import_module

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, MissingDependencyError, how_to_install
from cvtgs.math.spherical_harmonics import REST_COUNTS, evaluate
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.rendering import torch_backend
from cvtgs.rendering.backends import (
    STAGE,
    RasterOutput,
    contributions_by_gradient,
    observe_by_gradient,
)
from cvtgs.rendering.projection import DILATION, NEAR_PLANE, to_matrices
from cvtgs.scene import GaussianScene

PROBE_TOLERANCE = 0.02
"""Largest error of the probe's image and gradient, relative to their largest value.

Pixels with alpha near the cut-off of 1/255 may differ; a shift by half a pixel changes a third.
"""


def require(device: torch.device) -> None:
    """Check that this backend works on a device by rendering a Gaussian and comparing with torch.

    gsplat can be imported without CUDA and without a compiler, and fails only on use. Its first
    use may also compile its kernels, which takes minutes. The outcome is cached.
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
            f"{how_to_install('cvtgs[gsplat]')}, or use backend='torch'."
        )


def rasterize(
    scene: GaussianScene,
    cameras: Cameras,
    *,
    sh_degree: int,
    listener: ProgressListener = silent,
) -> RasterOutput:
    """Render all cameras at once with gsplat, in float32, if they treat tags and pixels alike.

    Memory: that of gsplat, linear in cameras times Gaussians and in intersections.
    """
    listener(ProgressEvent(stage=STAGE, done=0, total=len(cameras)))
    if len(scene) and len(cameras):
        are_mixed = scene.antialiased and len(set(cameras.ignores_tag)) > 1
        are_mixed = are_mixed or len(set(cameras.strides)) > 1
        parts = cameras.singles() if are_mixed else [cameras]
        found = [_rasterize_all(scene, part, sh_degree) for part in parts]
        layers, alpha = (torch.cat(images) for images in zip(*found, strict=True))
    else:
        to_matrices(cameras)  # checks them
        layers = scene.means.new_zeros(len(cameras), cameras.height, cameras.width, 4)
        alpha = layers[..., :1]
    listener(ProgressEvent(stage=STAGE, done=len(cameras), total=len(cameras)))
    layers, alpha = layers.to(scene.dtype), alpha.to(scene.dtype)
    return RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=alpha[..., 0])


contributions = partial(contributions_by_gradient, rasterize)
observe = partial(observe_by_gradient, rasterize)
blending_weights = torch_backend.blending_weights  # gsplat does not return them


def _rasterize_all(scene: GaussianScene, cameras: Cameras, sh_degree: int) -> tuple[Tensor, Tensor]:
    """Return sums of colours and depths, and alpha; all cameras treat tags and pixels alike."""
    rest = scene.shN[:, : REST_COUNTS[sh_degree]]
    if sh_degree:
        colors = torch.cat([scene.sh0, rest], dim=1)
    else:
        colors = evaluate(scene.sh0, rest, scene.means)
    means, viewmats, intrinsics = _about_cameras(scene, cameras)
    is_compensated = scene.antialiased and not any(cameras.ignores_tag)
    layers, alpha, _ = import_module("gsplat").rasterization(
        means=means.float(),
        quats=scene.quats.float(),
        scales=scene.scales.float(),
        opacities=scene.opacities.float(),
        colors=colors.float(),
        viewmats=viewmats,
        Ks=intrinsics,
        width=cameras.width,
        height=cameras.height,
        near_plane=NEAR_PLANE,
        eps2d=DILATION / max(cameras.strides, default=1) ** 2,
        sh_degree=sh_degree or None,
        packed=False,
        render_mode="RGB+D",
        rasterize_mode="antialiased" if is_compensated else "classic",
    )
    return layers, alpha


def _about_cameras(scene: GaussianScene, cameras: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return means and view matrices relative to the mean camera position, and intrinsics.

    gsplat works in float32, which is too coarse for positions far from the origin. What concerns
    cameras alone is computed on the host.
    """
    viewmats, intrinsics = to_matrices(cameras)
    rotations, count = viewmats[:, :3, :3], len(cameras)
    middle = -(rotations.mT @ viewmats[:, :3, 3:]).mean(dim=0)[:, 0]
    viewmats[:, :3, 3] += rotations @ middle
    table = torch.cat([middle, viewmats.flatten(), intrinsics.flatten()]).to(scene.device)
    middle, viewmats, intrinsics = table.split([3, 16 * count, 9 * count])
    means = scene.means.double() - middle
    return means, viewmats.float().view(-1, 4, 4), intrinsics.float().view(-1, 3, 3)


@cache
def _failure(device: str) -> str:
    """Return why gsplat does not render as the torch backend does, or "" if it does.

    Enables gradients, since the caller may have disabled them.
    """
    with torch.inference_mode(mode=False), torch.enable_grad():
        image, gradient = _probe(torch_backend.rasterize, "cpu")
        try:
            import_module("gsplat")
            found_image, found_gradient = _probe(rasterize, device)
        except ImportError as error:
            return f"it cannot be imported ({_first_line(error)})"
        except Exception as error:  # a build or a driver may raise anything
            return f"it failed to render ({type(error).__name__}: {_first_line(error)})"
    for name, found, wanted in (
        ("image", found_image, image),
        ("gradient", found_gradient, gradient),
    ):
        apart = float((found - wanted).abs().amax() / wanted.abs().amax())
        if not apart < PROBE_TOLERANCE:  # also true for NaN
            return f"its {name} of one Gaussian differs by {apart:.0%} from that of backend 'torch'"
    return ""


def _probe(rasterize_one: Callable[..., RasterOutput], device: str) -> tuple[Tensor, Tensor]:
    """Return an image of one Gaussian and a gradient with respect to its mean, on the CPU.

    Nothing in the scene is symmetric, so shifted pixels, swapped axes and a different order of SH
    coefficients or quaternion components all show up.
    """
    scene = GaussianScene(
        means=torch.tensor([[0.05, -0.02, 1.0]]),
        quats=torch.tensor([[0.9, 0.1, -0.2, 0.4]]),
        log_scales=torch.tensor([[0.08, 0.16, 0.12]]).log(),
        logit_opacities=torch.tensor([0.4]),
        sh0=torch.tensor([[[1.0, 0.5, 0.1]]]),
        shN=torch.tensor([[[0.3, 0.0, 0.1], [0.2, 0.4, 0.0], [0.0, 0.3, 0.2]]]),
    ).to(device)
    means = scene.means.requires_grad_()
    cameras = Cameras(
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[8.0, 0, 3.7], [0, 9, 3.2], [0, 0, 1]]]),
        width=8,
        height=7,
    ).to(device)
    output = rasterize_one(scene, cameras, sh_degree=1)
    image = torch.cat([output.rgb, output.depth[..., None], output.alpha[..., None]], dim=-1)
    ramp = torch.linspace(0, 1, image.numel(), device=image.device).reshape(image.shape)
    (gradient,) = torch.autograd.grad((image * ramp).sum(), means)
    return image.detach().cpu(), gradient.cpu()


def _first_line(error: Exception) -> str:
    """Return the first line of a message, which may hold a compiler's whole output."""
    return next(iter(str(error).splitlines()), "no reason given")
