"""Write a 3DGS scene to a PLY file."""

import warnings
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.io.ply.output_layout import output_layout
from cvtgs.io.ply.properties import SCALARS, Layout, standard_slots
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene

CHUNK_BYTES = 1 << 20
"""How much is gathered before it is written."""


def write_ply(scene: GaussianScene, file: BinaryIO) -> None:
    r"""Write a scene as binary little endian PLY.

    Properties, their order and their types are those of the file that the scene came from; a
    scene made in memory gets INRIA's. Memory is one chunk.

    Args:
        scene: The scene, on any device.
        file: Where to, open for writing.

    Raises:
        InvalidSceneError: The scene is empty, or something in it has no place in a PLY file.
        OSError: The file cannot be written.

    Example:
        >>> import io
        >>> file = io.BytesIO()
        >>> write_ply(GaussianScene(
        ...     means=torch.zeros(1, 3), quats=torch.tensor([[1.0, 0, 0, 0]]),
        ...     log_scales=torch.zeros(1, 3), logit_opacities=torch.zeros(1),
        ...     sh0=torch.zeros(1, 1, 3), shN=torch.zeros(1, 0, 3),
        ... ), file)
        >>> file.getvalue()[:36]
        b'ply\nformat binary_little_endian 1.0\n'
    """
    if len(scene) == 0:
        raise InvalidSceneError("a scene must hold at least one Gaussian to be written, found 0.")
    layout = output_layout(scene)
    _warn_of_flattened(scene, layout)
    file.write(_header(scene, layout))
    dtype = np.dtype([(name, "<" + SCALARS[kind].code) for name, kind in layout])
    rows = max(1, CHUNK_BYTES // dtype.itemsize)
    for start in range(0, len(scene), rows):
        block = np.zeros(min(rows, len(scene) - start), dtype)
        _fill(block, scene, start)
        file.write(block.view(np.uint8).data)


def _header(scene: GaussianScene, layout: Layout) -> bytes:
    for comment in scene.comments:
        if "\n" in comment:
            raise InvalidSceneError(
                f"a comment must be one line to be written to a PLY, found {comment[:80]!r}."
            )
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}".rstrip() for comment in scene.comments]
    lines += [f"element vertex {len(scene)}"]
    lines += [f"property {kind} {name}" for name, kind in layout]
    return "\n".join([*lines, "end_header", ""]).encode()


def _fill(block: NDArray[Any], scene: GaussianScene, start: int) -> None:
    """Copy rows of the scene into a block; columns that the scene does not have stay zero."""
    stop = start + len(block)
    slots = standard_slots(scene.shN.shape[1])
    tensors = {name: _rows(tensor, start, stop) for name, tensor in scene.tensors().items()}
    names = block.dtype.names or ()
    with np.errstate(over="ignore"):
        for name in names:
            if name in slots:
                slot = slots[name]
                block[name] = tensors[slot.tensor][slot.rows]
            elif name in scene.extras:
                block[name] = _rows(scene.extras[name], start, stop)


def _rows(tensor: Tensor, start: int, stop: int) -> NDArray[Any]:
    part = tensor[start:stop].detach().cpu()
    array: NDArray[Any] = (part.float() if part.dtype == torch.bfloat16 else part).numpy()
    return array


def _warn_of_flattened(scene: GaussianScene, layout: Layout) -> None:
    if "scale_2" in dict(layout):
        return
    thick = int((scene.log_scales[:, 2] != FLAT_LOG_SCALE).sum())
    if thick:
        warnings.warn(
            f"the third scale of {thick:,} Gaussians was left out, since the file that the scene "
            f"came from has no scale_2 (2DGS).",
            DroppedDataWarning,
            stacklevel=4,
        )
