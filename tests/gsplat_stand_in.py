"""A stand-in for gsplat 1.5.3 without CUDA: the documented signature and arithmetic in torch.

Slow, in float64 and without tiles: every pixel looks at every Gaussian. It follows the scalar
oracle in render_oracle.py, with which tests/rendering/test_gsplat.py compares it, and imports
nothing of the library. What cvtgs has no use for is refused, not ignored.
"""

import math

import torch
from torch import Tensor

MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
MAX_ALPHA = 0.999
CENTER = 0.5
"""Position of the sample within a pixel; tests move it."""

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization(  # noqa: PLR0917 (gsplat's own signature)
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,  # noqa: N803
    width,
    height,
    near_plane=0.01,
    far_plane=1e10,
    radius_clip=0.0,
    eps2d=0.3,
    sh_degree=None,
    packed=True,
    tile_size=16,
    backgrounds=None,
    render_mode="RGB",
    sparse_grad=False,
    absgrad=False,
    rasterize_mode="classic",
    channel_chunk=32,
    distributed=False,
    camera_model="pinhole",
    segmented=False,
    covars=None,
    with_ut=False,
    with_eval3d=False,
    radial_coeffs=None,
    tangential_coeffs=None,
    thin_prism_coeffs=None,
    ftheta_coeffs=None,
    rolling_shutter=None,
    viewmats_rs=None,
):
    """Return colours ``(c, h, w, x)``, alphas ``(c, h, w, 1)`` and a dictionary of the rest."""
    others = (sparse_grad, absgrad, distributed, segmented, covars, with_ut, with_eval3d)
    lenses = (radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, viewmats_rs)
    if any(option not in (None, False) for option in (*others, *lenses, rolling_shutter)):
        raise NotImplementedError("the stand-in renders static pinhole cameras only")
    if camera_model != "pinhole" or rasterize_mode not in ("classic", "antialiased"):
        raise NotImplementedError(f"{camera_model}, {rasterize_mode}")
    assert render_mode in RENDER_MODES, render_mode
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    tensors |= {"colors": colors, "viewmats": viewmats, "Ks": Ks}
    _check(tensors, sh_degree)
    means, quats, scales, opacities, colors, viewmats, Ks = (  # noqa: N806
        t.double() for t in (means, quats, scales, opacities, colors, viewmats, Ks)
    )
    images, alphas, splats = [], [], []
    for camera in range(len(viewmats)):
        splat = _project(means, quats, scales, viewmats[camera], Ks[camera], width, height, eps2d)
        splat["opacities"] = opacities
        if rasterize_mode == "antialiased":
            splat["opacities"] = opacities * splat["compensations"]
        splat["radii"] = _radii(splat, width, height, near_plane, far_plane, radius_clip)
        own = colors[camera] if colors.dim() == (3 if sh_degree is None else 4) else colors
        if sh_degree is not None:
            rotation, shift = viewmats[camera, :3, :3], viewmats[camera, :3, 3]
            own = _colors(means + torch.linalg.inv(rotation) @ shift, own, sh_degree)
        depths = splat["depths"][:, None]
        own = {"R": torch.cat([own, depths], 1), "D": depths, "E": depths}[render_mode[0]]
        if render_mode == "RGB":
            own = own[:, :-1]
        image, alpha = _blend(splat, own, width, height)
        if "ED" in render_mode:
            image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)
        if backgrounds is not None:
            image = image + (1 - alpha) * backgrounds[camera].double()
        images.append(image)
        alphas.append(alpha)
        splats.append(splat)
    names = ("radii", "means2d", "depths", "conics", "opacities")
    meta = {name: torch.stack([splat[name] for splat in splats]) for name in names}
    if packed:  # one row per Gaussian and camera that shows it
        camera_ids, gaussian_ids = (meta["radii"] > 0).all(-1).nonzero(as_tuple=True)
        meta = {name: values[camera_ids, gaussian_ids] for name, values in meta.items()}
        meta |= {"camera_ids": camera_ids, "gaussian_ids": gaussian_ids}
    meta |= {"width": width, "height": height, "tile_size": tile_size, "n_cameras": len(viewmats)}
    return torch.stack(images).float(), torch.stack(alphas).float(), meta


def _check(tensors: dict[str, Tensor], sh_degree: int | None) -> None:
    """Refuse other shapes and dtypes than gsplat documents."""
    n, c, colors = len(tensors["means"]), len(tensors["viewmats"]), tensors["colors"]
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    shapes |= {"viewmats": (c, 4, 4), "Ks": (c, 3, 3)}
    for name, shape in shapes.items():
        assert tensors[name].shape == shape, (name, tensors[name].shape)
    if sh_degree is None:
        assert colors.shape[:-1] in ((n,), (c, n)), colors.shape
    else:
        assert colors.shape[:-2] in ((n,), (c, n)), colors.shape
        assert colors.shape[-1] == 3, colors.shape
        assert (sh_degree + 1) ** 2 <= colors.shape[-2], colors.shape
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise RuntimeError(f"expected scalar type Float but found {tensor.dtype} ({name})")


