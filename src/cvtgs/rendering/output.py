"""What compositing takes and gives, for every backend that composites itself."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import activations
from cvtgs.progress import ProgressEvent, ProgressListener
from cvtgs.rendering.projection import Splats

STAGE = "render"
"""The stage of the progress events; a step is a camera."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RasterOutput:
    """Images on black, before any background.

    Attributes:
        rgb: ``(c, h, w, 3)`` colours times what they hide.
        alpha: ``(c, h, w)`` what is hidden altogether, 0 to 1.
        depth: ``(c, h, w)`` depths times what is hidden there, scene units.
    """

    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]
    depth: Float[Tensor, "c h w"]


def pack(splats: Splats) -> Float[Tensor, "m 10"]:
    """Put side by side what compositing needs of each splat."""
    steep, shear, flat = splats.ellipses.unbind(1)
    columns = [-0.5 * steep, shear, -0.5 * flat, activations.positive_log(splats.opacities)]
    exponents = torch.stack(columns, dim=1)
    return torch.cat([splats.centers, exponents, splats.colors, splats.depths[:, None]], dim=1)


def paint_each(
    views: Iterable[Callable[[], Float[Tensor, "h w 5"]]],
    blank: Float[Tensor, "0 h w 5"],
    listener: ProgressListener,
) -> RasterOutput:
    """Render cameras one after the other."""
    images = [image[None] for image in _followed(list(views), listener)]
    layers = torch.cat([blank, *images])
    return RasterOutput(rgb=layers[..., :3], depth=layers[..., 3], alpha=1 - layers[..., 4])


def _followed(views: list[Callable[[], Tensor]], listener: ProgressListener) -> Iterator[Tensor]:
    listener(ProgressEvent(stage=STAGE, done=0, total=len(views)))
    for number, view in enumerate(views, start=1):
        yield view()
        listener(ProgressEvent(stage=STAGE, done=number, total=len(views)))
