"""Property test: small scenes of nasty values give finite, standard output of the exact count."""

import warnings

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from cvtgs import GaussianScene, Simplifier
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from scenes import REST_COUNTS, assert_standard, random_scene

NAN, INF = float("nan"), float("inf")
PLACES = [0.0, 1.0, 1.0, -1.0, 1e-30, 1e-3, 1e6, -1e6, 6e6 + 0.01, 1e30, -3e38, 3e38, NAN, INF]
LOG_SCALES = [0.0, -3.0, -3.0, -40.0, 20.0, -1e-3, -20.0, -400.0, 88.0, 400.0, NAN, -INF]
LOGITS = [0.0, 2.0, -4.0, 0.018, 700.0, -700.0, INF, -INF, NAN]
TURNS = [0.0, 1.0, -1.0, 1e-30, 1e30, 1e-45, NAN]
COLORS = [0.0, 1.0, -1.0, 1e4, -1e4, 1e-40, INF]


def numbers(choices: list[float], low: float, high: float) -> st.SearchStrategy[float]:
    usual = st.floats(low, high, width=32)
    return st.one_of(usual, usual, usual, st.sampled_from(choices))


@st.composite
def nasty_scenes(draw: st.DrawFn) -> GaussianScene:
    count = draw(st.integers(1, 12))
    rest = draw(st.sampled_from(REST_COUNTS[:2]))
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))

    def tensor(values: st.SearchStrategy[float], *shape: int) -> torch.Tensor:
        rows = st.lists(values, min_size=shape[0] if shape else 1, max_size=shape[0])
        pool = [draw(rows) for _ in range(draw(st.integers(1, count)))]
        names = draw(
            st.lists(st.integers(0, len(pool) - 1), min_size=count, max_size=count)
        )  # few different rows, so that rows coincide
        return torch.tensor([pool[name] for name in names], dtype=dtype)

    return GaussianScene(
        means=tensor(numbers(PLACES, -10, 10), 3),
        quats=tensor(numbers(TURNS, -1, 1), 4),
        log_scales=tensor(numbers(LOG_SCALES, -5, 1), 3),
        logit_opacities=tensor(numbers(LOGITS, -6, 6), 1)[:, 0],
        sh0=tensor(numbers(COLORS, -2, 2), 3)[:, None],
        shN=tensor(numbers(COLORS, -1, 1), 3)[:, None].repeat(1, rest, 1),
        extras={"label": torch.arange(count)},
    )


def valid_mask(scene: GaussianScene) -> torch.Tensor:
    rows = torch.cat([scene.means, scene.quats, scene.log_scales, scene.sh.flatten(1)], dim=1)
    return (
        rows.isfinite().all(dim=1)
        & (scene.log_scales < 88.72).all(dim=1)  # scales that float32 can hold
        & scene.quats.any(dim=1)
        & ~scene.logit_opacities.isnan()
    )


each_preset = pytest.mark.parametrize("preset", ["standard", "paper"])


@pytest.mark.slow
@each_preset
@hypothesis.given(scene=nasty_scenes(), share=st.floats(0.01, 1.0))
@hypothesis.settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
def test_nasty_scenes_give_standard_output_of_the_exact_count(preset, scene, share):
    valid = int(valid_mask(scene).sum())
    count = max(1, int(share * len(scene)))
    simplifier = Simplifier(config=preset, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DroppedDataWarning)
        if valid == 0:
            with pytest.raises(InvalidSceneError):
                simplifier.simplify(scene, count=count)
            return
        small, report = simplifier.run(scene, count=count)
    assert len(small) == min(count, valid)
    assert report.invalid_count == len(scene) - valid
    assert (report.shortfall == "") == (count <= valid)
    if count < valid:
        assert_standard(small)
        assert report.mass_out >= 0
    else:  # the valid rows of the scene, unchanged except for infinite opacities
        assert torch.equal(small.means, scene.means[valid_mask(scene)])
        assert bool(small.logit_opacities.isfinite().all())


@pytest.mark.slow
@each_preset
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("far", [1e6, 1e30, 3e38])
def test_flyaways_neither_crash_nor_become_a_giant_blob(far, size, dtype, preset):
    scene = random_scene(300, dtype=dtype, spread=size, size=0.1 * size)
    means = scene.means.clone()
    means[:4] = far
    means[2:4, 1] = -far
    scene = scene.with_tensors({"means": means}, {})
    small = Simplifier(config=preset, device="cpu").simplify(scene, 0.2)
    assert len(small) == 60
    assert_standard(small)
    near = small.means.abs().amax(dim=1) < 100 * size
    assert int(near.sum()) >= 50
    assert float(small.scales[near].amax()) < 10 * size


@each_preset
@pytest.mark.parametrize("exponent", [-400.0, -40.0, 20.0, 88.0])
def test_extreme_scales_give_standard_output(exponent, preset):
    scene = random_scene(100)
    scene = scene.with_tensors({"log_scales": scene.log_scales.clamp(-0.1, 0.1) + exponent}, {})
    small, report = Simplifier(config=preset, device="cpu").run(scene, 0.2)
    assert len(small) == 20
    assert_standard(small)
    assert 0 <= report.filtered_mass_share <= 1
    assert 0 <= report.plan.unbounded.figure <= 1


@each_preset
def test_scales_beyond_float32_are_dropped(preset):
    scene = random_scene(100)
    log_scales = scene.log_scales.clone()
    log_scales[7, 2] = 400.0
    scene = scene.with_tensors({"log_scales": log_scales}, {})
    with pytest.warns(DroppedDataWarning, match=r"dropped 1 of 100 .*\(log_scales 1\)"):
        small = Simplifier(config=preset, device="cpu").simplify(scene, 0.2)
    assert_standard(small)
