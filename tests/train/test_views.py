"""Views: images of full scenes, pieces of them, and from where they are taken."""

import pytest
import torch

from cvtgs.cameras import Cameras
from cvtgs.math.frames import robust_frame
from cvtgs.rendering import render
from cvtgs.train.views import Views, look_at_scene
from cvtgs.views import automatic_views, random_views
from train_cases import bits_of_views, small_scene


def numbered_views(size: int = 8) -> Views:
    """One image whose red tells the column and whose green tells the row."""
    steps = torch.arange(size, dtype=torch.float16)
    rgb = torch.zeros(1, size, size, 3, dtype=torch.float16)
    rgb[..., 0], rgb[..., 1] = steps, steps[:, None]
    intrinsics = torch.tensor([[[10.0, 0, size / 2], [0, 10.0, size / 2], [0, 0, 1]]])
    cameras = Cameras(viewmats=torch.eye(4)[None], Ks=intrinsics, width=size, height=size)
    return Views(cameras=cameras, rgb=rgb, alpha=rgb[..., 0] / 10)


def test_images_over_a_background():
    views = numbered_views()
    image = views.over(torch.tensor([1.0, 0.5, 0.0]))[0]
    assert image.dtype == torch.float32
    assert image[2, 5].tolist() == pytest.approx([5 + 0.5, 2 + 0.25, 0.0], abs=1e-3)
    assert image[0, 0].tolist() == [1.0, 0.5, 0.0]


def test_one_image_keeps_its_camera():
    scene = small_scene()
    views = look_at_scene(scene, 3, size=32, seed=2)
    one = views.select(1)
    assert torch.equal(one.rgb[0], views.rgb[1])
    assert torch.equal(one.alpha[0], views.alpha[1])
    assert torch.equal(one.cameras.viewmats[0], views.cameras.viewmats[1])
    assert len(one.cameras) == 1


def test_half_of_the_views_are_the_automatic_ones():
    scene = small_scene()
    views = look_at_scene(scene, 3, size=32, seed=2)
    usual = automatic_views(scene, 2, width=32, height=32, seed=2)
    around = random_views(scene, 1, size=32, seed=2)
    assert torch.equal(views.cameras.viewmats, torch.cat([usual.viewmats, around.viewmats]))
    assert torch.equal(views.cameras.Ks, torch.cat([usual.Ks, around.Ks]))
    assert views.rgb.shape == (3, 32, 32, 3)
    assert views.rgb.dtype == views.alpha.dtype == torch.float16
    images = render(scene, views.cameras)
    torch.testing.assert_close(views.rgb.float(), images.rgb, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(views.alpha.float(), images.alpha, rtol=1e-3, atol=1e-3)


def test_one_view_is_an_automatic_one():
    scene = small_scene()
    usual = automatic_views(scene, 1, width=32, height=32, seed=0)
    views = look_at_scene(scene, 1, size=32, seed=0)
    assert torch.equal(views.cameras.viewmats, usual.viewmats)


def test_the_seed_decides_the_views():
    scene = small_scene()
    first, again, other = (look_at_scene(scene, 2, size=32, seed=seed) for seed in (0, 0, 1))
    assert bits_of_views(first) == bits_of_views(again)
    assert not torch.equal(first.cameras.viewmats, other.cameras.viewmats)


def test_random_views_look_at_the_middle_from_around():
    scene = small_scene()
    frame = robust_frame(scene.means[scene.opacities > 0.1])
    cameras = random_views(scene, 60, size=100, seed=0)
    steps = (cameras.centers - frame.center.float()) / float(frame.radius)
    distances = torch.linalg.vector_norm(steps, dim=1)
    assert 1.1 <= float(distances.amin()) < 1.4
    assert 2.6 < float(distances.amax()) <= 3.0 + 1e-4
    assert float(steps.amin(dim=0).amax()) < -1
    assert float(steps.amax(dim=0).amin()) > 1
    forward = cameras.viewmats[:, 2, :3]
    # The target is within a quarter of a radius (a box of that side) around the middle.
    off = steps - (steps * forward).sum(dim=1, keepdim=True) * forward
    assert float(torch.linalg.vector_norm(off, dim=1).amax()) < 0.25
    assert bool(((steps * forward).sum(dim=1) < 0).all())
    assert cameras.Ks[0, 0, 0].item() == pytest.approx(50 / 0.46630766)


def test_a_faint_scene_can_be_looked_at_too():
    scene = small_scene(100)
    faint = scene.with_tensors({"logit_opacities": scene.logit_opacities * 0 - 5}, {})
    assert len(random_views(faint, 3, size=32, seed=0)) == 3


def test_how_far_away_random_views_are():
    scene = small_scene()
    frame = robust_frame(scene.means[scene.opacities > 0.1])
    cameras = random_views(scene, 60, size=100, seed=0, reach=(0.2, 1.4))
    steps = (cameras.centers - frame.center.float()) / float(frame.radius)
    distances = torch.linalg.vector_norm(steps, dim=1)
    assert 0.2 - 1e-4 <= float(distances.amin()) < 0.4
    assert 1.2 < float(distances.amax()) <= 1.4 + 1e-4
