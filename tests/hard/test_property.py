"""Property test: scenes whose rows are drawn from the whole catalogue of hard cases."""

import warnings

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from cvtgs import GaussianScene
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.rendering import render
from cvtgs.validity import invalid_rows
from hard_cases import CASES
from hard_scenes import presets, simplifier, valid_rows
from render_cases import around
from scenes import assert_same_gaussians, assert_standard

SETTINGS = hypothesis.settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[
        hypothesis.HealthCheck.too_slow,
        hypothesis.HealthCheck.function_scoped_fixture,
    ],
)


pytestmark = pytest.mark.usefixtures("coarse_light")


@st.composite
def mixed_scenes(draw: st.DrawFn) -> GaussianScene:
    """Draw rows of one to four cases, in any order, possibly repeated."""
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    names = draw(st.lists(st.sampled_from(sorted(CASES)), min_size=1, max_size=4))
    pool = [CASES[name](draw(st.integers(1, 30)), dtype) for name in names]
    tensors = {
        name: torch.cat([scene.tensors()[name] for scene in pool]) for name in pool[0].tensors()
    }
    whole = GaussianScene(**tensors)
    rows = draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=40))
    return whole.select(torch.tensor(rows))


@pytest.mark.slow
@presets
@hypothesis.given(scene=mixed_scenes(), share=st.floats(0.01, 1.0))
@SETTINGS
def test_mixed_scenes_become_standard_with_the_exact_count(preset, scene, share):
    valid, count = int(valid_rows(scene).sum()), max(1, int(share * len(scene)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if valid == 0:
            with pytest.raises(InvalidSceneError):
                simplifier(preset).simplify(scene, count=count)
            return
        small, report = simplifier(preset).run(scene, count=count)
    assert [w.category for w in caught] == [DroppedDataWarning] * (valid < len(scene))
    assert len(small) == report.output_count == min(count, valid)
    assert report.invalid_count == len(scene) - valid
    if count < valid:
        assert_standard(small)
    assert invalid_rows(small) == {}
    assert render(small, around(1, 12, 9, 10.0)).rgb.isfinite().all()


@pytest.mark.long
@hypothesis.given(scene=mixed_scenes(), seed=st.integers(0, 99))
@SETTINGS
def test_the_order_of_mixed_rows_changes_nothing(scene, seed):
    scene = scene.select(valid_rows(scene))
    hypothesis.assume(len(scene) > 1)
    count = max(1, len(scene) // 3)
    shuffle = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))
    first, second = (
        simplifier("standard").simplify(s, count=count) for s in (scene, scene.select(shuffle))
    )
    assert_same_gaussians(first, second)
