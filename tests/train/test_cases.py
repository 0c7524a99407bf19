"""Cases: contents for a scene at a ratio, corrections by a network, and target images."""

import pytest
import torch

from camera_files import transforms, write_json
from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.math.frames import robust_frame
from cvtgs.mergenet import correct_cells
from cvtgs.rendering import render
from cvtgs.train.cases import make_case, merge_scene, render_targets
from cvtgs.views import automatic_views, mixed_views, random_views
from mergenet_cases import fields_of, lively_net
from scenes import random_scene, same_bits
from train_cases import (
    bits,
    bits_of_case,
    bits_of_views,
    small_net,
    small_scene,
    some_case,
)


def test_a_case_is_the_reference_and_its_cells_of_several_members():
    scene, config = random_scene(200), SimplifyConfig()
    case = make_case("box", scene, 0.31, config)
    reference = merge_scene(scene, 62, config)
    counts = reference.partition.counts
    assert case.name == "box at 0.31"
    assert len(case.reference.merged) == 62
    assert same_bits(case.reference.merged, reference.merged)
    assert case.cells.tolist() == [cell for cell in range(62) if counts[cell] > 1]
    assert case.part.counts.tolist() == counts[case.cells].tolist()
    assert len(case.descriptors) == len(case.cells) < 62


def test_scenes_with_nothing_to_learn_give_no_case():
    scene, config = random_scene(20), SimplifyConfig()
    assert make_case("box", scene, 0.99, config) is None
    assert make_case("box", scene.select(torch.tensor([0])), 0.5, config) is None
    assert make_case("box", scene.select(torch.zeros(0, dtype=torch.int64)), 0.5, config) is None


def test_scenes_with_only_cells_of_one_give_no_case():
    """The faint half is filtered, and the number of the rest is the target."""
    scene = random_scene(40)
    logits = torch.where(torch.arange(40) < 20, 3.0, -9.0)
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    config = SimplifyConfig.from_mapping({"filter": {"max_mass_share": 1.0}})
    assert make_case("box", scene, 0.5, config) is None


def test_an_untrained_network_changes_no_bit():
    case = some_case()
    with torch.no_grad():
        residuals = small_net()(case.descriptors)
    assert same_bits(case.correct_scene(residuals), case.reference.merged)
    before = case.reference.merged.select(case.cells).tensors()
    for name, values in case.correct_cells(residuals).items():
        assert bits(values) == bits(before[name])


def test_corrections_equal_those_of_the_simplifier():
    case, net = some_case(), lively_net(torch.float32)
    reference = case.reference
    with torch.no_grad():
        corrected = case.correct_scene(net(case.descriptors))
    wanted = correct_cells(
        net,
        reference.scene,
        reference.merged,
        reference.partition,
        neighbors=reference.neighbors,
        visibility=reference.visibility,
        pixel_size=reference.radius / 400,
    )
    for name, values in wanted.tensors().items():
        torch.testing.assert_close(getattr(corrected, name), values, rtol=1e-5, atol=1e-5)
    assert float((corrected.log_scales - reference.merged.log_scales).abs().amax()) > 0.1


def test_a_subset_of_cells_gets_the_same_descriptors():
    case, net = some_case(), lively_net(torch.float32)
    rows = torch.tensor([0, 3, 4, 11])
    some = case.select(rows)
    assert some.cells.tolist() == case.cells[rows].tolist()
    assert some.name == case.name
    every, few = net(case.descriptors), net(some.descriptors)
    for name in ("d_means", "d_log_scales", "d_rotvecs", "d_logit_opacities", "pair_colors"):
        torch.testing.assert_close(getattr(few, name), getattr(every, name)[rows])
    changed = case.correct_cells(every)
    for name, values in some.correct_cells(few).items():
        torch.testing.assert_close(values, changed[name][rows])


def test_an_empty_subset_of_cells_can_be_selected():
    some = some_case().select(torch.zeros(0, dtype=torch.int64))
    assert len(some.cells) == len(some.part) == len(some.descriptors) == 0


def test_gradients_flow_through_every_cell():
    case, net = some_case(), lively_net(torch.float32)
    residuals = net(case.descriptors)
    for values in fields_of(residuals).values():
        values.retain_grad()
    corrected = case.correct_scene(residuals)
    sum(values.sin().sum() for values in corrected.tensors().values()).backward()
    for values in fields_of(residuals).values():
        rows = values.grad.reshape(len(values), -1)
        assert bool(rows.isfinite().all())
        assert bool((rows != 0).any(dim=1).all())
    assert all(bool(values.grad.isfinite().all()) for values in net.parameters())


def test_moving_to_the_same_device_is_a_no_op():
    case = some_case()
    assert case.to(torch.device("cpu")) is case


def test_moving_moves_every_tensor():
    """``meta`` stands for another device: it has shapes and no values."""
    moved = some_case().to(torch.device("meta"))
    reference, seen = moved.reference, moved.descriptors
    tensors = [moved.cells, reference.neighbors]
    tensors += [reference.visibility, reference.partition.order, reference.partition.offsets]
    tensors += [*reference.scene.tensors().values(), *reference.merged.tensors().values()]
    tensors += [getattr(seen, name) for name in type(seen).__slots__]
    assert {tensor.device.type for tensor in tensors} == {"meta"}


