"""The fast backend on CUDA: gsplat (Ye et al. 2024); the only file that imports it.

Written for gsplat 1.5.3. Without a GPU, the tests run against a stand-in with its signature and
arithmetic (tests/gsplat_stand_in.py). One rule differs from 3DGS: alpha is limited to 0.999 instead
of 0.99.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib import import_module
from itertools import chain

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, MissingDependencyError, how_to_install
from cvtgs.math.parameters import NEAR_PLANE
from cvtgs.math.spherical_harmonics import REST_COUNTS, evaluate
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.rendering import torch_backend
from cvtgs.rendering.backends import STAGE, RasterOutput, observe_in_two_passes, without_gradients
from cvtgs.rendering.projection import DILATION, rows_are_finite, to_matrices
from cvtgs.scene import GaussianScene

# Largest number of Gaussians that are rendered at once, counted once for every camera
TOGETHER = 1 << 22
PIXELS_TOGETHER = 1 << 22  # largest number of pixels that are rendered at once
# Largest error of the probe's image and gradient, relative to their largest value. Pixels with
# alpha near the cut-off of 1/255 may differ; a shift by half a pixel changes a third.
PROBE_TOLERANCE = 0.02


def require(device: torch.device) -> None:
    """Render a Gaussian and compare with torch, once: only use shows whether gsplat works."""
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
    scene: GaussianScene, cameras: Cameras, *, sh_degree: int, listener: ProgressListener = silent
) -> RasterOutput:
    """Render in float32, several cameras at once if they treat pixels alike.

    Memory: that of gsplat for :data:`TOGETHER` Gaussians and :data:`PIXELS_TOGETHER` pixels.
    """
    listener(ProgressEvent(stage=STAGE, done=0, total=len(cameras)))
    if len(scene) and len(cameras):
        rest = scene.shN[:, : REST_COUNTS[sh_degree]]
        if sh_degree:
            colors = torch.cat([scene.sh0, rest], dim=1)
        else:
            colors = evaluate(scene.sh0, rest, scene.means)
        groups = _alike(scene, cameras)
        parts = [cameras] if len(groups) == 1 else [cameras.select(rows) for rows in groups]
        found = [_rasterize_all(scene, part, colors, sh_degree=sh_degree) for part in parts]
        layers, alpha = (_in_order(images, groups) for images in zip(*found, strict=True))
    else:
        to_matrices(cameras)  # checks them
        layers = scene.means.new_zeros(len(cameras), cameras.height, cameras.width, 4)
        alpha = layers[..., :1]
    listener(ProgressEvent(stage=STAGE, done=len(cameras), total=len(cameras)))
    layers, alpha = layers.to(scene.dtype), alpha.to(scene.dtype)
    return RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=alpha[..., 0])


def contributions(scene: GaussianScene, cameras: Cameras) -> Iterator[Float[Tensor, "n"]]:
    """Yield contributions, as gradients of summed images with respect to a colour per camera.

    Memory: that of gsplat as for images, with gradients.
    """
    if len(scene) == 0 or len(cameras) == 0:
        to_matrices(cameras)  # checks them
        yield from scene.means.new_zeros(len(cameras), 0, dtype=torch.float64)
        return
    groups = _alike(scene, cameras)
    if list(chain(*groups)) != list(range(len(cameras))):
        groups = [[row] for row in range(len(cameras))]  # in order, and few are kept
    plain = without_gradients(scene)
    for rows in groups:
        part = cameras.select(rows)
        with torch.inference_mode(mode=False), torch.enable_grad():
            shape = len(part), len(scene), 1
            colors = plain.means.new_zeros(shape, dtype=torch.float32, requires_grad=True)
            layers, _ = _rasterize_all(plain, part, colors, render_mode="RGB")
            (gradient,) = torch.autograd.grad(layers.sum(), colors)
        yield from gradient[:, :, 0].double().clamp_min(0.0)


def observe(
    scene: GaussianScene, cameras: Cameras, *, sh_degree: int
) -> Iterator[tuple[RasterOutput, Float[Tensor, "n"]]]:
    """Yield every image, and the contributions to it, as gradients of one more colour channel."""
    if sh_degree or len(scene) == 0:  # gsplat takes no further channel with SH coefficients
        yield from observe_in_two_passes(rasterize, contributions, scene, cameras, sh_degree)
        return
    plain = without_gradients(scene)
    for camera in cameras.singles():
        with torch.inference_mode(mode=False), torch.enable_grad():
            colors = evaluate(plain.sh0, plain.shN[:, :0], plain.means).float()
            channel = torch.zeros_like(colors[:, :1], requires_grad=True)
            layers, alpha = _rasterize_all(plain, camera, torch.cat([colors, channel], dim=1))
            (gradient,) = torch.autograd.grad(layers[..., 3].sum(), channel)
        layers, alpha = layers.detach().to(scene.dtype), alpha.detach().to(scene.dtype)
        output = RasterOutput(rgb=layers[..., :3], depth=layers[..., 4], alpha=alpha[..., 0])
        yield output, gradient[:, 0].double().clamp_min(0.0)


blending_weights = torch_backend.blending_weights  # gsplat does not return them


def _alike(scene: GaussianScene, cameras: Cameras) -> list[list[int]]:
    """Return groups of the row numbers of cameras that treat tags and pixels alike."""
    alike: dict[tuple[int, bool], list[int]] = {}
    for row in range(len(cameras)):
        stride = cameras.strides[row] if cameras.strides else 1
        ignores_tag = scene.antialiased and bool(cameras.ignores_tag) and cameras.ignores_tag[row]
        alike.setdefault((stride, ignores_tag), []).append(row)
    most = min(TOGETHER // len(scene), PIXELS_TOGETHER // (cameras.width * cameras.height))
    most = max(1, most)
    return [
        rows[start : start + most] for rows in alike.values() for start in range(0, len(rows), most)
    ]


def _in_order(parts: Sequence[Tensor], groups: Sequence[Sequence[int]]) -> Tensor:
    """Return the images of groups of cameras in the order of the cameras."""
    if len(parts) == 1:
        return parts[0]
    rows = list(chain(*groups))
    images = list(chain(*(part.split(1) for part in parts)))
    return torch.cat([images[place] for place in sorted(range(len(rows)), key=rows.__getitem__)])


def _rasterize_all(
    scene: GaussianScene,
    cameras: Cameras,
    colors: Tensor,
    *,
    sh_degree: int = 0,
    render_mode: str = "RGB+D",
) -> tuple[Tensor, Tensor]:
    """Return sums of colours and depths, and alpha; all cameras treat tags and pixels alike."""
    means, viewmats, intrinsics = _about_cameras(scene, cameras)
    is_compensated = scene.antialiased and not any(cameras.ignores_tag)
    is_drawn = rows_are_finite(scene.sh0, scene.shN[:, : REST_COUNTS[sh_degree]])
    if means.requires_grad:  # which colours of Gaussians that are not drawn would make NaN
        colors = colors.where(colors.isfinite(), 0)
    layers, alpha, _ = import_module("gsplat").rasterization(
        means=means.float(),
        quats=scene.quats.float(),
        scales=scene.scales.float(),
        opacities=scene.opacities.where(is_drawn, 0).float(),
        colors=colors.float(),
        viewmats=viewmats,
        Ks=intrinsics,
        width=cameras.width,
        height=cameras.height,
        near_plane=NEAR_PLANE,
        far_plane=torch.finfo(torch.float32).max,  # none: the default would cut off large scenes
        eps2d=DILATION / max(cameras.strides, default=1) ** 2,
        sh_degree=sh_degree or None,
        packed=False,
        render_mode=render_mode,
        rasterize_mode="antialiased" if is_compensated else "classic",
    )
    return layers, alpha


def _about_cameras(scene: GaussianScene, cameras: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return means and view matrices relative to the median camera, and intrinsics.

    In float32, positions far from the origin are too coarse; a mean would follow a stray camera.
    """
    viewmats, intrinsics = to_matrices(cameras)
    rotations, count = viewmats[:, :3, :3], len(cameras)
    middle = -(rotations.mT @ viewmats[:, :3, 3:])[:, :, 0].median(dim=0).values
    viewmats[:, :3, 3] += rotations @ middle
    table = torch.cat([middle, viewmats.flatten(), intrinsics.flatten()])
    table = table.to(scene.device, non_blocking=True)  # or the host would wait for earlier images
    middle, viewmats, intrinsics = table.split([3, 16 * count, 9 * count])
    means = scene.means.double() - middle
    return means, viewmats.float().view(-1, 4, 4), intrinsics.float().view(-1, 3, 3)


