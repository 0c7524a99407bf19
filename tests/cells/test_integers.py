"""The default integers of numpy before 2.0 have 32 bits on Windows."""

import numpy as np
import pytest

import cvtgs
from scenes import same_bits


@pytest.fixture
def small_integers(monkeypatch):
    """Pretend that integers without a dtype have 32 bits."""
    arange, cumsum = np.arange, np.cumsum

    def short_arange(*limits, dtype=np.int32):
        return arange(*limits, dtype=dtype)

    def short_cumsum(values, dtype=None, out=None):
        is_default = dtype is None and out is None and np.asarray(values).dtype == bool
        return cumsum(values, dtype=np.int32 if is_default else dtype, out=out)

    monkeypatch.setattr(np, "arange", short_arange)
    monkeypatch.setattr(np, "cumsum", short_cumsum)


@pytest.mark.parametrize("preset", ["draft", "standard"])
def test_a_scene_is_simplified_to_the_same_bits(preset, request):
    scene = cvtgs.synthetic.scene("courtyard", 1500, sh_degree=1, seed=1)
    simplifier = cvtgs.Simplifier(preset=preset, device="cpu")
    wanted = simplifier.simplify(scene, 0.1)
    request.getfixturevalue("small_integers")
    assert same_bits(simplifier.simplify(scene, 0.1), wanted)
