"""The effects that a scene needs: figures and decisions."""

import math
from dataclasses import replace

import pydantic
import pytest
import torch

from cvtgs import EffectPlan, GaussianScene, SimplifyConfig, concatenate
from cvtgs.analysis import analyze, plan_effects
from cvtgs.analysis.effects import (
    BAND_LOSS,
    DUPLICATE_SHARE,
    UNBOUNDED_DISTANCE,
    UNBOUNDED_SHARE,
    band_losses,
    drawn_rows,
    drop_mip_tag,
    duplicate_share,
    far_share,
    haze_share,
    mean_clamped,
    select_columns,
)
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.spherical_harmonics import REST_COUNTS, evaluate
from cvtgs.tags import ANTIALIASED
from scenes import random_scene

FRAME = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=2.0)


def plan_of(scene: GaussianScene, **choices: object) -> EffectPlan:
    config = SimplifyConfig.from_mapping({"effects": choices})
    return plan_effects(scene, scene.masses, distances=distances_in(scene), config=config)


def distances_in(scene: GaussianScene) -> torch.Tensor:
    return robust_frame(scene.means).distances(scene.means)


def with_sky(share: float) -> GaussianScene:
    """A scene with this share of its mass on a far shell."""
    scene = random_scene(1000)
    means, log_scales = scene.means.clone(), scene.log_scales * 0 - 3.0
    directions = torch.nn.functional.normalize(means[:100], dim=1)
    means[:100] = 50.0 * directions
    logits = torch.zeros(1000)
    far, near = 100.0, 900.0
    factor = share * near / ((1 - share) * far)
    log_scales[:100] += 0.5 * torch.log(torch.tensor(factor))
    return scene.with_tensors(
        {"means": means, "log_scales": log_scales, "logit_opacities": logits}, {}
    )


def with_bands(*sizes: float, count: int = 300) -> GaussianScene:
    """A scene whose SH bands are random numbers of these sizes."""
    scene = random_scene(count, degree=len(sizes))
    rest = scene.shN.clone()
    for degree, size in enumerate(sizes, start=1):
        rest[:, REST_COUNTS[degree - 1] : REST_COUNTS[degree]] *= size
    return scene.with_tensors({"shN": rest}, {})


def test_share_of_mass_beyond_known_points():
    """The border lies at three radii, which are six units here."""
    means = torch.tensor([[5.9, 0, 0], [0, 6.1, 0], [0, 0, 100.0]])
    share = far_share(FRAME.distances(means), torch.tensor([5.0, 2.0, 3.0]))
    assert UNBOUNDED_DISTANCE == 3.0
    assert share == pytest.approx(0.5)


def test_loss_of_a_known_band():
    """One coefficient c of degree 1 changes colours by c sqrt(3 / (4 pi)), along its axis.

    Colours of two equally opaque Gaussians that differ by 2 d have the standard deviation d.
    """
    scene = random_scene(2, degree=1, dtype=torch.float64)
    tensors = {name: torch.zeros_like(scene.tensors()[name]) for name in ("sh0", "shN")}
    tensors["sh0"][1] = 0.2
    tensors["shN"][0, 1, 2] = 0.3
    scene = scene.with_tensors(
        {**tensors, "logit_opacities": torch.zeros(2, dtype=torch.float64)}, {}
    )
    contrast = 0.1 * 0.5 / math.sqrt(math.pi)
    wanted = 0.3 * math.sqrt(3 / (4 * math.pi)) / contrast
    assert band_losses(scene, enough=1.0) == pytest.approx((wanted,))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_no_colour_changes_by_more_than_the_loss(degree):
    """A contrast of at least 1 does not scale losses."""
    sizes = [0.0] * (degree - 1) + [1.0]
    scene = with_bands(*sizes)
    scene = scene.with_tensors({"sh0": 20 * scene.sh0.sign()}, {})
    bound = band_losses(scene, enough=math.inf)[-1]
    generator = torch.Generator().manual_seed(0)
    largest = 0.0
    for _ in range(50):
        ways = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1)
        bright = torch.full_like(scene.sh0, 20.0)
        change = evaluate(bright, scene.shN, ways) - evaluate(bright, scene.shN[:, :0], ways)
        largest = max(largest, float(change.abs().amax()))
    assert 0.3 * bound < largest <= 1.0001 * bound


