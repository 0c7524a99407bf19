"""Choice of the Gaussians that enter the tessellation."""

import pytest
import torch

import cvtgs
from cvtgs.analysis import analyze
from cvtgs.edit import Motion, move
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import psnr
from cvtgs.filters import FLYAWAY_RADII, filter_rows, flyaway_rows, visible_rows
from cvtgs.validity import (
    invalid_rows,
    lost_step,
    standardized,
    with_finite_opacities,
    writable_rows,
)
from cvtgs.views import automatic_views
from scenes import random_scene, same_bits

NAN, INF = float("nan"), float("inf")


def changed(name: str, row: int, value: float, *, degree: int = 1):
    scene = random_scene(5, degree=degree)
    tensor = getattr(scene, name).clone()
    tensor[row].view(-1)[-1] = value
    return scene.with_tensors({name: tensor}, {})


def test_the_faintest_are_dropped_while_they_hold_little_mass():
    opacities = torch.tensor([0.05, 0.5, 0.01, 0.09, 0.02])
    masses = torch.tensor([3.0, 90.0, 1.0, 5.0, 1.0])
    for share, kept in (
        (0.0, [0, 1, 2, 3, 4]),
        (0.01, [0, 1, 3, 4]),
        (0.02, [0, 1, 3]),
        (0.05, [1, 3]),
        (1.0, [1]),
    ):
        keep = visible_rows(opacities, masses, min_opacity=0.1, max_mass_share=share, at_least=1)
        assert keep.nonzero()[:, 0].tolist() == kept


def test_the_heaviest_are_kept_if_too_few_would_remain():
    opacities = torch.tensor([0.05, 0.5, 0.01, 0.09, 0.02])
    masses = torch.tensor([3.0, 90.0, 4.0, 5.0, 1.0])
    keep = visible_rows(opacities, masses, min_opacity=0.1, max_mass_share=1.0, at_least=3)
    assert keep.nonzero()[:, 0].tolist() == [1, 2, 3]


def test_opacities_at_the_threshold_stay():
    opacities = torch.tensor([0.1, 0.0999, 0.9])
    keep = visible_rows(opacities, opacities, min_opacity=0.1, max_mass_share=1.0, at_least=1)
    assert keep.tolist() == [True, False, True]


@pytest.mark.parametrize("at_least", [1, 2, 500, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scene_of_faint_gaussians_keeps_the_heaviest(at_least, dtype):
    """With share 1 all may be dropped, however their summed mass is rounded."""
    for seed in range(20):
        g = torch.Generator().manual_seed(seed)
        opacities = 0.09 * torch.rand(1000, generator=g, dtype=dtype)
        masses = torch.rand(1000, generator=g, dtype=dtype)
        keep = visible_rows(
            opacities, masses, min_opacity=0.1, max_mass_share=1.0, at_least=at_least
        )
        ranks = masses + (opacities >= 1 / 255)  # others are never drawn, and stay last
        heaviest = torch.sort(ranks, stable=True, descending=True).indices[:at_least]
        assert set(keep.nonzero()[:, 0].tolist()) == set(heaviest.tolist())


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.1, 0.5])
def test_the_mass_of_dropped_gaussians_is_bounded(share):
    scene = random_scene(2000)
    keep = visible_rows(
        scene.opacities, scene.masses, min_opacity=0.5, max_mass_share=share, at_least=1
    )
    masses = scene.masses * (scene.opacities >= 1 / 255)  # others are never drawn
    assert float(masses[~keep].sum()) <= share * float(masses.sum()) * (1 + 1e-12)
    assert not bool(keep[scene.opacities < 1 / 255].any())
    assert bool(keep[scene.opacities >= 0.5].all())


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [("object", 3000), ("courtyard", 2500)])
def test_what_training_would_prune_does_not_spoil_its_neighbours(kind, count):
    scene, g = cvtgs.synthetic.scene(kind, 2000, sh_degree=0), torch.Generator().manual_seed(0)
    near = scene.select(torch.randint(2000, (count,), generator=g))
    shifts = 3 * scene.scales.median() * torch.randn(count, 3, generator=g)
    dead = torch.full((count,), -5.4)  # painted within half a standard deviation
    near = near.with_tensors({"means": near.means + shifts, "logit_opacities": dead}, {})
    full = cvtgs.concatenate([scene, near])
    cameras = automatic_views(full, 6, width=128, height=128)
    wanted, scores = cvtgs.render(full, cameras).rgb, []
    for share in (0.0, 0.01):
        config = cvtgs.SimplifyConfig.from_mapping({"filter": {"max_mass_share": share}})
        small, report = cvtgs.Simplifier(config=config, device="cpu").run(full, count=1000)
        assert report.filtered_count == (count if share else 0)
        scores.append(float(psnr(cvtgs.render(small, cameras).rgb, wanted).mean()))
    assert scores[1] > scores[0] + 0.5


