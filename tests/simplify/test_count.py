"""The number of output Gaussians is exactly the requested one."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from cvtgs import GaussianScene, Simplifier, SimplifyConfig, target_count
from cvtgs.boxes import check_room
from cvtgs.counts import checked_whole, read_count, read_ratio
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, InvalidSceneError
from scenes import random_scene, same_bits

PRESETS = ["standard", "paper"]
each_preset = pytest.mark.parametrize("preset", PRESETS)
NAN, INF = float("nan"), float("inf")


def simplifier(preset: str) -> Simplifier:
    return Simplifier(config=preset, device="cpu")


def with_bad_rows(scene: GaussianScene, rows: list[int]) -> GaussianScene:
    means = scene.means.clone()
    means[rows, 0] = NAN
    return scene.with_tensors({"means": means}, scene.extras)


@pytest.mark.parametrize(
    ("total", "rho", "wanted"),
    [
        (100, 0.07, 7),  # 0.07 * 100 is 7.000000000000001
        (100, 0.29, 29),  # 0.29 * 100 is 28.999999999999996
        (100, 0.57, 57),
        (1000, 0.001, 1),
        (1001, 0.001, 2),
        (10, 1e-9, 1),
        (10, 1e-300, 1),
        (1, 0.5, 1),
        (2, 0.5, 1),
        (3, 0.5, 2),
        (3, 0.9999999, 3),
        (7, 1.0, 7),
        (7, 1, 7),
        (6_000_000, 0.01, 60_000),
        (600, np.float32(0.1), 60),  # as a double slightly more
        (600, torch.tensor(0.1), 60),
        (600, torch.tensor(0.25).bfloat16(), 150),
        (7, np.int64(1), 7),
    ],
)
def test_count_of_known_ratios(total, rho, wanted):
    assert target_count(total, rho) == wanted


@pytest.mark.parametrize("total", [1, 3, 777, 3000, 99_999, 1_234_567])
def test_the_ratio_of_a_report_gives_its_count(total):
    for count in range(1, min(total, 2000) + 1):
        assert target_count(total, count / total) == count


@pytest.mark.parametrize("total", [1, 2, 3, 10, 99, 100, 1000, 123_457, 10**8])
def test_the_count_is_the_ceiling_of_the_decimal_as_written(total):
    for hundredths in range(1, 101):
        wanted = math.ceil(Fraction(hundredths, 100) * total)
        assert target_count(total, float(f"{hundredths / 100:.2f}")) == wanted


@pytest.mark.slow
@each_preset
@pytest.mark.parametrize("total", [1, 2, 3, 5, 100, 101])
def test_exact_count_by_ratio(total, preset, subtests):
    scene = random_scene(total, seed=total)
    for rho in (1e-6, 0.01, 0.07, 0.29, 1 / 3, 0.5, 0.99, 1.0):
        with subtests.test(rho=rho):
            result = simplifier(preset).run(scene, rho)
            wanted = target_count(total, rho)
            assert len(result.scene) == wanted
            assert result.report.output_count == result.report.target_count == wanted
            assert result.report.input_count == total
            assert result.report.rho == pytest.approx(wanted / total)


@each_preset
@pytest.mark.parametrize(
    ("total", "count"), [(2, 1), (3, 2), (50, 49), (50, 1), (400, 399), (3000, 17)]
)
def test_exact_count_by_number(total, count, preset):
    assert len(simplifier(preset).simplify(random_scene(total), count=count)) == count


@each_preset
def test_ratio_of_one_is_the_identity(preset):
    scene = random_scene(50, degree=3)
    small = simplifier(preset).simplify(scene, 1.0)
    assert same_bits(small, scene)
    assert same_bits(simplifier(preset).simplify(scene, count=50), scene)


@each_preset
def test_a_count_above_the_survivors_of_the_filter_is_met(preset):
    """All but ten are faint; a count of 60 lets the heaviest of the faint back in."""
    scene = random_scene(100)
    logits = torch.full((100,), -6.0)
    logits[:10] = 6.0
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    result = simplifier(preset).run(scene, count=60)
    assert len(result.scene) == 60
    assert result.report.filtered_count <= 40
    if preset == "paper":
        assert result.report.filtered_count == 40
        means = {tuple(mean) for mean in result.scene.means.tolist()}
        masses = scene.masses
        masses[:10] = INF
        heaviest = torch.sort(masses, descending=True).indices[:60]
        assert means == {tuple(mean) for mean in scene.means[heaviest].tolist()}


@each_preset
def test_invalid_rows_are_dropped_counted_and_warned_about(preset):
    scene = with_bad_rows(random_scene(100), [3, 50])
    quats = scene.quats.clone()
    quats[50], quats[70] = 0.0, 0.0
    scene = scene.with_tensors({"quats": quats}, {})
    with pytest.warns(DroppedDataWarning) as caught:
        result = simplifier(preset).run(scene, 0.1)
    assert [str(warning.message) for warning in caught] == [
        "dropped 3 of 100 Gaussians with NaN, infinite or zero values (means 2, quats 2)."
    ]
    assert len(result.scene) == 10
    assert result.report.invalid_count == 3
    assert result.report.invalid_rows == {"means": 2, "quats": 2}
    assert result.report.shortfall == ""


@each_preset
def test_means_beyond_float32_are_dropped(preset):
    scene = random_scene(100, dtype=torch.float64)
    means = scene.means.clone()
    means[:40, 0], means[50, 1] = 1e160, 3e38
    with pytest.warns(DroppedDataWarning, match="dropped 40 of 100 Gaussians"):
        small = simplifier(preset).simplify(scene.with_tensors({"means": means}, {}), 0.1)
    assert len(small) == 10
    assert all(bool(values.isfinite().all()) for values in small.tensors().values())


def test_ratio_of_one_drops_invalid_rows():
    scene = random_scene(20)
    with pytest.warns(DroppedDataWarning):
        result = simplifier("standard").run(with_bad_rows(scene, [4]), 1.0)
    kept = torch.arange(20) != 4
    assert same_bits(result.scene, scene.select(kept))
    assert result.report.invalid_count == 1
    assert result.report.shortfall == "only 19 of 20 Gaussians are valid"


@each_preset
@pytest.mark.parametrize("count", [8, 7, 6])
def test_only_invalid_rows_can_lower_the_count(count, preset):
    scene = with_bad_rows(random_scene(10), [0, 1, 2])
    with pytest.warns(DroppedDataWarning):
        result = simplifier(preset).run(scene, count=count)
    assert len(result.scene) == min(count, 7)
    wanted = "only 7 of 10 Gaussians are valid" if count > 7 else ""
    assert result.report.shortfall == wanted


def test_one_valid_row_is_enough():
    scene = random_scene(5)
    with pytest.warns(DroppedDataWarning):
        small = simplifier("standard").simplify(with_bad_rows(scene, [0, 1, 2, 4]), count=1)
    assert small.means.tolist() == scene.means[3:4].tolist()


def test_no_valid_row_is_an_error():
    with pytest.raises(InvalidSceneError) as caught:
        simplifier("standard").simplify(with_bad_rows(random_scene(3), [0, 1, 2]), 0.5)
    assert str(caught.value) == (
        "none of the 3 Gaussians is valid; found NaN, infinite or zero values in means 3."
    )


@pytest.mark.parametrize("wish", [{"rho": 0.5}, {"rho": 1.0}])
def test_an_empty_scene_is_an_error(wish):
    with pytest.raises(InvalidSceneError) as caught:
        simplifier("standard").simplify(random_scene(0), **wish)
    assert str(caught.value) == "a scene needs at least one Gaussian to be simplified; found none."


@pytest.mark.parametrize("rho", [0.0, -0.1, 1.0000001, 2, NAN, INF, -INF])
def test_ratios_out_of_range_are_errors(rho):
    with pytest.raises(InvalidArgumentError) as caught:
        simplifier("standard").simplify(random_scene(5), rho)
    assert str(caught.value) == f"rho must be above 0 and at most 1; found {rho!r}."


@pytest.mark.parametrize("rho", ["1%", "0.1", b"0.1", True, np.True_, [0.1], torch.ones(2)])
def test_ratios_of_other_types_are_errors(rho):
    with pytest.raises(InvalidArgumentError, match="rho must be a number above 0 and at most 1"):
        target_count(5, rho)


@pytest.mark.parametrize("total", [-1, 100.5, "100"])
def test_totals_that_are_no_count_are_errors(total):
    with pytest.raises(InvalidArgumentError, match="total must be a whole number at least 0"):
        target_count(total, 0.1)


@pytest.mark.parametrize("count", [0, -1, 6, 2.0, True, "3"])
def test_counts_out_of_range_are_errors(count):
    with pytest.raises(InvalidArgumentError) as caught:
        simplifier("standard").simplify(random_scene(5), count=count)
    hint = "; max_count (--max-count) may be larger" if count == 6 else ""
    assert str(caught.value) == (
        f"count must be a whole number between 1 and the 5 Gaussians of the scene; "
        f"found {count!r}{hint}."
    )


@pytest.mark.parametrize(("things", "limit"), [("", "1,000"), ("points", "the 1,000 points")])
def test_limits_of_whole_numbers_name_what_is_counted_if_it_has_a_name(things, limit):
    with pytest.raises(InvalidArgumentError) as caught:
        checked_whole(2000, "count", most=1000, things=things)
    assert str(caught.value) == (f"count must be a whole number between 1 and {limit}, found 2000.")


def test_large_counts_are_grouped_in_errors():
    with pytest.raises(InvalidArgumentError, match=r"the 4,000 Gaussians of .* found 500,000; "):
        target_count(4000, None, count=500_000)
    with pytest.raises(InvalidArgumentError, match=r"^3,000 Gaussians .* 3,001 of the 4,000 "):
        check_room(3000, target=2000, total=4000)


@pytest.mark.parametrize(
    ("wish", "found"),
    [
        ({}, "none"),
        ({"rho": 0.5, "count": 2}, "rho and count"),
        ({"rho": 0.5, "max_count": 2}, "rho and max_count"),
    ],
)
def test_exactly_one_of_rho_count_and_max_count_is_required(wish, found):
    with pytest.raises(InvalidArgumentError) as caught:
        simplifier("standard").simplify(random_scene(5), **wish)
    assert str(caught.value) == f"give one of rho, count and max_count, found {found}."


@pytest.mark.parametrize(("most", "kept"), [(1, 1), (4, 4), (5, 5), (500, 5)])
def test_a_scene_below_max_count_is_unchanged(most, kept):
    scene = random_scene(5)
    small = simplifier("standard").simplify(scene, max_count=most)
    assert len(small) == kept
    assert most < 5 or torch.equal(small.means, scene.means)


@pytest.mark.parametrize("most", [0, 2.0, True])
def test_an_invalid_max_count_is_an_error(most):
    with pytest.raises(InvalidArgumentError, match="max_count must be a whole number above 0"):
        simplifier("standard").simplify(random_scene(5), max_count=most)


@pytest.mark.parametrize(
    ("text", "ratio"),
    [("5%", 0.05), ("0.7 %", 0.007), ("7%", 0.07), ("0.1", 0.1), ("1e-3", 0.001), (".5", 0.5)],
)
def test_ratios_are_parsed(text, ratio):
    assert read_ratio(text) == ratio


@pytest.mark.parametrize("text", ["", "%", "5 percent", "5%%", "1,5", "10e999999"])
def test_invalid_ratios_are_refused(text):
    with pytest.raises(InvalidArgumentError, match=r"a ratio must be a number such as 0\.05 or 5%"):
        read_ratio(text)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("50000", 50_000),
        ("50_000", 50_000),
        ("50,000", 50_000),
        ("1,500,000", 1_500_000),
        ("1e5", 100_000),
        ("2.5e+3", 2500),
        ("50k", 50_000),
        ("1.5M", 1_500_000),
        ("2 K", 2000),
    ],
)
def test_counts_are_parsed(text, count):
    assert read_count(text) == count


@pytest.mark.parametrize(
    "text", ["", "k", "0", "-5", "1.5", "0.1234k", "5g", "1.5e0", "1,5", "50,00", "1e999", "1e-3"]
)
def test_invalid_counts_are_refused(text):
    with pytest.raises(InvalidArgumentError, match="a count must be a whole number above 0"):
        read_count(text)


@pytest.mark.parametrize("number", [np.int64(6), np.uint8(6), torch.tensor(6)])
def test_counts_may_be_whole_numbers_of_numpy_and_torch(number):
    assert target_count(10, None, count=number) == 6
    assert type(target_count(10, None, max_count=number)) is int


@pytest.mark.parametrize("number", [6.0, True, np.float64(6), torch.tensor([6, 6]), "6"])
def test_counts_of_other_types_are_errors(number):
    for wish in ("count", "max_count"):
        with pytest.raises(InvalidArgumentError, match=f"{wish} must be a whole number"):
            target_count(10, None, **{wish: number})


def test_a_scene_whose_valid_rows_all_stay_is_not_refined():
    scene = random_scene(40, degree=0)
    means = scene.means.clone()
    means[0] = NAN
    config = SimplifyConfig.from_mapping({"refine": {"steps": 1, "size": 32, "stride": 1}})
    simplifier = Simplifier(config=config, device="cpu")
    with pytest.warns(DroppedDataWarning, match="dropped 1 of 40"):
        report = simplifier.run(scene.with_tensors({"means": means}, {}), count=39).report
    assert report.refinement is None
    assert report.views == "none"


def test_a_count_needs_no_ratio():
    assert target_count(100, count=5) == 5
    assert target_count(100, max_count=500) == 100
    with pytest.raises(InvalidArgumentError, match="give one of rho, count and max_count, found n"):
        target_count(100)