def test_the_search_for_losses_sees_every_gaussian():
    scene = with_bands(0.0, count=40_000)
    rest = scene.shN.clone()
    rest[-1] = 1.0
    assert band_losses(scene, enough=1.0) == (0.0,)
    assert band_losses(scene.with_tensors({"shN": rest}, {}), enough=1.0)[0] > 0.1


def test_a_scene_of_one_colour_keeps_its_bands():
    scene = with_bands(1e-3)
    assert plan_of(scene.with_tensors({"sh0": torch.zeros_like(scene.sh0)}, {})).sh.degree == 1


@pytest.mark.parametrize(
    ("sizes", "degree"),
    [
        ((), 0),
        ((0.0,), 0),
        ((1.0, 0.0), 1),
        ((1.0, 1e-7, 1e-7), 1),
        ((0.0, 1.0, 0.0), 2),
        ((0.0, 0.0, 1.0), 3),
        ((1.0, 1.0, 1.0), 3),
        ((1e-7, 1e-7, 1e-7), 0),
    ],
)
def test_the_degree_depends_on_the_energy_of_the_bands(sizes, degree):
    effect = plan_of(with_bands(*sizes)).sh
    assert (effect.active, effect.degree) == (degree > 0, degree)
    assert sum(effect.bands[degree:]) <= BAND_LOSS
    assert len(effect.bands) == len(sizes)
    assert not effect.forced


def test_losses_of_several_bands_add_up():
    """Each alone would be left out."""
    scene = with_bands(1.0, 1.0, 1.0)
    losses = band_losses(scene, enough=math.inf)
    sizes = [0.6 * BAND_LOSS / loss for loss in losses]
    assert plan_of(with_bands(*sizes)).sh.degree == 2


@pytest.mark.parametrize(("choice", "degree"), [(0, 0), ("off", 0), (1, 1), (3, 2), ("on", 2)])
def test_a_forced_degree_is_at_most_that_of_the_scene(choice, degree):
    effect = plan_of(with_bands(1.0, 0.0), sh=choice).sh
    assert (effect.degree, effect.forced) == (degree, True)
    assert effect.figure == plan_of(with_bands(1.0, 0.0)).sh.figure


@pytest.mark.parametrize("far", [0.5, 2.0])
def test_a_sky_makes_a_scene_unbounded(far):
    plan = plan_of(with_sky(far * UNBOUNDED_SHARE))
    assert plan.unbounded.active is (far > 1)
    assert plan.unbounded.figure == pytest.approx(far * UNBOUNDED_SHARE, rel=0.02)
    assert plan.unbounded.strength == (far > 1)


@pytest.mark.parametrize("share", [0.06, 0.075, 0.09])
def test_scenes_between_bounded_and_unbounded_get_a_partial_strength(share):
    effect = plan_of(with_sky(share)).unbounded
    assert effect.active
    assert effect.strength == pytest.approx((effect.figure - 0.05) / 0.05)
    assert 0.05 < effect.strength < 0.95


def test_a_small_far_share_is_not_contracted():
    effect = plan_of(with_sky(0.03), unbounded="on").unbounded
    assert effect.active
    assert effect.strength == 0.0


def test_an_object_is_bounded():
    plan = plan_of(random_scene(1000))
    assert not plan.unbounded.active
    assert 0 <= plan.unbounded.figure < UNBOUNDED_SHARE


def test_giants_that_are_never_drawn_do_not_make_a_scene_unbounded():
    scene = random_scene(1000)
    unseen = scene[:10]
    unseen = unseen.with_tensors(
        means=unseen.means + 50.0,
        log_scales=torch.full((10, 3), 10.0),
        logit_opacities=torch.full((10,), 0.003).logit(),
    )
    both = concatenate([scene, unseen])
    plain, found = (analyze(one, SimplifyConfig()).plan.unbounded for one in (scene, both))
    assert found.figure == pytest.approx(plain.figure)
    assert (found.active, found.strength) == (False, 0.0)


def test_a_choice_overrides_the_decision_but_not_the_figure():
    scene = with_sky(0.5)
    on, off, auto = (plan_of(scene, unbounded=choice).unbounded for choice in ("on", "off", "auto"))
    assert (on.active, off.active, auto.active) == (True, False, True)
    assert (on.forced, off.forced, auto.forced) == (True, True, False)
    assert on.figure == off.figure == auto.figure