def test_a_clean_scene_has_no_invalid_rows():
    assert invalid_rows(random_scene(20, degree=3)) == {}
    assert invalid_rows(random_scene(0)) == {}


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "sh0", "shN"])
def test_values_that_are_not_finite_are_invalid(name, value):
    found = invalid_rows(changed(name, 3, value))
    assert {key: mask.tolist() for key, mask in found.items()} == {
        name: [False, False, False, True, False]
    }


def test_nan_opacities_are_invalid_and_infinite_ones_are_not():
    assert list(invalid_rows(changed("logit_opacities", 0, NAN))) == ["logit_opacities"]
    for value in (INF, -INF):
        assert invalid_rows(changed("logit_opacities", 0, value)) == {}


@pytest.mark.parametrize(("value", "bad"), [(88.0, False), (89.0, True), (400.0, True)])
def test_scales_beyond_float32_are_infinite(value, bad):
    assert bool(invalid_rows(changed("log_scales", 1, value))) is bad


def test_zero_quaternions_are_invalid_and_tiny_ones_are_not():
    scene = random_scene(4)
    quats = scene.quats.clone()
    quats[0], quats[1] = 0.0, 1e-40
    found = invalid_rows(scene.with_tensors({"quats": quats}, {}))
    assert found["quats"].tolist() == [True, False, False, False]


def test_huge_finite_values_are_valid():
    for name in ("means", "sh0", "shN", "quats"):
        assert invalid_rows(changed(name, 2, 3e38, degree=3)) == {}


def test_finite_opacities_are_left_alone():
    scene = random_scene(4)
    assert with_finite_opacities(scene) is scene
    logits = torch.tensor([INF, -INF, 700.0, 1.0])
    replaced = with_finite_opacities(scene.with_tensors({"logit_opacities": logits}, {}))
    assert replaced.logit_opacities.tolist() == pytest.approx([13.81551, -13.81551, 700.0, 1.0])


def test_standard_rows_stay_bit_for_bit():
    scene = random_scene(50, degree=2)
    once = standardized(scene)
    assert same_bits(standardized(once), once)
    norms = torch.linalg.vector_norm(once.quats, dim=1)
    torch.testing.assert_close(norms, torch.ones(50))
    assert torch.equal(once.means, scene.means)


def test_quaternions_are_of_unit_length_if_its_square_is_within_a_hundred_thousandth():
    quats = torch.nn.functional.normalize(random_scene(3).quats.double(), dim=1)
    squares = torch.tensor([0.8e-5, 1.2e-5, 0.5]).double().add(1)
    given = random_scene(3, dtype=torch.float64).with_tensors(quats=quats * squares.sqrt()[:, None])
    found = standardized(given).quats
    assert torch.equal(found[0], given.quats[0])
    torch.testing.assert_close(found[1:], quats[1:], rtol=0.0, atol=1e-12)


def test_standard_rows_have_opacities_strictly_between_0_and_1():
    scene = random_scene(3)
    logits = torch.tensor([INF, -700.0, 2.0])
    small = standardized(scene.with_tensors({"logit_opacities": logits}, {}))
    assert bool(((small.opacities > 0) & (small.opacities < 1)).all())
    assert small.logit_opacities[2].item() == 2.0


