"""LPIPS, a perceptual distance of images based on activations of a trained network."""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.devices import full_precision
from cvtgs.errors import (
    FileFormatError,
    InputNotFoundError,
    InvalidArgumentError,
    MissingDependencyError,
    how_to_install,
)
from cvtgs.io.files import is_folder, open_input
from cvtgs.losses import check_pair
from cvtgs.text import short_repr

LPIPS_VARIABLE = "CVTGS_LPIPS_WEIGHTS"  # path of a weights file, or of a folder of them

LpipsNetwork = Literal["alex", "vgg"]
"""AlexNet (Krizhevsky 2014) or VGG16 (Simonyan and Zisserman 2014)."""

LEAST_PIXELS: Mapping[LpipsNetwork, int] = MappingProxyType({"alex": 31, "vgg": 16})
"""Smallest height and width of an image in pixels, so that no layer is empty."""


class Convolution(NamedTuple):
    """A convolution with its ReLU."""

    number: int  # in torchvision's ``features``
    shape: tuple[int, int, int, int]
    stride: int = 1
    padding: int = 1
    pool: int = 0  # kernel size of the max pooling before it (stride 2), 0 for none
    tap: bool = True  # whether its activations are compared


_VGG_BLOCKS = (
    (0, (3, 64, 64)),
    (5, (64, 128, 128)),
    (10, (128, 256, 256, 256)),
    (17, (256, 512, 512, 512)),
    (24, (512, 512, 512, 512)),
)

NETWORKS: Mapping[LpipsNetwork, tuple[Convolution, ...]] = MappingProxyType(
    {
        "alex": (
            Convolution(0, (64, 3, 11, 11), stride=4, padding=2),
            Convolution(3, (192, 64, 5, 5), padding=2, pool=3),
            Convolution(6, (384, 192, 3, 3), pool=3),
            Convolution(8, (256, 384, 3, 3)),
            Convolution(10, (256, 256, 3, 3)),
        ),
        "vgg": tuple(
            Convolution(
                first + 2 * k,
                (channels[k + 1], channels[k], 3, 3),
                pool=2 if first > 0 and k == 0 else 0,
                tap=k == len(channels) - 2,
            )
            for first, channels in _VGG_BLOCKS
            for k in range(len(channels) - 1)
        ),
    }
)

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_EPSILON = 1e-10

