"""Errors of images, shared out among the Gaussians that they show."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.devices import full_precision
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.rendering.backends import BackendName, without_gradients
from cvtgs.rendering.render import ObservedViews, check_observed, render
from cvtgs.scene import GaussianScene, check_scene

LEAST_ERROR = 1e-12  # mean squared error below which images count as equal


@full_precision()
def error_shares(
    scene: GaussianScene, views: ObservedViews, *, backend: BackendName = "auto"
) -> Float[Tensor, "n"]:
    """Share out the squared errors of images among the Gaussians of a scene.

    The error of a pixel, relative to the mean of its image, counts for every Gaussian with its
    blending weight ``alpha * T``, the derivative of the image by the Gaussian's colour.

    Memory: that of rendering one image with its gradient.

    Args:
        scene: The Gaussians.
        views: The images that those of the scene should equal.
        backend: The backend, as in :func:`cvtgs.rendering.render`.

    Returns:
        Shares in pixels, float64; 0 for Gaussians that no image shows or that are drawn black.

    Raises:
        InvalidArgumentError: ``views`` are no observed views, or there is no such backend.
        DeviceError: The backend does not work on the scene's device.
        MissingDependencyError: The backend's package is missing.

    Example:
        >>> from cvtgs.rendering import observe
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> views = observe(scene, automatic_views(scene, 2, width=32, height=32))
        >>> float(error_shares(scene, views).sum()), tuple(error_shares(scene[:9], views).shape)
        (0.0, (9,))
    """
    check_scene(scene)
    check_observed(views, "views")
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    for shares, mean in errors_by_view(scene, views, backend=backend):
        total += shares / mean.clamp_min(LEAST_ERROR)
    return total


def errors_by_view(
    scene: GaussianScene, views: ObservedViews, *, backend: BackendName = "auto"
) -> Iterator[tuple[Float[Tensor, "n"], Float[Tensor, ""]]]:
    """Yield the shares of each image in its squared error, as sums over pixels, and its mean."""
    constant = without_gradients(scene)
    for camera, wanted in zip(views.cameras.singles(), views.rgb, strict=True):
        with torch.inference_mode(mode=False), torch.enable_grad():
            colors = constant.sh0.clone().requires_grad_()
            drawn = constant.with_tensors(sh0=colors)
            image = render(drawn, camera, backend=backend).rgb[0]
            differences = image.detach().clamp(0, 1) - wanted.to(image).clamp(0, 1)
            squares = differences.square().sum(dim=2, keepdim=True)
            found = torch.zeros_like(colors)
            if image.requires_grad:  # else an empty one of gsplat
                (found,) = torch.autograd.grad((image * squares).sum(), colors)
        # A channel below 0 is drawn as 0 and has no gradient; the others have the same one.
        shares = found.flatten(1).amax(dim=1).double() / SH_C0
        yield shares, squares.mean(dtype=torch.float64)