def test_flyaways_are_far_and_hold_little_mass():
    distances = torch.tensor([1.0, 30.0, 1e6, 1e3, 200.0])
    masses = torch.tensor([1.0, 5.0, 1e-9, 1e-8, 3.0])
    found = flyaway_rows(distances, masses, max_share=1e-3)
    assert found.tolist() == [False, False, True, True, False]
    assert not bool(flyaway_rows(distances, masses, max_share=0.0).any())


@pytest.mark.parametrize(("target", "kept"), [(1, 100), (100, 100), (101, 104)])
def test_flyaways_stay_if_the_target_needs_them(target, kept):
    scene = random_scene(104)
    means, logits = scene.means.clone(), torch.full((104,), 3.0)
    means[100:] *= 1e4
    scene = scene.with_tensors({"means": means, "logit_opacities": logits}, {})
    config = cvtgs.SimplifyConfig()
    found = filter_rows(scene, analyze(scene, config), target, config.filter)
    assert found.rows.tolist() == list(range(kept))
    assert found.left_out == 104 - kept


def test_flyaways_are_dropped_only_up_to_their_share_of_mass():
    distances, masses = torch.full((10,), 1e3), torch.ones(10)
    assert int(flyaway_rows(distances, masses, max_share=0.35).sum()) == 3


def test_what_stands_around_a_detailed_object_is_no_flyaway():
    """A room of 3,000 Gaussians around an object of 8,000 of a thousandth of its size."""
    room = cvtgs.synthetic.scene("room", 3000, sh_degree=0, seed=0)
    tiny = move(cvtgs.synthetic.scene("object", 8000, sh_degree=0, seed=0), Motion(scale=1e-3))
    both = cvtgs.concatenate([room, tiny])
    analysis = analyze(both, cvtgs.SimplifyConfig())
    assert int((analysis.frame.distances(both.means) > FLYAWAY_RADII).sum()) > 1000
    assert filter_rows(both, analysis, 100, cvtgs.SimplifyConfig().filter).left_out == 0


@pytest.mark.parametrize("opacity", [0.0005, 0.0038])
def test_gaussians_that_are_never_drawn_are_no_haze_and_no_frame(opacity):
    scene = cvtgs.synthetic.scene("object", 3000, sh_degree=0, seed=0)
    unseen = scene.with_tensors(
        {
            "means": 1e-6 * scene.means,
            "logit_opacities": torch.full((3000,), opacity).logit(),
            "log_scales": torch.zeros(3000, 3),
        },
        {},
    )
    both = cvtgs.concatenate([scene, unseen, unseen, unseen])
    report = cvtgs.Simplifier(device="cpu").run(both, count=300).report
    assert (report.filtered_count, report.plan.haze.active) == (9000, False)
    frames = [analyze(one, cvtgs.SimplifyConfig()).frame for one in (scene, both)]
    assert frames[0].radius == frames[1].radius
    assert torch.equal(frames[0].center, frames[1].center)
    assert analyze(unseen, cvtgs.SimplifyConfig()).frame.radius > 0  # of all, if none is drawn


ONES, SCENE, CONFIG = torch.ones(5), random_scene(5), cvtgs.SimplifyConfig()
ANALYSIS = analyze(SCENE, CONFIG)


