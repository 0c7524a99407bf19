"""The parts of refinement: budget, views, images, variables."""

import math
import weakref
from itertools import chain

import pydantic
import pytest
import torch

from cvtgs.cameras import Cameras
from cvtgs.config import Rates
from cvtgs.refinement import RefineConfig
from cvtgs.refinement import budget as budget_module
from cvtgs.refinement.budget import Budget
from cvtgs.refinement.images import Image, ImageBuffer, best_counted, scores, take_image
from cvtgs.refinement.looking import Outlook, given_outlook, own_outlook
from cvtgs.refinement.variables import Variables, changed_count
from refine_cases import full_scene, quick, ring
from scenes import random_scene, same_bits


class Clock:
    """Stands still until it is told to go on."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(budget_module.time, "perf_counter", lambda: self.now)


@pytest.fixture
def clock(monkeypatch) -> Clock:
    return Clock(monkeypatch)


def test_steps_are_counted():
    budget = Budget(None, steps=4)
    assert (budget.total, budget.done, budget.share(), budget.spent()) == (4, 0, 0.0, "")
    shares = []
    for _ in range(4):
        budget.begin()
        budget.end("step")
        shares.append((budget.share(), budget.done))
    assert shares == [(0.25, 1), (0.5, 2), (0.75, 3), (1.0, 3)]
    assert budget.spent() == "steps"


def test_time_ends_before_a_round_that_would_not_fit(clock):
    budget = Budget(10.0, steps=None)
    budget.begin()
    clock.now += 2
    budget.end("check")
    clock.now += 1
    budget.end("step")
    assert (budget.total, budget.done, budget.steps) == (1000, 300, 1)
    clock.now = 106.9
    assert budget.spent() == ""
    clock.now = 107.1
    assert budget.spent() == "time"


def test_the_first_step_is_told_though_hardly_any_time_went_by(clock):
    budget = Budget(10.0, steps=None)
    assert budget.done == 0
    budget.begin()
    budget.end("step")
    assert budget.done == 1
    clock.now += 20
    assert (budget.done, budget.share()) == (999, 1.0)


def test_own_views_are_endless_and_the_held_out_ones_are_others():
    full = full_scene()
    outlook = own_outlook(full, config=quick(heldout=5, batch=4), seed=0)
    assert len(outlook.heldout) == 5
    learning = [next(outlook.learning) for _ in range(9)]
    cameras = [camera.viewmats for camera in (*outlook.heldout, *learning)]
    assert all(len(camera) == 1 for camera in cameras)
    different = {tuple(camera.flatten().tolist()) for camera in cameras}
    assert len(different) == 14
    assert {(camera.width, camera.height) for camera in learning} == {(32, 32)}


def test_the_seed_decides_the_views():
    full = full_scene()
    first, again, other = (
        next(own_outlook(full, config=quick(), seed=seed).learning).viewmats for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("count", "heldout", "number"), [(2, 8, 1), (9, 8, 1), (16, 8, 2), (100, 8, 8), (100, 3, 3)]
)
def test_given_cameras_are_divided(count, heldout, number):
    cameras = ring(count)
    outlook = given_outlook(cameras, config=RefineConfig(heldout=heldout), seed=0)
    learning = list(outlook.learning)
    assert (len(outlook.heldout), len(learning)) == (number, count - number)
    everything = torch.cat([camera.viewmats for camera in chain(outlook.heldout, learning)])
    assert len({tuple(each.flatten().tolist()) for each in everything}) == count


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(640, 480, (64, 48)), (40, 30, (40, 30)), (6400, 100, (64, 11)), (5, 7, (11, 11))],
)
def test_large_images_are_made_smaller_and_tiny_ones_larger(width, height, size):
    outlook = given_outlook(
        ring(2, width=width, height=height), config=RefineConfig(size=64), seed=0
    )
    camera = outlook.heldout[0]
    assert (camera.width, camera.height) == size
    assert camera.Ks[0, 0, 2].item() == pytest.approx(size[0] / 2)


def flat_image(value: float, alpha: float) -> Image:
    return Image(
        camera=ring(1),
        rgb=torch.full((1, 24, 32, 3), value),
        alpha=torch.full((1, 24, 32), alpha),
    )


def test_a_image_over_a_background():
    found = flat_image(0.25, 0.5).over(torch.tensor([1.0, 0.5, 0.0]).double())
    assert found.dtype == torch.float64
    assert found[0, 3, 4].tolist() == [0.75, 0.5, 0.25]


def test_scores_by_hand():
    """A Gaussian behind the camera paints nothing: black over black, white over white."""
    blind = random_scene(1).with_tensors({"means": torch.tensor([[0.0, 0.0, -90.0]])}, {})
    assert scores(blind, (flat_image(0.0, 0.0),)).tolist() == [60, 60]
    # Off by 0.1 over black, by 0.1 over white.
    found = scores(blind, (flat_image(0.1, 0.2), flat_image(0.1, 0.1)))
    # The second is off by 0.1 over black (20 dB), and equal over white.
    assert found.tolist() == pytest.approx([20, 20, 20, 60], abs=1e-4)


def test_a_view_far_better_than_the_others_does_not_decide():
    assert best_counted(torch.tensor([20.0, 24.0, 26.0, 58.0])) == 34
    assert best_counted(torch.tensor([55.0, 58.0])) == 60


def three_views(*, endless: bool = False) -> Outlook:
    cameras = ring(3)
    singles = [cameras.select(torch.tensor([row])) for row in range(3)]
    return Outlook(heldout=(), learning=iter(singles), endless=endless)


@pytest.mark.parametrize("endless", [False, True])
def test_images_are_taken_when_needed_and_looked_at_again(endless):
    full = full_scene(50)
    config = quick(steps_per_image=3, images=2)
    album = ImageBuffer(full, three_views(endless=endless), config=config, seed=0)
    taken, drawn = [], []
    for _ in range(12):
        drawn.append(album.draw())
        taken.append(album.taken)
    assert taken == [1, 1, 1, 2, 2, 2, 3, 3, 3, 3, 3, 3]
    assert all(image is drawn[0] for image in drawn[:3])
    assert len({id(image) for image in drawn[6:]}) == 2
    assert drawn[0].rgb.dtype == torch.float16
    exact = take_image(full, drawn[0].camera)
    torch.testing.assert_close(drawn[0].rgb.float(), exact.rgb, rtol=1e-3, atol=1e-3)


def test_images_that_are_never_looked_at_again_are_not_kept():
    album = ImageBuffer(full_scene(50), three_views(endless=True), config=quick(images=9), seed=0)
    first, second = weakref.ref(album.draw().rgb), album.draw()
    assert first() is None
    assert second.rgb.shape == (1, 24, 32, 3)


def test_backgrounds_are_drawn():
    full = full_scene(50)
    albums = [ImageBuffer(full, three_views(), config=quick(), seed=seed) for seed in (0, 0, 1)]
    first, again, other = (album.draw_color() for album in albums)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert 0 <= float(first.amin()) <= float(first.amax()) <= 1


def test_a_step_has_the_length_of_the_rate_by_which_a_gaussian_is_free():
    scene = random_scene(4, degree=0)
    freedom = torch.tensor([1.0, 1.0, 0.5, 0.0])
    variables = Variables(scene, Rates(sh0=0.25, means=0.5), freedom=freedom)
    now = variables.scene()
    variables.step(now.sh0[:, 0, 0].sum() - 3 * now.means[1, 2], factor=0.5)
    found = variables.result()
    moved = scene.sh0.clone()
    moved[:, 0, 0] -= 0.125 * freedom
    torch.testing.assert_close(found.sh0, moved)
    unit = scene.scales[1].mean().item()
    assert (found.means - scene.means)[1, 2].item() == pytest.approx(0.25 * unit, rel=1e-4)
    torch.testing.assert_close(found.log_scales, scene.log_scales)


def test_rows_without_a_gradient_keep_their_bits_and_their_momentum():
    scene = random_scene(5)
    variables = Variables(scene, Rates(), freedom=torch.ones(len(scene)))
    variables.step(variables.scene().sh0[0].sum(), factor=1.0)
    before = variables.result()
    variables.step(variables.scene().sh0[1].sum(), factor=1.0)
    after = variables.result()
    assert same_bits(before.select(torch.tensor([0])), after.select(torch.tensor([0])))
    rest = torch.tensor([2, 3, 4])
    assert same_bits(after.select(rest), scene.select(rest))
    assert changed_count(scene, after) == 2


def test_a_row_with_one_bad_gradient_is_left_alone():
    scene = random_scene(3)
    variables = Variables(scene, Rates(), freedom=torch.ones(len(scene)))
    now = variables.scene()
    weights = torch.tensor([[1.0, 1, 1], [1, math.nan, 1], [math.inf, 1, 1]])
    variables.step((now.means * weights).sum() + now.sh0.sum(), factor=1.0)
    found = variables.result()
    rest = torch.tensor([1, 2])
    assert same_bits(found.select(rest), scene.select(rest))
    assert changed_count(scene, found) == 1


def test_rows_that_left_what_can_be_drawn_come_back():
    scene = random_scene(3)
    variables = Variables(scene, Rates(log_scales=1e6), freedom=torch.ones(len(scene)))
    variables.step(-variables.scene().log_scales[1].sum(), factor=1.0)
    assert same_bits(variables.result(), scene)


def test_a_loss_that_depends_on_nothing():
    scene = random_scene(3)
    variables = Variables(scene, Rates(), freedom=torch.ones(len(scene)))
    variables.step(torch.tensor(1.0), factor=1.0)
    variables.step(variables.scene().sh0.sum() * 0, factor=1.0)
    assert same_bits(variables.result(), scene)


@pytest.mark.parametrize(
    "values", [{"size": 8}, {"half_after": 0}, {"rates": {"sh0": -1}}, {"colour": 1}]
)
def test_settings_that_cannot_be(values):
    with pytest.raises(pydantic.ValidationError):
        RefineConfig(**values)


def test_cameras_of_one_view_each():
    outlook = given_outlook(ring(4), config=RefineConfig(), seed=1)
    assert all(isinstance(camera, Cameras) and len(camera) == 1 for camera in outlook.learning)
