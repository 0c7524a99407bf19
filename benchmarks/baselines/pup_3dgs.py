"""PUP 3D-GS (Hanson, Tu, Singla, Jayawardhana, Zwicker, Goldstein: arXiv 2406.10219, CVPR 2025).

The sensitivity of the reconstruction error to a Gaussian is the log determinant of its block of
the Fisher approximation of the Hessian, for mean and scale only (we do not know the paper's
equation numbers):

    U_i = log det( sum over pixels and channels of  g g^T ),   g = d color / d (mean_i, scale_i)

a 6 x 6 matrix. The M most sensitive Gaussians are kept.

Differences from the paper:

- The paper's kernel computes g for every pixel. Ours estimates the sum without a kernel: with
  independent random signs e per pixel and channel, ``h = sum e g`` is the gradient of one number,
  and ``E[h h^T] = sum g g^T``, since ``E[e e'] = 0`` for different pixels. Every probe is one
  backward pass; the matrix is the mean over the probes of a view, summed over views. This is
  unbiased. The log determinant of a noisy matrix is too small, by about the same amount for all
  Gaussians seen by many probes, so the ranking is noisy rather than biased. A Gaussian must be seen
  by six probes; otherwise its matrix is singular and it is dropped first.
- Scales are the standard deviations, not their logarithms.
- This protocol has no training views. Automatic views replace them, which differ from those used
  for scoring. The paper's prune-refine rounds are left out.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.baselines.gaussians import keep_largest, usable
from cvtgs.cameras import Cameras
from cvtgs.rendering import BackendName, render
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views

VIEWS = 24
SIZE = 256
PROBES = 4


def simplify(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` most sensitive Gaussians; the seed draws signs and rotates the views."""
    valid = usable(scene, count)
    cameras = automatic_views(valid, VIEWS, width=SIZE, height=SIZE, seed=seed + 1)
    generator = torch.Generator().manual_seed(seed)
    fisher = torch.zeros(len(valid), 6, 6, dtype=torch.float64, device=valid.device)
    for camera in cameras.singles():
        signs = random_signs((PROBES, SIZE, SIZE, 3), generator).to(valid.device)
        fisher += projected_fisher(valid, camera, signs)
    return keep_largest(valid, sensitivity(fisher), count=count)


def random_signs(shape: tuple[int, ...], generator: torch.Generator) -> Float[Tensor, "*shape"]:
    return 2.0 * torch.randint(0, 2, shape, generator=generator).float() - 1.0


def projected_fisher(
    scene: GaussianScene,
    camera: Cameras,
    probes: Float[Tensor, "p h w 3"],
    *,
    backend: BackendName = "auto",
) -> Float[Tensor, "n 6 6"]:
    """Average ``h h^T`` over probes, with h the gradient of the image times the probe.

    Args:
        scene: The Gaussians.
        camera: One camera.
        probes: Numbers per pixel and channel. Random signs make the result an unbiased estimate
            of the sum of ``g g^T`` over pixels and channels; so does any random matrix whose rows
            have unit covariance. One-hot probes times the root of their number make it exact.
        backend: The rendering backend.

    Returns:
        One symmetric matrix per Gaussian, float64: mean first, then scale.
    """
    means = scene.means.detach().clone().requires_grad_()
    log_scales = scene.log_scales.detach().clone().requires_grad_()
    moving = scene.with_tensors({"means": means, "log_scales": log_scales}, {})
    image = render(moving, camera, backend=backend).rgb[0]
    per_log = torch.exp(-scene.log_scales.double())  # d log s / d s
    total = torch.zeros(len(scene), 6, 6, dtype=torch.float64, device=scene.device)
    for probe in probes:
        number = (image * probe.to(image)).sum()
        by_mean, by_log = torch.autograd.grad(number, (means, log_scales), retain_graph=True)
        h = torch.cat([by_mean.double(), by_log.double() * per_log], dim=1)
        total += h[:, :, None] * h[:, None, :]
    return total / len(probes)


def sensitivity(fisher: Float[Tensor, "n 6 6"]) -> Float[Tensor, "n"]:
    """Return ``log det``; minus infinity where the matrix is singular.

    Each matrix is first scaled to a unit diagonal, so that units do not affect the arithmetic.
    """
    size = fisher.diagonal(dim1=1, dim2=2)
    dead = (size <= 0).any(dim=1) | ~size.isfinite().all(dim=1)
    root = torch.where(dead[:, None], 1.0, size).sqrt()
    scaled = fisher / root[:, :, None] / root[:, None, :]
    eye = torch.eye(6, dtype=fisher.dtype, device=fisher.device)
    sign, log_det = torch.linalg.slogdet(torch.where(dead[:, None, None], eye, scaled))
    score = log_det + 2 * root.log().sum(dim=1)
    return torch.where(dead | (sign <= 0), -torch.inf, score)
