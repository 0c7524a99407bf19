"""Write OpenUSD text (``.usda``) with a ParticleField3DGaussianSplat, which OpenUSD 26.03 added."""

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float

from cvtgs.io.arrays import Arrays, Floats
from cvtgs.math.parameters import build_covariances
from cvtgs.math.spherical_harmonics import degree_of
from cvtgs.scene import GaussianScene
from cvtgs.text import printable

_CHUNK_ROWS = 1 << 15
_SIGMAS = 3.0  # extent of a Gaussian in the bounds, in standard deviations


def write_usda(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a stage with one prim, in the order and axes of the scene, with float32 precision."""
    file.writelines(text.encode() for text in _document(scene, Arrays.of(scene)))


def _document(scene: GaussianScene, arrays: Arrays) -> Iterator[str]:
    yield '#usda 1.0\n(\n    defaultPrim = "Splats"\n    metersPerUnit = 1\n    upAxis = "Y"\n'
    if scene.comments:
        lines = ", ".join(_quoted(line) for line in scene.comments)
        yield f"    customLayerData = {{\n        string[] comments = [{lines}]\n    }}\n"
    yield ')\n\ndef ParticleField3DGaussianSplat "Splats"\n{\n'
    yield from _array("float3[] extent", _extent(arrays))
    yield from _array("point3f[] positions", arrays.means)
    yield from _array("quatf[] orientations", arrays.quats)
    yield from _array("float3[] scales", arrays.scales)
    yield from _array("float[] opacities", arrays.opacities)
    degree = degree_of(arrays.shN.shape[1])
    yield f"    uniform int radiance:sphericalHarmonicsDegree = {degree}\n"
    bands = np.concatenate([arrays.sh0[:, None], arrays.shN], axis=1).reshape(-1, 3)
    yield from _array("float3[] radiance:sphericalHarmonicsCoefficients", bands)
    yield "}\n"


def _array(name: str, values: Floats) -> Iterator[str]:
    """Yield the text of an attribute in chunks; rows of several numbers are tuples."""
    row = "%.9g" if values.ndim == 1 else f"({', '.join(['%.9g'] * values.shape[1])})"
    yield f"    {name} = ["
    for start in range(0, len(values), _CHUNK_ROWS):
        part = values[start : start + _CHUNK_ROWS]
        text = ", ".join([row] * len(part)) % tuple(part.ravel().tolist())
        yield f", {text}" if start else text
    yield "]\n"


def _extent(arrays: Arrays) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box around all Gaussians."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for part in arrays.chunks(_CHUNK_ROWS):
        scales = torch.from_numpy(part.scales.astype(np.float64))
        quats = torch.from_numpy(part.quats.astype(np.float64))
        variances = build_covariances(scales, quats).diagonal(dim1=1, dim2=2).numpy()
        reach = _SIGMAS * np.sqrt(variances)
        low = np.minimum(low, (part.means - reach).min(axis=0))
        high = np.maximum(high, (part.means + reach).max(axis=0))
    most = float(np.finfo(np.float32).max)
    return np.stack([low, high]).clip(-most, most)


def _quoted(text: str) -> str:
    plain = printable(text).replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{plain}"'
