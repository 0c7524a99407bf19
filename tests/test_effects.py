"""What a scene calls for."""

import pydantic
import pytest
import torch

from cvtgs import EffectPlan, GaussianScene
from cvtgs.effects import UNBOUNDED_DISTANCE, UNBOUNDED_SHARE, far_share, plan_effects
from cvtgs.math.frames import RobustFrame, robust_frame
from scenes import random_scene

FRAME = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=2.0)


def plan_of(scene: GaussianScene, **options: str) -> EffectPlan:
    return plan_effects(scene, scene.masses, robust_frame(scene.means), **options)


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


def test_share_of_mass_beyond_known_points():
    """The border lies at three radii, which are six units here."""
    means = torch.tensor([[5.9, 0, 0], [0, 6.1, 0], [0, 0, 100.0]])
    share = far_share(means, torch.tensor([5.0, 2.0, 3.0]), FRAME)
    assert UNBOUNDED_DISTANCE == 3.0
    assert share == pytest.approx(0.5)


@pytest.mark.parametrize("far", [0.5, 2.0])
def test_a_sky_makes_a_scene_unbounded(far):
    plan = plan_of(with_sky(far * UNBOUNDED_SHARE))
    assert plan.unbounded.active is (far > 1)
    assert plan.unbounded.figure == pytest.approx(far * UNBOUNDED_SHARE, rel=0.02)


def test_an_object_is_bounded():
    plan = plan_of(random_scene(1000))
    assert not plan.unbounded.active
    assert 0 <= plan.unbounded.figure < UNBOUNDED_SHARE


def test_a_choice_overrides_the_figure_but_not_its_value():
    scene = with_sky(0.5)
    on, off, auto = (plan_of(scene, unbounded=choice) for choice in ("on", "off", "auto"))
    assert (on.unbounded.active, off.unbounded.active, auto.unbounded.active) == (True, False, True)
    assert on.unbounded.figure == off.unbounded.figure == auto.unbounded.figure
    assert plan_of(random_scene(100), unbounded="on").unbounded.active


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_view_dependence_by_degree(degree):
    effect = plan_of(random_scene(50, degree=degree)).view_dependence
    assert effect.active is (degree > 0)
    assert effect.figure == degree


@pytest.mark.parametrize("tagged", [True, False])
def test_antialiasing_by_tag(tagged):
    comments = ("SplatRenderMode: mip",) if tagged else ("nothing",)
    scene = GaussianScene(**random_scene(50).tensors(), comments=comments)
    assert plan_of(scene).antialiasing.active is tagged


def test_extras_by_columns():
    scene = random_scene(50)
    assert not plan_of(scene).extras.active
    extras = {"a": torch.zeros(50), "b": torch.zeros(50)}
    effect = plan_of(scene.with_tensors({}, extras)).extras
    assert effect.active
    assert effect.figure == 2


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_unit_does_not_matter(unit):
    scene = with_sky(0.2)
    scaled = scene.with_tensors({"means": unit * scene.means}, {})
    assert plan_of(scaled).unbounded.figure == pytest.approx(plan_of(scene).unbounded.figure)


def test_every_effect_says_what_its_figure_means():
    plan = plan_of(random_scene(50))
    for name in EffectPlan.model_fields:
        effect = getattr(plan, name)
        assert "on " in effect.meaning, name


def test_frozen():
    plan = plan_of(random_scene(50))
    with pytest.raises(pydantic.ValidationError):
        plan.extras = plan.unbounded