def test_without_far_gaussians_unbounded_cannot_be_forced_on():
    near = random_scene(100)
    near = near.with_tensors({"means": near.means.clamp(-1, 1)}, {})
    assert plan_of(near).unbounded.figure == 0.0
    assert not plan_of(near, unbounded="on").unbounded.active


@pytest.mark.parametrize("tagged", [True, False])
@pytest.mark.parametrize("choice", ["auto", "on", "off"])
def test_antialiasing_depends_on_the_tag(tagged, choice):
    comments = (ANTIALIASED.text,) if tagged else ("nothing",)
    scene = GaussianScene(**random_scene(50).tensors(), comments=comments)
    effect = plan_of(scene, mip=choice).mip
    assert effect.active is (tagged and choice != "off")
    assert effect.figure == tagged


@pytest.mark.parametrize("share", [0.008, 0.02])
def test_haze_depends_on_the_mass_of_faint_gaussians(share):
    """Of 100 spheres of one size, 40 are faint, but all are drawn."""
    scene = random_scene(100)
    opacities = torch.full((100,), 0.5)
    opacities[:40] = share * 60 * 0.5 / ((1 - share) * 40)
    scene = scene.with_tensors(
        {"log_scales": scene.log_scales * 0, "logit_opacities": torch.logit(opacities)}, {}
    )
    config = SimplifyConfig.from_mapping({"filter": {"min_opacity": 0.1}})
    effect = plan_effects(scene, scene.masses, distances=distances_in(scene), config=config).haze
    assert effect.figure == pytest.approx(share)
    assert effect.active is (share > 0.01)
    assert not plan_of(scene).haze.active
    assert not plan_of(scene, haze="on").haze.active, "no mass is fainter than 0.005"
    for choice in ("on", "off"):
        forced = SimplifyConfig.from_mapping(
            {"filter": {"min_opacity": 0.1}, "effects": {"haze": choice}}
        )
        effect = plan_effects(scene, scene.masses, distances=distances_in(scene), config=forced)
        assert effect.haze.active is (choice == "on")


@pytest.mark.parametrize("two_scales", [False, True])
def test_flat_is_on_for_files_with_two_scales(two_scales):
    layout = (("scale_0", "float"), ("scale_1", "float")) if two_scales else ()
    scene = replace(random_scene(50), layout=layout)
    for choice in ("auto", "off"):
        config = SimplifyConfig.from_mapping({"effects": {"flat": choice}})
        far = distances_in(scene)
        effect = plan_effects(scene, scene.masses, distances=far, config=config).flat
        assert effect.active is (two_scales and choice == "auto")
        assert effect.figure == two_scales


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 50, 100_000])
@pytest.mark.parametrize("copies", [1, 2, 4])
def test_share_of_duplicates(count, copies, dtype):
    """Large scenes are judged by a sample of a few percent, wherever the copies are."""
    scene = random_scene(count, degree=0, dtype=dtype)
    rows = torch.arange(count).repeat(copies)
    found = duplicate_share(scene.means[rows], scene.sh0[rows])
    assert found == pytest.approx(1 - 1 / copies, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [8000, 200_000])
@pytest.mark.parametrize("step", [1.0, 1 / 64, 1 / 4096])
def test_duplicates_of_rounded_positions_are_found(step, count, dtype):
    random = torch.Generator().manual_seed(0)
    means = step * torch.randint(-30, 30, (count, 3), generator=random).to(dtype)
    wanted = 1 - len(torch.unique(means, dim=0)) / count
    error = 1e-9 if count == 8000 else 0.02  # estimated from a sample
    assert float(duplicate_share(means, torch.zeros(count, 1, 3))) == pytest.approx(
        wanted, abs=error
    )


def test_zeros_of_both_signs_are_one_position():
    means = random_scene(50).means * torch.tensor([0.0, 1, 1])
    both = torch.cat([means, means * torch.tensor([-1.0, 1, 1])])  # sampled in the order of hashes
    assert float(duplicate_share(both, torch.zeros(100, 1, 3))) == 0.5


def test_duplicates_have_one_colour():
    scene = random_scene(50, degree=0)
    assert duplicate_share(scene.means * 0, scene.sh0) == 0.0
    assert duplicate_share(scene.means * 0, scene.sh0 * 0) == 49 / 50


def test_few_duplicates_are_not_worth_merging():
    scene = random_scene(1000, degree=0)
    for few, active in ((5, False), (30, True)):
        rows = torch.cat([torch.arange(1000 - few), torch.arange(few)])
        effect = plan_of(scene.select(rows)).duplicates
        assert effect.figure == few / 1000
        assert effect.active is active is (few / 1000 > DUPLICATE_SHARE)