@cache
def _failure(device: str) -> str:
    """Return why gsplat does not render as the torch backend does, or "" if it does."""
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
    """Return an image of an asymmetric Gaussian, and a gradient by its mean, on the CPU."""
    number = partial(torch.tensor, dtype=torch.float32, device="cpu")
    scene = GaussianScene(
        means=number([[0.05, -0.02, 1.0]]),
        quats=number([[0.9, 0.1, -0.2, 0.4]]),
        log_scales=number([[0.08, 0.16, 0.12]]).log(),
        logit_opacities=number([0.4]),
        sh0=number([[[1.0, 0.5, 0.1]]]),
        shN=number([[[0.3, 0.0, 0.1], [0.2, 0.4, 0.0], [0.0, 0.3, 0.2]]]),
    ).to(device)
    means = scene.means.requires_grad_()
    cameras = Cameras(
        viewmats=torch.eye(4, dtype=torch.float32, device="cpu")[None],
        Ks=number([[[8.0, 0, 3.7], [0, 9, 3.2], [0, 0, 1]]]),
        width=8,
        height=7,
    ).to(device)
    output = rasterize_one(scene, cameras, sh_degree=1)
    image = torch.cat([output.rgb, output.depth[..., None], output.alpha[..., None]], dim=-1)
    ramp = torch.linspace(0, 1, image.numel(), dtype=image.dtype, device=image.device)
    (gradient,) = torch.autograd.grad((image.flatten() * ramp).sum(), means)
    return image.detach().cpu(), gradient.cpu()


def _first_line(error: Exception) -> str:
    """Return the first line of a message, which may hold a compiler's whole output."""
    return next(iter(str(error).splitlines()), "no reason given")
