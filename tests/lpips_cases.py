"""Networks with small random weights, and images, for tests of LPIPS."""

import math
from collections.abc import Mapping
from functools import cache

import torch

from cvtgs.evaluation import LpipsWeights

# Layers of torchvision's feature extractors: (layer, out, in, kernel, stride, padding), pools as
# (side,), and "tap" after a ReLU that LPIPS compares.
ALEX = [
    (0, 64, 3, 11, 4, 2), "tap", (3,), (3, 192, 64, 5, 1, 2), "tap", (3,),
    (6, 384, 192, 3, 1, 1), "tap", (8, 256, 384, 3, 1, 1), "tap", (10, 256, 256, 3, 1, 1), "tap",
]  # fmt: skip
VGG = [
    (0, 64, 3, 3, 1, 1), (2, 64, 64, 3, 1, 1), "tap", (2,),
    (5, 128, 64, 3, 1, 1), (7, 128, 128, 3, 1, 1), "tap", (2,),
    (10, 256, 128, 3, 1, 1), (12, 256, 256, 3, 1, 1), (14, 256, 256, 3, 1, 1), "tap", (2,),
    (17, 512, 256, 3, 1, 1), (19, 512, 512, 3, 1, 1), (21, 512, 512, 3, 1, 1), "tap", (2,),
    (24, 512, 512, 3, 1, 1), (26, 512, 512, 3, 1, 1), (28, 512, 512, 3, 1, 1), "tap",
]  # fmt: skip
LAYERS = {"alex": ALEX, "vgg": VGG}


@cache
def random_state(network: str) -> Mapping[str, torch.Tensor]:
    g = torch.Generator().manual_seed(5)
    state: dict[str, torch.Tensor] = {}
    channels = heads = 0
    for layer in LAYERS[network]:
        if layer == "tap":
            state[f"lin{heads}.weight"] = torch.rand(1, channels, 1, 1, generator=g)
            heads += 1
        elif len(layer) > 1:
            index, channels, before, side, _, _ = layer
            size = math.sqrt(2 / (before * side * side))
            weight = size * torch.randn(channels, before, side, side, generator=g)
            state[f"features.{index}.weight"] = weight
            state[f"features.{index}.bias"] = 0.1 * torch.randn(channels, generator=g)
    return state


def random_weights(network: str) -> LpipsWeights:
    return LpipsWeights(network=network, tensors=random_state(network), source="random")


def random_images(height: int, width: int, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    shape = (count, height, width, 3)
    first = torch.rand(shape, generator=g, dtype=torch.float64)
    return first, torch.rand(shape, generator=g, dtype=torch.float64)