def test_extras_depend_on_the_columns():
    scene = random_scene(50)
    assert not plan_of(scene).extras.active
    effect = plan_of(scene.with_tensors({}, {"a": torch.zeros(50), "b": torch.zeros(50)})).extras
    assert effect.active
    assert effect.figure == 2


@pytest.mark.parametrize(("views", "choice"), [(0, "auto"), (4, "auto"), (4, "off")])
def test_images_are_planned_only_if_requested(views, choice):
    config = SimplifyConfig.from_mapping(
        {"visibility": {"views": views}, "effects": {"visibility": choice}}
    )
    scene = random_scene(50)
    far = distances_in(scene)
    effect = plan_effects(scene, scene.masses, distances=far, config=config).visibility
    assert effect.active is (views > 0 and choice == "auto")
    assert effect.figure == views


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_unit_does_not_matter(unit):
    scene = with_sky(0.2)
    scaled = scene.with_tensors({"means": unit * scene.means}, {})
    ours, theirs = plan_of(scaled), plan_of(scene)
    for name in EffectPlan.model_fields:
        assert getattr(ours, name).figure == pytest.approx(getattr(theirs, name).figure)


def test_the_plan_and_the_configuration_have_the_same_names():
    names = list(type(SimplifyConfig().effects).model_fields)
    assert list(EffectPlan.model_fields) == names


def test_every_effect_says_when_it_is_on():
    plan = plan_of(random_scene(50))
    for name in EffectPlan.model_fields:
        effect = getattr(plan, name)
        assert effect.meaning.startswith("on if "), name


def test_a_plan_is_frozen():
    plan = plan_of(random_scene(50))
    with pytest.raises(pydantic.ValidationError):
        plan.extras = plan.unbounded


def test_gaussians_that_images_cannot_show_are_not_drawn():
    assert drawn_rows(torch.tensor([0.001, 1 / 255, 0.5])).tolist() == [False, True, True]
    assert drawn_rows(torch.tensor([0.001, 0.002])).tolist() == [True, True]  # a scene needs some


def test_forced_choices_drop_bands_columns_and_the_tag():
    tag, labels = ("SplatRenderMode: mip",), {"label": torch.arange(10)}
    scene = replace(random_scene(10), extras=labels, comments=tag)
    assert select_columns(scene, SimplifyConfig().effects) is scene
    choices = SimplifyConfig.from_mapping({"effects": {"sh": 1, "extras": "off"}}).effects
    chosen = select_columns(scene, choices)
    assert (chosen.sh_degree, dict(chosen.extras)) == (1, {})
    assert drop_mip_tag(scene, plan_of(scene)) is scene
    assert not drop_mip_tag(scene, plan_of(scene, mip="off")).antialiased


def test_what_is_never_drawn_is_no_haze():
    least = 1 / 255 + 1e-4
    config = SimplifyConfig.from_mapping({"filter": {"min_opacity": 2 * least}})
    opacities = torch.tensor([0.001, least, 0.9])
    found = haze_share(opacities, torch.tensor([10.0, 1.0, 3.0]), config)
    assert float(found) == pytest.approx(1 / (1 + 3))


def test_masses_of_other_gaussians_are_refused():
    scene = random_scene(5)
    for masses, found in ((scene.masses, "distances must be a tensor"), (torch.ones(4), "masses")):
        with pytest.raises(InvalidArgumentError, match=found):
            plan_effects(scene, masses, distances=torch.ones(4))
    with pytest.raises(InvalidArgumentError, match="config must be of type SimplifyConfig or None"):
        plan_effects(scene, scene.masses, distances=torch.ones(5), config={})


@pytest.mark.parametrize("count", [2000, 50_000])
def test_colours_below_zero_do_not_depend_on_the_order_of_rows(count):
    """A few of the Gaussians have most of the mass."""
    scene = random_scene(count, degree=1, seed=3)
    scene = scene.with_tensors(log_scales=3.0 * scene.log_scales, sh0=scene.sh0 - 1.0)
    whole = float(mean_clamped(scene, scene.masses))
    assert whole > 0.01
    for seed in range(3):
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
        mixed = scene.select(order)
        assert float(mean_clamped(mixed, mixed.masses)) == pytest.approx(whole, rel=1e-9)
