"""The convolutions of AlexNet and VGG16 that LPIPS looks at."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

LpipsNetwork = Literal["alex", "vgg"]
"""AlexNet (Krizhevsky 2014) or VGG16 (Simonyan and Zisserman 2014)."""

LPIPS_NETWORKS: tuple[LpipsNetwork, ...] = get_args(LpipsNetwork)


@dataclass(frozen=True, slots=True, kw_only=True)
class Convolution:
    """A convolution with its ReLU, and the maximum pooling before it.

    Attributes:
        index: Number of the layer in torchvision's ``features``.
        shape: Channels out, channels in, height and width of the kernel.
        stride: Pixels between two places of the kernel.
        padding: Zeros around the image.
        pool: Side of the pooling window before it (stride 2), 0 for none.
        tap: Whether its activation is compared.
    """

    index: int
    shape: tuple[int, int, int, int]
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """A stack of convolutions.

    Attributes:
        convolutions: In order.
        least: Pixels that height and width of an image must have, so that no layer is empty.
    """

    convolutions: tuple[Convolution, ...]
    least: int

    @property
    def tap_channels(self) -> tuple[int, ...]:
        """Channels of the compared activations."""
        return tuple(layer.shape[0] for layer in self.convolutions if layer.tap)


def _vgg16() -> tuple[Convolution, ...]:
    layers: list[Convolution] = []
    index, before = 0, 3
    for block, (channels, depth) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        for number in range(depth):
            layers.append(
                Convolution(
                    index=index,
                    shape=(channels, before, 3, 3),
                    pool=2 if block > 0 and number == 0 else 0,
                    tap=number == depth - 1,
                )
            )
            index, before = index + 2, channels
        index += 1
    return tuple(layers)


_ALEX = (
    Convolution(index=0, shape=(64, 3, 11, 11), stride=4, padding=2, tap=True),
    Convolution(index=3, shape=(192, 64, 5, 5), padding=2, pool=3, tap=True),
    Convolution(index=6, shape=(384, 192, 3, 3), pool=3, tap=True),
    Convolution(index=8, shape=(256, 384, 3, 3), tap=True),
    Convolution(index=10, shape=(256, 256, 3, 3), tap=True),
)

NETWORKS: Mapping[LpipsNetwork, Network] = MappingProxyType(
    {
        "alex": Network(convolutions=_ALEX, least=31),
        "vgg": Network(convolutions=_vgg16(), least=16),
    }
)


def activations(
    images: Float[Tensor, "b 3 h w"], network: Network, tensors: Mapping[str, Tensor]
) -> Iterator[Float[Tensor, "b k y x"]]:
    """Return the compared activations one by one; the one before may be forgotten meanwhile."""
    for layer in network.convolutions:
        if layer.pool:
            images = torch.nn.functional.max_pool2d(images, layer.pool, stride=2)
        images = torch.nn.functional.conv2d(
            images,
            tensors[f"features.{layer.index}.weight"],
            tensors[f"features.{layer.index}.bias"],
            stride=layer.stride,
            padding=layer.padding,
        ).relu_()
        if layer.tap:
            yield images
