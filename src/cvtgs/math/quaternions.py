"""Unit quaternions, w first, and rotation matrices."""

import torch
from jaxtyping import Float
from torch import Tensor


def normalize(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Scale quaternions to unit length.

    The largest component is divided out first, so that tiny and huge quaternions survive.

    Args:
        quats: Non-zero, finite quaternions.

    Returns:
        Unit quaternions of the same orientation and sign.

    Example:
        >>> normalize(torch.tensor([[2.0, 0.0, 0.0, 0.0]])).tolist()
        [[1.0, 0.0, 0.0, 0.0]]
    """
    largest = quats.abs().amax(dim=-1, keepdim=True)
    scaled = quats / largest
    return scaled / scaled.square().sum(dim=-1, keepdim=True).sqrt()


def multiply(a: Float[Tensor, "n 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Multiply quaternions: the rotation ``b`` followed by the rotation ``a``.

    Args:
        a: Quaternions, w first.
        b: Quaternions, w first.

    Returns:
        Their Hamilton products.

    Example:
        >>> i, j = torch.tensor([[0.0, 1, 0, 0]]), torch.tensor([[0.0, 0, 1, 0]])
        >>> multiply(i, j).tolist()
        [[0.0, 0.0, 0.0, 1.0]]
    """
    w, v, other_w, other_v = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    real = w * other_w - (v * other_v).sum(dim=1, keepdim=True)
    return torch.cat([real, w * other_v + other_w * v + torch.linalg.cross(v, other_v)], dim=1)


def to_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Return the rotation matrices of unit quaternions.

    Args:
        quats: Unit quaternions, w first.

    Returns:
        Rotation matrices; column ``k`` is the image of axis ``k``. They lie in memory entry by
        entry, so that sums of products over many of them are fast.

    Example:
        >>> to_matrices(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))[0].diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    columns = quats.T.contiguous()
    products = 2 * columns[:, None] * columns
    (_, wx, wy, wz), (_, xx, xy, xz), (_, _, yy, yz), (_, _, _, zz) = map(torch.unbind, products)
    entries = [
        1 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1 - (xx + yy),
    ]  # fmt: skip
    return torch.stack(entries).reshape(3, 3, -1).permute(2, 0, 1)


def from_matrices(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions of rotation matrices, with w at least 0.

    Of the four ways to write a quaternion by one of its components, the one with the largest
    component is taken (Shepperd 1978), so no digits are lost near half turns.

    Args:
        rotations: Rotation matrices with determinant +1.

    Returns:
        Unit quaternions, w first, w >= 0.

    Example:
        >>> from_matrices(torch.eye(3)[None]).tolist()
        [[1.0, 0.0, 0.0, 0.0]]
    """
    m00, m11, m22 = rotations.diagonal(dim1=-2, dim2=-1).unbind(-1)
    wx = rotations[:, 2, 1] - rotations[:, 1, 2]
    wy = rotations[:, 0, 2] - rotations[:, 2, 0]
    wz = rotations[:, 1, 0] - rotations[:, 0, 1]
    xy = rotations[:, 0, 1] + rotations[:, 1, 0]
    xz = rotations[:, 0, 2] + rotations[:, 2, 0]
    yz = rotations[:, 1, 2] + rotations[:, 2, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, wx, wy, wz], dim=-1),
            torch.stack([wx, 1 + m00 - m11 - m22, xy, xz], dim=-1),
            torch.stack([wy, xy, 1 - m00 + m11 - m22, yz], dim=-1),
            torch.stack([wz, xz, yz, 1 - m00 - m11 + m22], dim=-1),
        ],
        dim=1,
    )
    best = candidates.diagonal(dim1=1, dim2=2).argmax(dim=-1)
    quats = normalize(candidates[torch.arange(len(best), device=best.device), best])
    # Adding 0 leaves no zero with a sign, so that the same frame is the same bits.
    return torch.where(quats[:, :1] < 0, -quats, quats) + 0.0
