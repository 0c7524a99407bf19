"""Compiled kernels stay within their arrays, which numba does not check by default."""

import pytest

pytest.importorskip("numba")

from cvtgs.rendering.kernels_tiles import span
from process_cases import python

PROGRAM = """
import torch
from cvtgs.rendering import blending_weights, contributions, render
from render_cases import around
from scenes import random_scene

cameras = around(2, 70, 50, 60.0)
for size in (0.05, 0.3, 2.0):
    scene = random_scene(300, degree=1, seed=2, size=size)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.tensors().items()}
    found = render(scene.with_tensors(leaves, {}), cameras, backend="numba", depth=True)
    (found.rgb.sum() + found.alpha.sum() + found.depth.sum()).backward()
    contributions(scene, cameras, backend="numba")
    for camera in cameras.singles():
        weights = blending_weights(scene, camera, backend="numba")
        weights.collect(weights.paint(torch.ones(len(scene), 3)))
        weights.normal(torch.ones(len(scene), 3))
        weights.powers()
print("within bounds")
"""


@pytest.mark.parametrize(
    ("low", "high", "pixels"),
    [
        (2.5, 4.5, (2, 5)),
        (-9.0, -3.0, (0, 0)),  # an end of -3 would be the third place from the end of an array
        (-9.0, 99.0, (0, 16)),
        (40.0, 50.0, (40, 40)),
    ],
)
def test_a_span_is_never_negative(low, high, pixels):
    assert span(low, high, 0, 16) == pixels


@pytest.mark.long
def test_no_kernel_leaves_its_arrays(tmp_path):
    variables = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    assert python(PROGRAM, **variables) == ["within bounds"]