def visible(opacities=ONES, masses=ONES, **changes):
    given = {"min_opacity": 0.1, "max_mass_share": 0.1, "at_least": 1}
    return visible_rows(opacities, masses, **(given | changes))


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: filter_rows(SCENE[:3], ANALYSIS, 1, CONFIG.filter), "analysis must be that of the "
         "3 Gaussians of the scene, found one of 5."),
        (lambda: filter_rows(None, ANALYSIS, 1, CONFIG.filter), "scene must be of type "
         "GaussianScene, found NoneType."),
        (lambda: filter_rows(SCENE, ANALYSIS, 6, CONFIG.filter), "target must be a whole number "
         "between 1 and the 5 Gaussians of the scene, found 6."),
        (lambda: filter_rows(SCENE, ANALYSIS, "a", CONFIG.filter), "scene, found 'a'."),
        (lambda: filter_rows(SCENE, ANALYSIS, 1.5, CONFIG.filter), "scene, found 1.5."),
        (lambda: visible(masses=ONES[:3]), "masses must be a tensor of floats of shape (5,), found "
         "torch.float32 of shape (3,)."),
        (lambda: visible(ONES * NAN), "opacities must be between 0 and 1, found nan to nan."),
        (lambda: visible(min_opacity=-1), "min_opacity must be a number from 0 to 1, found -1."),
        (lambda: visible(max_mass_share=5), "max_mass_share must be a number from 0 to 1, found "
         "5."),
        (lambda: visible(at_least=-10), "at_least must be a whole number between 0 and the 5 "
         "Gaussians, found -10."),
        (lambda: flyaway_rows(ONES, ONES[:3], max_share=0.1), "found torch.float32 of shape (3,)."),
        (lambda: flyaway_rows(ONES, ONES, max_share=-1), "max_share must be a number from 0 to 1, "
         "found -1."),
        (lambda: flyaway_rows(ONES, ONES, max_share="a"), "found 'a'."),
    ],
)  # fmt: skip
def test_wrong_arguments(call, text):
    with pytest.raises(InvalidArgumentError) as caught:
        call()
    assert str(caught.value).endswith(text)


def test_flyaways_may_hold_exactly_the_share():
    distances, masses = torch.tensor([1.0, 200.0]), torch.tensor([3.0, 1.0])
    assert flyaway_rows(distances, masses, max_share=0.25).tolist() == [False, True]


def test_of_equally_faint_ones_the_lightest_are_dropped_first() -> None:
    opacities, masses = torch.tensor([0.05, 0.05, 0.9]), torch.tensor([2.0, 1.0, 97.0])
    keep = visible_rows(opacities, masses, min_opacity=0.1, max_mass_share=0.01, at_least=1)
    assert keep.tolist() == [True, False, True]


def test_the_filter_keeps_opacities_at_the_threshold() -> None:
    scene = random_scene(50)
    least = float(scene.opacities.sort().values[20])
    config = cvtgs.SimplifyConfig.from_mapping(
        {"filter": {"min_opacity": least}, "effects": {"haze": "off"}}
    )
    found = filter_rows(scene, analyze(scene, config), 1, config.filter)
    assert (len(found.rows), found.left_out) == (30, 20)


def test_without_haze_faint_gaussians_stay_only_up_to_the_target() -> None:
    scene = random_scene(50)
    config = cvtgs.SimplifyConfig.from_mapping(
        {"filter": {"min_opacity": 0.9, "max_mass_share": 0.1}, "effects": {"haze": "off"}}
    )
    visible = int((scene.opacities >= 0.9).sum())
    found = filter_rows(scene, analyze(scene, config), visible + 2, config.filter)
    assert len(found.rows) == visible + 2


@pytest.mark.parametrize(
    ("shift", "size", "step"), [(4.1e6, 0.1, 0.25), (4.1e6, 40.0, 0.0), (INF, 0.1, 0.0)]
)
def test_steps_of_far_positions_are_lost_only_beside_small_gaussians(
    shift: float, size: float, step: float
) -> None:
    scene = random_scene(50, size=size)
    assert lost_step(scene.with_tensors({"means": scene.means + shift}, {})) == step


def test_standard_rows_have_finite_scales() -> None:
    scales = standardized(changed("log_scales", 2, 200.0)).scales
    assert bool(scales.isfinite().all())
    assert float(scales[2, 2]) > 3e38


def test_positions_beyond_float32_count_as_infinite() -> None:
    scene = random_scene(3, dtype=torch.float64)
    means = scene.means.clone()
    means[0, 0], means[1, 0] = 3e38, 1e39
    far = scene.with_tensors({"means": means}, {})
    assert invalid_rows(far)["means"].tolist() == [False, True, False]
    assert writable_rows(far).tolist() == [True, False, True]


def test_of_those_that_images_cannot_show_the_heaviest_come_back():
    keep = visible_rows(
        torch.tensor([0.001, 0.001, 0.001, 0.9]),
        torch.tensor([1.0, 3.0, 2.0, 9.0]),
        min_opacity=0.1,
        max_mass_share=1.0,
        at_least=2,
    )
    assert keep.tolist() == [False, True, False, True]