def _project(means, quats, scales, viewmat, K, width, height, eps2d):  # noqa: N803, PLR0917
    rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
    x, y, z = (means @ rotation.T + shift).unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    # Far outside of the image the Jacobian is that of a point 15 % of the image beyond its edge.
    u = (x / z).clamp(-(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx)
    v = (y / z).clamp(-(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z]
    spread = torch.stack(rows, 1).reshape(-1, 2, 3) @ rotation @ _matrices(quats) * scales[:, None]
    bare = spread @ spread.mT
    dilated = bare + eps2d * torch.eye(2, dtype=bare.dtype)
    ratio = torch.linalg.det(bare) / torch.linalg.det(dilated)
    return {
        "means2d": torch.stack([fx * x / z + cx, fy * y / z + cy], 1),
        "depths": z,
        "covariances": dilated,
        "conics": torch.linalg.inv(dilated).reshape(-1, 4)[:, [0, 1, 3]],
        "compensations": ratio.clamp_min(1e-30).sqrt(),
    }


def _matrices(quats: Tensor) -> Tensor:
    """Rotate the axes by q v q*, one after the other."""
    w, vector = quats[:, :1], quats[:, 1:]
    length = (quats * quats).sum(1, keepdim=True)
    columns = []
    for axis in torch.eye(3, dtype=quats.dtype):
        turned = (w * w - (vector * vector).sum(1, keepdim=True)) * axis
        turned = turned + 2 * (vector @ axis)[:, None] * vector
        columns.append(turned + 2 * w * torch.linalg.cross(vector, axis.expand_as(vector)))
    return torch.stack([column / length for column in columns], dim=2)


def _radii(splat, width, height, near_plane, far_plane, radius_clip) -> Tensor:
    """Half sizes in whole pixels of the area with an alpha of 1/255 or more; 0 if not visible."""
    reach = (2 * (splat["opacities"].detach() / MIN_ALPHA).clamp_min(1).log()).sqrt()
    sizes = splat["covariances"].detach().diagonal(dim1=1, dim2=2).sqrt()
    radii = (reach[:, None] * sizes).ceil()
    center = splat["means2d"].detach()
    bounds = torch.tensor([width, height], dtype=center.dtype)
    inside = ((center + radii > 0) & (center - radii < bounds)).all(1)
    inside &= (splat["depths"] >= near_plane) & (splat["depths"] <= far_plane)
    inside &= (radii > radius_clip).any(1)
    return torch.where(inside[:, None], radii, 0).to(torch.int32)


def _colors(away: Tensor, sh: Tensor, degree: int) -> Tensor:
    """Clamp the sum of 0.5 and the harmonics of degrees up to 3, in the order and signs of 3DGS."""
    x, y, z = (away / away.norm(dim=1, keepdim=True)).unbind(1)
    one = torch.ones_like(x)

    def norm(value: float) -> float:
        return math.sqrt(value / math.pi)

    basis = [norm(1 / 4) * one, -norm(3 / 4) * y, norm(3 / 4) * z, -norm(3 / 4) * x]
    basis += [norm(15 / 4) * x * y, -norm(15 / 4) * y * z, norm(5 / 16) * (3 * z * z - 1)]
    basis += [-norm(15 / 4) * x * z, norm(15 / 16) * (x * x - y * y)]
    basis += [-norm(35 / 32) * y * (3 * x * x - y * y), norm(105 / 4) * x * y * z]
    basis += [-norm(21 / 32) * y * (5 * z * z - 1), norm(7 / 16) * z * (5 * z * z - 3)]
    basis += [-norm(21 / 32) * x * (5 * z * z - 1), norm(105 / 16) * z * (x * x - y * y)]
    basis += [-norm(35 / 32) * x * (x * x - 3 * y * y)]
    used = (degree + 1) ** 2
    return (0.5 + torch.einsum("kn,nkc->nc", torch.stack(basis[:used]), sh[:, :used])).clamp_min(0)


def _blend(splat, values: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Blend all Gaussians that are shown, front to back, at the centre of every pixel."""
    shown = (splat["radii"] > 0).all(1).nonzero()[:, 0]
    shown = shown[splat["depths"][shown].argsort(stable=True)]
    rows, columns = torch.meshgrid(
        torch.arange(height).double() + CENTER, torch.arange(width).double() + CENTER, indexing="ij"
    )
    light = torch.ones(height, width, dtype=torch.float64)
    image = torch.zeros(height, width, values.shape[1], dtype=torch.float64)
    is_open = torch.ones(height, width, dtype=torch.bool)
    for row in shown.tolist():
        dx, dy = columns - splat["means2d"][row, 0], rows - splat["means2d"][row, 1]
        a, b, c = splat["conics"][row].unbind()
        alpha = splat["opacities"][row] * (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).exp()
        alpha = alpha.clamp_max(MAX_ALPHA)
        counts = is_open & (alpha >= MIN_ALPHA)
        is_open = is_open & ~(counts & (light * (1 - alpha) <= MIN_TRANSMITTANCE))
        alpha = torch.where(counts & is_open, alpha, 0.0)
        image = image + (light * alpha)[..., None] * values[row]
        light = light * (1 - alpha)
    return image, 1 - light[..., None]
