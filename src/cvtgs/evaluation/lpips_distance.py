"""LPIPS, the distance of images as a trained network sees it."""

import os
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.lpips_network import NETWORKS, LpipsNetwork, Network, activations
from cvtgs.evaluation.lpips_weights import LpipsWeights, load_lpips
from cvtgs.losses import check_pair

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10


@torch.no_grad()
def lpips(
    a: Float[Tensor, "c h w 3"],
    b: Float[Tensor, "c h w 3"],
    *,
    network: LpipsNetwork = "vgg",
    weights: LpipsWeights | str | os.PathLike[str] | None = None,
) -> Float[Tensor, "c"]:
    """Return the LPIPS distance, version 0.1, of each pair of images.

    Zhang, Isola, Efros, Shechtman, Wang 2018, equation 1: activations after five ReLUs, scaled to
    unit length over the channels, squared differences weighted by the trained heads, mean over
    places, sum over layers. Images go in as they are, in [0, 1] mapped to [-1, 1]. Memory: one
    pair of images at a time, in float32 about ``2 kB * h * w`` (vgg) or ``0.2 kB * h * w`` (alex).
    On CUDA the convolutions obey ``torch.backends.cudnn.allow_tf32``, on by default.

    Args:
        a: ``(c, h, w, 3)`` images, clipped to [0, 1].
        b: ``(c, h, w, 3)`` images, clipped to [0, 1].
        network: ``"vgg"`` or ``"alex"``; the values of the two cannot be compared.
        weights: What :func:`load_lpips` gives, which saves reading them for every call; or a
            path for it. Without either it looks at the environment variable
            ``CVTGS_LPIPS_WEIGHTS``, then for the package ``lpips``.

    Returns:
        ``(c,)`` distances, at least 0, 0 for equal images, without gradient.

    Raises:
        InvalidArgumentError: Shape, dtype or device do not fit, the images are smaller than 16
            (vgg) or 31 (alex) pixels, or there is no such network.
        MissingDependencyError: There are no weights.
        InputNotFoundError: There is no such weights file.
        InputError: It cannot be read.
        FileFormatError: It does not hold the weights of this network.

    Example:
        >>> layers = NETWORKS["vgg"].convolutions
        >>> ones = {f"features.{l.index}.weight": torch.ones(l.shape) for l in layers}
        >>> ones |= {f"features.{l.index}.bias": torch.ones(l.shape[0]) for l in layers}
        >>> ones |= {f"lin{k}.weight": torch.ones(1, channels, 1, 1)
        ...          for k, channels in enumerate(NETWORKS["vgg"].tap_channels)}
        >>> weights = LpipsWeights(network="vgg", tensors=ones, source="ones")
        >>> lpips(torch.zeros(1, 16, 16, 3), torch.zeros(1, 16, 16, 3), weights=weights).tolist()
        [0.0]
    """
    if not isinstance(weights, LpipsWeights):
        weights = load_lpips(network, weights)
    elif weights.network != network:
        raise InvalidArgumentError(
            f"the weights must be those of network {network!r}, found those of "
            f"{weights.network!r} ({weights.source})."
        )
    layers = NETWORKS[network]
    check_pair(a, b, least=layers.least)
    tensors = {name: tensor.to(a) for name, tensor in weights.tensors.items()}
    pairs = zip(a.split(1), b.split(1), strict=True)
    return torch.stack([_distance(pair, layers, tensors) for pair in pairs])


def _distance(
    pair: tuple[Float[Tensor, "1 h w 3"], Float[Tensor, "1 h w 3"]],
    network: Network,
    tensors: Mapping[str, Tensor],
) -> Float[Tensor, ""]:
    """Compare two images layer by layer, holding one layer of each at a time.

    They are not batched, so that equal images go through the same sums and differ by exactly 0.
    """
    stacks = [activations(_normalised(image), network, tensors) for image in pair]
    total = pair[0].new_zeros(())
    for number, (one, other) in enumerate(zip(*stacks, strict=True)):
        head = tensors[f"lin{number}.weight"]
        total = total + (head * (_unit(one) - _unit(other)).square()).sum(dim=1).mean()
    return total


def _normalised(image: Float[Tensor, "1 h w 3"]) -> Float[Tensor, "1 3 h w"]:
    centred = image.clamp(0, 1) * 2 - 1
    scaled = (centred - centred.new_tensor(_SHIFT)) / centred.new_tensor(_SCALE)
    return scaled.permute(0, 3, 1, 2)


def _unit(activation: Float[Tensor, "1 k y x"]) -> Float[Tensor, "1 k y x"]:
    lengths = activation.square().sum(dim=1, keepdim=True).sqrt()
    return activation / (lengths + _EPSILON)
