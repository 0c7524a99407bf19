"""How much of the images of a scene every Gaussian paints."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.rendering.backends import BackendName, choose_backend
from cvtgs.rendering.output import RasterOutput
from cvtgs.scene import GaussianScene


def contributions(
    scene: GaussianScene, cameras: Cameras, *, backend: BackendName = "auto"
) -> Float[Tensor, "n"]:
    """Sum what every Gaussian adds to the pixels of some images: ``alpha * T``.

    ``T`` is the transmittance of what lies in front (Kerbl et al. 2023, equation 3). Colours do
    not matter. The sums of all Gaussians add up to the alpha of the images.

    Memory: that of rendering one image, with its gradient for backends other than ``numba``.

    Args:
        scene: The Gaussians.
        cameras: From where to look.
        backend: What renders, as in :func:`cvtgs.rendering.render`.

    Returns:
        Pixels, float64: 0 for what no image shows.

    Raises:
        InvalidArgumentError: A camera is no pinhole camera, or there is no such backend.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> seen = contributions(scene, automatic_views(scene, 2, width=32, height=32))
        >>> tuple(seen.shape), bool((seen >= 0).all()), bool(seen.sum() <= 2 * 32 * 32)
        ((500,), True, True)
    """
    chosen = choose_backend(backend, scene.device)[1]
    placed = cameras.to(scene.device)
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    for number in range(len(cameras)):
        camera = placed.select(torch.tensor([number], device=scene.device))
        total += chosen.contributions(scene, camera)
    return total


def contributions_by_gradient(
    rasterize: Callable[..., RasterOutput], scene: GaussianScene, camera: Cameras
) -> Float[Tensor, "n"]:
    """Find contributions as the gradient of the image's sum with respect to the colours."""
    with torch.enable_grad():
        # Grey, where no colour is clipped, without the bands that do not matter here.
        sh0 = torch.zeros_like(scene.sh0).requires_grad_()
        gray = scene.with_tensors({"sh0": sh0, "shN": scene.shN[:, :0]}, {})
        image = rasterize(gray, camera, sh_degree=0).rgb
        (gradient,) = torch.autograd.grad(image[..., 0].sum(), sh0)
    return gradient[:, 0, 0].double().clamp_min(0.0) / SH_C0