def test_the_same_scene_gives_the_same_bits():
    scene = small_scene(300)
    first, again = (make_case("one", scene, 0.1, SimplifyConfig()) for _ in range(2))
    assert bits_of_case(first) == bits_of_case(again)


def numbered_views(size: int = 8) -> ViewImages:
    """One image whose red encodes the column and whose green encodes the row."""
    steps = torch.arange(size, dtype=torch.float16)
    rgb = torch.zeros(1, size, size, 3, dtype=torch.float16)
    rgb[..., 0], rgb[..., 1] = steps, steps[:, None]
    intrinsics = torch.tensor([[[10.0, 0, size / 2], [0, 10.0, size / 2], [0, 0, 1]]])
    cameras = Cameras(viewmats=torch.eye(4)[None], Ks=intrinsics, width=size, height=size)
    return ViewImages(cameras=cameras, rgb=rgb, alpha=rgb[..., 0] / 10)


def test_images_over_a_background():
    views = numbered_views()
    image = views.over(torch.tensor([1.0, 0.5, 0.0]))[0]
    assert image.dtype == torch.float32
    assert image[2, 5].tolist() == pytest.approx([5 + 0.5, 2 + 0.25, 0.0], abs=1e-3)
    assert image[0, 0].tolist() == [1.0, 0.5, 0.0]


@pytest.mark.slow
def test_one_image_keeps_its_camera():
    scene = small_scene()
    views = render_targets(scene, 3, size=32, seed=2)
    one = views.select(1)
    assert torch.equal(one.rgb[0], views.rgb[1])
    assert torch.equal(one.alpha[0], views.alpha[1])
    assert torch.equal(one.cameras.viewmats[0], views.cameras.viewmats[1])
    assert len(one.cameras) == 1


@pytest.mark.slow
def test_views_are_mixed_ones():
    scene = small_scene()
    views = render_targets(scene, 5, size=32, seed=2)
    mixed = mixed_views(scene, 5, size=32, seed=2, sharp=False)
    assert torch.equal(views.cameras.viewmats, mixed.viewmats)
    assert torch.equal(views.cameras.Ks, mixed.Ks)
    assert views.rgb.shape == (5, 32, 32, 3)
    assert views.rgb.dtype == views.alpha.dtype == torch.float16
    images = render(scene, views.cameras)
    torch.testing.assert_close(views.rgb.float(), images.rgb, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(views.alpha.float(), images.alpha, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_one_view_is_an_automatic_one():
    scene = small_scene()
    usual = automatic_views(scene, 1, width=32, height=32, seed=0)
    views = render_targets(scene, 1, size=32, seed=0)
    assert torch.equal(views.cameras.viewmats, usual.viewmats)


@pytest.mark.slow
def test_the_seed_decides_the_views():
    scene = small_scene()
    first, again, other = (render_targets(scene, 2, size=32, seed=seed) for seed in (0, 0, 1))
    assert bits_of_views(first) == bits_of_views(again)
    assert not torch.equal(first.cameras.viewmats, other.cameras.viewmats)


@pytest.mark.slow
def test_random_views_look_at_the_middle_from_around():
    scene = small_scene()
    frame = robust_frame(scene.means[scene.opacities > 0.1])
    cameras = random_views(scene, 60, size=100, seed=0)
    steps = (cameras.centers - frame.center.float()) / float(frame.radius)
    distances = torch.linalg.vector_norm(steps, dim=1)
    shift = 0.05 * 3**0.5 + 1e-4  # positions are moved by up to this
    assert 1.1 - shift <= float(distances.amin()) < 1.4
    assert 2.6 < float(distances.amax()) <= 3.0 + shift
    assert float(steps.amin(dim=0).amax()) < -1
    around = sorted(steps.amax(dim=0).tolist())
    assert around[1] > 1  # the views do not look from under the ground
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


@pytest.mark.slow
def test_distances_of_random_views():
    scene = small_scene()
    frame = robust_frame(scene.means[scene.opacities > 0.1])
    cameras = random_views(scene, 60, size=100, seed=0, reach=(0.2, 1.4))
    steps = (cameras.centers - frame.center.float()) / float(frame.radius)
    distances = torch.linalg.vector_norm(steps, dim=1)
    assert 0.2 - 1e-4 <= float(distances.amin()) < 0.5
    assert 1.2 < float(distances.amax()) < 1.5  # some are raised above the ground


def test_cameras_that_see_nothing_do_not_validate(tmp_path):
    """All gains would be zero, and the untrained network the best."""
    scene, file = small_scene(100), tmp_path / "exam.transforms.json"
    write_json(file, transforms())
    away = scene.with_tensors({"means": scene.means + 1e5}, {})
    with pytest.raises(InvalidArgumentError, match=r"the cameras must see the scene beside .*exam"):
        render_targets(away, 2, size=32, seed=0, file=file)
