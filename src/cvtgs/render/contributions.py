"""How much of the pictures of a scene every Gaussian paints."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.render import BackendName, render
from cvtgs.scene import GaussianScene


def visibility(
    scene: GaussianScene, cameras: Cameras, *, backend: BackendName = "auto"
) -> Float[Tensor, "n"]:
    """Sum what every Gaussian adds to the pixels of some pictures: ``alpha * T``.

    The colour of a pixel is the sum of ``alpha_i T_i color_i`` (Kerbl et al. 2023, equation 3),
    so the sum over all pixels is the gradient of the picture's sum with respect to ``color_i``:
    one backward pass per picture, by whatever renders.

    Memory: that of one picture and its gradient at a time.

    Args:
        scene: The Gaussians, with valid rows.
        cameras: From where to look, at least one.
        backend: What renders.

    Returns:
        Pixels, float64: 0 for what no picture shows.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 500, sh_degree=0, seed=0)
        >>> seen = visibility(scene, automatic_views(scene, 2, width=32, height=32))
        >>> tuple(seen.shape), bool((seen >= 0).all()), bool(seen.sum() <= 2 * 32 * 32)
        ((500,), True, True)
    """
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    with torch.enable_grad():
        # Grey, where no colour is clipped, without the bands that do not matter here.
        sh0 = torch.zeros_like(scene.sh0).requires_grad_()
        gray = scene.with_tensors({"sh0": sh0, "shN": scene.shN[:, :0]}, {})
        for number in range(len(cameras)):
            camera = cameras.select(torch.tensor([number]))
            picture = render(gray, camera, backend=backend).rgb
            (gradient,) = torch.autograd.grad(picture[..., 0].sum(), sh0)
            total += gradient[:, 0, 0].double() / SH_C0
    return total.clamp_min(0.0)