# The files that torchvision downloads for the package ``lpips``, and the keys in its state dicts.
_BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
_OTHER_NAMES = (
    (re.compile(r"net\.slice\d+\.(\d+)\.(weight|bias)"), r"features.\1.\2"),
    (re.compile(r"lin(\d+)\.model\.\d+\.weight"), r"lin\1.weight"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LpipsWeights:
    """The weights of one LPIPS network, read once.

    Attributes:
        network: The network that the weights belong to.
        tensors: ``features.<i>.weight``, ``features.<i>.bias`` and ``lin0.weight`` to
            ``lin4.weight``, float32 on the CPU.
        source: The files that the weights came from.
    """

    network: LpipsNetwork
    tensors: Mapping[str, Tensor]
    source: str

    __repr__ = short_repr


@torch.no_grad()
@full_precision()
def lpips(
    a: Float[Tensor, "c h w 3"],
    b: Float[Tensor, "c h w 3"],
    *,
    network: LpipsNetwork = "vgg",
    weights: LpipsWeights | str | os.PathLike[str] | None = None,
) -> Float[Tensor, "c"]:
    """Return the LPIPS distance, version 0.1, of each pair of images.

    Zhang, Isola, Efros, Shechtman, Wang 2018, equation 1: activations after five ReLUs are scaled
    to unit length over the channels; their squared differences are weighted by the trained heads,
    averaged over positions and summed over layers. Images are not resized; [0, 1] is mapped to
    [-1, 1]. Memory: one pair of images at a time, in float32 about ``2 kB * h * w`` (vgg) or
    ``0.2 kB * h * w`` (alex). On CUDA ``torch.backends.cudnn.allow_tf32`` applies (default: on).

    Args:
        a: ``(c, h, w, 3)`` images, clipped to [0, 1].
        b: ``(c, h, w, 3)`` images, clipped to [0, 1].
        network: ``"vgg"`` or ``"alex"``; the values of the two cannot be compared.
        weights: The result of :func:`load_lpips`, which saves reading the weights in every call,
            or a path for it. If None, the environment variable ``CVTGS_LPIPS_WEIGHTS`` is used,
            else the package ``lpips``.

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
        >>> ones = {name: torch.ones(shape) for name, shape in weight_shapes("vgg").items()}
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
    check_pair(a, b, least=LEAST_PIXELS[network])
    tensors = {name: tensor.to(a) for name, tensor in weights.tensors.items()}
    distances = []
    for pair in zip(a.split(1), b.split(1), strict=True):
        # Not batched, so that equal images go through the same sums and differ by exactly 0.
        layers = zip(*(_unit_activations(image, network, tensors) for image in pair), strict=True)
        distance = a.new_zeros(())
        for number, (one, other) in enumerate(layers):
            weighted = tensors[f"lin{number}.weight"] * (one - other).square()
            distance = distance + weighted.sum(dim=1).mean()
        distances.append(distance)
    return torch.stack(distances)


def _unit_activations(
    image: Float[Tensor, "1 h w 3"], network: LpipsNetwork, tensors: Mapping[str, Tensor]
) -> Iterator[Float[Tensor, "1 k y x"]]:
    """Yield the compared activations layer by layer, scaled to unit length over the channels."""
    centred = image.clamp(0, 1) * 2 - 1
    scaled = (centred - centred.new_tensor(_SHIFT)) / centred.new_tensor(_SCALE)
    values = scaled.permute(0, 3, 1, 2)
    for layer in NETWORKS[network]:
        if layer.pool:
            values = torch.nn.functional.max_pool2d(values, layer.pool, stride=2)
        values = torch.nn.functional.conv2d(
            values,
            tensors[f"features.{layer.number}.weight"],
            tensors[f"features.{layer.number}.bias"],
            stride=layer.stride,
            padding=layer.padding,
        ).relu_()
        if layer.tap:
            yield values / (values.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON)


def weight_shapes(network: LpipsNetwork) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the weights of a network."""
    layers = NETWORKS[network]
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in layers:
        shapes[f"features.{layer.number}.weight"] = layer.shape
        shapes[f"features.{layer.number}.bias"] = layer.shape[:1]
    taps = [layer.shape[0] for layer in layers if layer.tap]
    return shapes | {f"lin{k}.weight": (1, channels, 1, 1) for k, channels in enumerate(taps)}


def load_lpips(
    network: LpipsNetwork = "vgg", path: str | os.PathLike[str] | None = None
) -> LpipsWeights:
    """Read the weights of LPIPS from the first of these sources that is present.

    1. ``path``; 2. the path in the environment variable ``CVTGS_LPIPS_WEIGHTS``; 3. the installed
    package ``lpips``, with the backbone that torchvision has already downloaded. A path leads to a
    state dict, or to a folder with ``lpips_vgg*.pth`` or ``lpips_alex*.pth``. The keys of a state
    dict are those of torchvision (``features.0.weight``, ``lin0.weight``) or those of
    ``lpips.LPIPS(net="vgg").state_dict()``; any precision works. Nothing is downloaded.

    Args:
        network: ``"vgg"`` or ``"alex"``.
        path: A weights file or a folder of weights files.

    Returns:
        The weights.

    Raises:
        InvalidArgumentError: There is no such network.
        MissingDependencyError: No path was given, and the package is missing or incomplete.
        InputNotFoundError: There is no such file.
        InputError: It cannot be read.
        FileFormatError: It does not hold the weights of this network.

    Example:
        >>> import tempfile
        >>> zeros = {name: torch.zeros(shape) for name, shape in weight_shapes("alex").items()}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.save(zeros, Path(folder) / "lpips_alex.pth")
        ...     load_lpips("alex", folder).network
        'alex'
    """
    if network not in NETWORKS:
        raise InvalidArgumentError(
            f"network must be {' or '.join(map(repr, NETWORKS))}, found {network!r}."
        )
    files = _weight_files(network, path)
    found: dict[str, Any] = {}
    for file in files:
        found |= _read_state(file)
    source = " and ".join(map(str, files))
    tensors: dict[str, Tensor] = {}
    for name, shape in weight_shapes(network).items():
        tensor = found.get(name)
        if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
            was = getattr(tensor, "shape", None)
            raise FileFormatError(
                f"{source}: the LPIPS network {network!r} must have {name} of shape {shape}, "
                f"found {'none' if was is None else tuple(was)}; are these its weights?"
            )
        if not tensor.is_floating_point() or not bool(tensor.isfinite().all()):
            raise FileFormatError(f"{source}: {name} must hold finite floats, found others.")
        tensors[name] = tensor.float()
    return LpipsWeights(network=network, tensors=MappingProxyType(tensors), source=source)


def _weight_files(network: LpipsNetwork, path: str | os.PathLike[str] | None) -> tuple[Path, ...]:
    """Find the weights files; see :func:`load_lpips`."""
    given = os.fspath(path) if path is not None else os.environ.get(LPIPS_VARIABLE, "")
    if given:
        place = Path(given)
        found = sorted(place.glob(f"lpips_{network}*.pth")) if is_folder(place) else [place]
        if not found:
            raise InputNotFoundError(
                f"{place}: the folder must hold a file lpips_{network}*.pth, found none."
            )
        return (found[0],)
    # Not imported: that would load torchvision, and creating its model would download files.
    spec = find_spec("lpips")
    if spec is None or spec.origin is None:
        mine = torch.__version__.partition("+")[0]
        raise MissingDependencyError(
            f"the weights must be at the path {LPIPS_VARIABLE} or in the package lpips, found "
            f"neither; {how_to_install('cvtgs[lpips]', f'torch=={mine}')}, which keeps this torch."
        )
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / _BACKBONES[network]
    files = backbone, Path(spec.origin).parent / "weights" / "v0.1" / f"{network}.pth"
    for file in files:
        if not file.is_file():
            raise MissingDependencyError(
                f"the weights must include {file}, found none; fetch it once with: "
                f"python -c \"import lpips; lpips.LPIPS(net='{network}')\"."
            )
    return files


def _read_state(path: Path) -> dict[str, Any]:
    """Read a state dict and rename its keys to those of torchvision."""
    with open_input(path) as file:
        try:
            state = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load can raise nearly anything on a damaged file
            raise FileFormatError(
                f"{path}: must be a state dict that torch.load(weights_only=True) reads, "
                f"found none; the file may be damaged."
            ) from error
    if not isinstance(state, Mapping):
        raise FileFormatError(
            f"{path}: must hold a state dict, found an object of type {type(state).__name__}."
        )
    renamed: dict[str, Any] = {}
    for key, value in state.items():
        name = str(key)
        for pattern, wanted in _OTHER_NAMES:
            name = pattern.sub(wanted, name) if pattern.fullmatch(name) else name
        renamed[name] = value
    return renamed
