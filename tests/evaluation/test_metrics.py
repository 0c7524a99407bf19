"""PSNR, SSIM and alpha error against hand-computed values and scipy."""

import math
from collections.abc import Iterator
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import (
    EvaluationSettings,
    Score,
    alpha_bias,
    alpha_error,
    compare,
    evaluate,
    psnr,
    ssim,
)
from cvtgs.evaluation.blind_views import check_seen
from cvtgs.losses import ssim_loss
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views
from scenes import random_scene


def noisy_pair(size: tuple[int, int], noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]]
    waves = [0.5 + 0.4 * np.sin(x / (3 + k) + y / (5 - k)) for k in range(3)]
    image = np.stack(waves, axis=-1)
    return image, np.clip(image + noise * rng.standard_normal(image.shape), 0, 1)


def ssim_by_scipy(first: np.ndarray, second: np.ndarray) -> float:
    """SSIM of Wang et al. 2004 with scipy's filters, over windows inside the image only."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def mean(image: np.ndarray) -> np.ndarray:
        rows = correlate1d(image, taps, axis=0, mode="constant")
        return correlate1d(rows, taps, axis=1, mode="constant")[5:-5, 5:-5]

    values = []
    for channel in range(3):
        x, y = first[..., channel], second[..., channel]
        mx, my = mean(x), mean(y)
        vx, vy, vxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
        top = (2 * mx * my + 0.01**2) * (2 * vxy + 0.03**2)
        values.append(top / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2)))
    return float(np.mean(values))


def test_psnr_equals_that_by_hand() -> None:
    first = torch.zeros(2, 5, 4, 3, dtype=torch.float64)
    second = torch.stack([first[0] + 0.1, first[1] + 1.0])
    torch.testing.assert_close(psnr(first, second), torch.tensor([20.0, 0.0]).double())
    one_value = first.clone()
    one_value[0, 2, 1, 0] = 0.5
    assert psnr(first, one_value)[0].item() == pytest.approx(10 * math.log10(60 / 0.25))


def test_psnr_of_equal_images_is_infinite() -> None:
    image = torch.rand(2, 3, 3, 3, generator=torch.Generator().manual_seed(0))
    assert psnr(image, image).tolist() == [math.inf, math.inf]


def test_images_are_clipped() -> None:
    first, second = (torch.from_numpy(image)[None] for image in noisy_pair((16, 18), 0.2))
    beyond = torch.where(second >= 1, second + 3, torch.where(second <= 0, second - 2, second))
    assert not torch.equal(beyond, second)
    for metric in (psnr, ssim):
        assert torch.equal(metric(first, second), metric(first, beyond))


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("size", [(11, 11), (12, 30), (41, 37)])
def test_ssim_equals_that_by_scipy(size, noise) -> None:
    first, second = noisy_pair(size, noise)
    wanted = ssim_by_scipy(first, second)
    images = [torch.from_numpy(image)[None] for image in (first, second)]
    assert ssim(*images).item() == pytest.approx(wanted, abs=1e-12)
    assert ssim(*[image.float() for image in images]).item() == pytest.approx(wanted, abs=1e-5)


def test_ssim_of_nearly_equal_flat_images_is_1_in_float32() -> None:
    first = torch.full((1, 40, 40, 3), 0.9)
    assert ssim(first, first + 1e-3).item() == pytest.approx(1.0, abs=1e-4)


def test_each_image_is_scored_by_itself() -> None:
    pairs = [noisy_pair((20, 14), noise, seed) for seed, noise in enumerate((0.05, 0.2, 0.4))]
    first, second = (
        torch.from_numpy(np.stack(images)).float() for images in zip(*pairs, strict=True)
    )
    for metric in (psnr, ssim):
        values = metric(first, second)
        assert values.shape == (3,)
        assert values.dtype == torch.float32
        assert values.tolist() == sorted(values.tolist(), reverse=True)
        for row in range(3):
            alone = metric(first[row, None], second[row, None])
            torch.testing.assert_close(alone[0], values[row])


def test_the_loss_is_one_minus_the_metric() -> None:
    first, second = (torch.from_numpy(image)[None] for image in noisy_pair((20, 14), 0.1))
    torch.testing.assert_close(1 - ssim_loss(first, second), ssim(first, second)[0])


def test_metrics_have_no_gradient() -> None:
    image = torch.full((1, 12, 12, 3), 0.5, requires_grad=True)
    for metric in (psnr, ssim):
        assert not metric(image, image * 0.9).requires_grad


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_gives_the_same_values() -> None:
    first, second = (torch.from_numpy(image)[None].float() for image in noisy_pair((41, 37), 0.1))
    for metric in (psnr, ssim):
        found = metric(first.cuda(), second.cuda())
        assert found.is_cuda
        torch.testing.assert_close(found.cpu(), metric(first, second), rtol=1e-5, atol=1e-5)


def test_images_that_do_not_fit_are_refused() -> None:
    image = torch.zeros(1, 10, 12, 3)
    with pytest.raises(InvalidArgumentError) as error:
        ssim(image, image)
    assert (
        str(error.value)
        == "there must be images of at least 11 x 11 pixels, found 1 image of 12 x 10."
    )
    with pytest.raises(InvalidArgumentError, match=r"must be .* of shape \(1, 10, 12, 3\), found"):
        psnr(image, image[:, :5])


def test_alpha_error_and_bias_equal_those_by_hand() -> None:
    small = torch.tensor([[[0.5, 1.0], [0.0, 0.25]], [[1.0, 1.0], [1.0, 1.0]]])
    full = torch.tensor([[[1.0, 0.75], [0.0, 0.75]], [[1.0, 1.0], [1.0, 0.0]]])
    assert alpha_error(small, full).tolist() == [1.25 / 4, 1 / 4]
    assert alpha_bias(small, full).tolist() == [-0.75 / 4, 1 / 4]
    holes = (alpha_error(small, full) - alpha_bias(small, full)) / 2
    assert holes.tolist() == [1 / 4, 0]
    assert alpha_error(full + 1e-6, full)[1].item() < 1e-6  # clipped at 1


def test_alpha_that_does_not_fit_is_refused() -> None:
    alpha = torch.zeros(1, 2, 3)
    with pytest.raises(
        InvalidArgumentError, match=r"of floats of shape \(c, h, w\), found NoneType"
    ):
        alpha_error(None, alpha)
    with pytest.raises(InvalidArgumentError, match="must share dtype and device"):
        alpha_error(alpha, alpha.double())
    with pytest.raises(InvalidArgumentError, match=r"of shape \(1, 2, 3\), found .* \(1, 3, 2\)"):
        alpha_error(alpha, torch.zeros(1, 3, 2))
    with pytest.raises(InvalidArgumentError, match=r"floats of shape \(c, h, w\), found"):
        alpha_bias(alpha[0], alpha[0])


def test_autocast_does_not_change_scores():
    scene = random_scene(30)
    cameras, settings = automatic_views(scene, 1, width=32, height=32), EvaluationSettings()
    wanted = evaluate(scene, {"some": scene[:9]}, cameras, settings=settings)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert evaluate(scene, {"some": scene[:9]}, cameras, settings=settings) == wanted


def test_names_of_scenes_are_texts():
    scene = random_scene(3)
    cameras = automatic_views(scene, 1, width=32, height=32)
    with pytest.raises(InvalidArgumentError, match="names of scenes must be texts, found 1"):
        evaluate(scene, {1: scene}, cameras)
    with pytest.raises(InvalidArgumentError, match=r"texts that files can hold .*found 'a.udcff'"):
        evaluate(scene, {"a\udcff": scene}, cameras)
    with pytest.raises(InvalidArgumentError, match="names of scenes must be texts, found None"):
        evaluate(scene, {"a": scene}, cameras, reference_name=None)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"settings": {}}, "settings must be of type EvaluationSettings, found dict."),
        ({"listener": 5}, "listener must be a function of a progress event, found 5."),
        ({"sizes": {"b": 1}}, "sizes must be those of full, a; found one of 'b'."),
    ],
)
def test_options_that_do_not_fit_are_refused(options, text):
    scene = random_scene(30)
    cameras = automatic_views(scene, 1, width=32, height=32)
    with pytest.raises(InvalidArgumentError) as caught:
        compare(scene, {"a": scene}, cameras, **options)
    assert str(caught.value) == text
    with pytest.raises(InvalidArgumentError, match="backend must be one of auto, torch"):
        EvaluationSettings(backend="x")


def test_a_score_of_no_views_is_refused():
    with pytest.raises(InvalidArgumentError, match="at least one view, found none"):
        Score.of([])


def test_gaussians_that_no_renderer_draws_are_not_seen() -> None:
    """The camera looks at a Gaussian of opacity 0.001; the other one is behind it."""
    tensors = {
        "means": torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]]),
        "logit_opacities": torch.tensor([0.001, 0.9]).logit(),
    }
    scene = random_scene(2).with_tensors(tensors)
    intrinsics = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]])
    camera = Cameras(viewmats=torch.eye(4)[None], Ks=intrinsics, width=16, height=16)
    with pytest.raises(InvalidArgumentError, match="the cameras must see it, found nothing"):
        check_seen(scene, camera, name="it")
    check_seen(scene.select([0]), camera, name="it")  # if nothing is drawn, all centres count


@pytest.mark.parametrize("blind", [0, 1, 2])
def test_cameras_most_of_which_see_nothing_are_a_warning(blind: int) -> None:
    intrinsics = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]]).expand(3, 3, 3)
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:blind, 0, 3] = 1e4
    cameras = Cameras(viewmats=poses, Ks=intrinsics, width=16, height=16)
    scene = random_scene(20).with_tensors(means=torch.tensor([[0.0, 0.0, 3.0]]).repeat(20, 1))
    expected = pytest.warns(UserWarning, match=r"^2 of 3 cameras see nothing of it; give cameras")
    with expected if blind == 2 else nullcontext():
        check_seen(scene, cameras, name="it")
    check_seen(scene, cameras, name="it", parts=[])


def test_parts_are_read_until_enough_cameras_see_a_gaussian() -> None:
    """The second camera looks away from the sample, at the second part."""
    intrinsics = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]]).expand(2, 3, 3)
    poses = torch.stack([torch.eye(4), torch.diag(torch.tensor([-1.0, 1, -1, 1]))])
    cameras = Cameras(viewmats=poses, Ks=intrinsics, width=16, height=16)
    front = random_scene(9).with_tensors(means=torch.tensor([[0.0, 0, 9]]).repeat(9, 1))
    back = front.with_tensors(means=-front.means)
    read = []

    def parts(*scenes: GaussianScene) -> Iterator[GaussianScene]:
        for scene in scenes:
            read.append(scene)
            yield scene

    def check(views: Cameras, *scenes: GaussianScene, refines: bool = True) -> None:
        check_seen(front, views, name="it", parts=parts(*scenes), refines=refines)

    check(cameras, front, back, front)
    assert read == [front, back]
    check(cameras, back, refines=False)
    assert read == [front, back]
    with pytest.raises(InvalidArgumentError, match=r"2 cameras that see it, .* found 1 of 2"):
        check(cameras, front)
    check(cameras.select([1]), front, back, front, refines=False)
    assert read == [front, back, front, front, back]
    with pytest.raises(InvalidArgumentError, match="must see it, found nothing of it in any of 1"):
        check(cameras.select([1]), front, refines=False)


def test_cameras_that_see_a_few_gaussians_of_many_are_not_blind() -> None:
    """Every second of them is sampled; one of the others is small, faint and in sight."""
    means = torch.tensor([0.0, 0.0, -3.0]).repeat(8192, 1)
    means[1, 2] = 3.0
    scales, faint = torch.full((8192, 3), -9.0), torch.full((8192,), -4.0)
    scene = random_scene(8192).with_tensors(means=means, log_scales=scales, logit_opacities=faint)
    intrinsics = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]]).expand(3, 3, 3)
    poses = torch.eye(4).repeat(3, 1, 1)
    check_seen(scene, Cameras(viewmats=poses, Ks=intrinsics, width=16, height=16), name="it")


def test_a_scene_nearer_than_the_near_plane_is_not_seen() -> None:
    scene = random_scene(20)
    scene = scene.with_tensors(means=scene.means * 1e-4 + torch.tensor([0.0, 0.0, 0.005]))
    intrinsics = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]])
    camera = Cameras(viewmats=torch.eye(4)[None], Ks=intrinsics, width=16, height=16)
    text = "the cameras must see it, found nothing"
    with pytest.warns(match="lack 100%"), pytest.raises(InvalidArgumentError, match=text):
        check_seen(scene, camera, name="it")


def test_alpha_is_clipped_before_it_is_compared() -> None:
    one, other = torch.tensor([[[1.5, -0.5, 0.25]]]), torch.tensor([[[1.0, 0.0, 0.5]]])
    assert alpha_error(one, other).item() == alpha_error(other, one).item() == pytest.approx(1 / 12)
    assert alpha_bias(one, other).item() == pytest.approx(-1 / 12)
    assert alpha_bias(other, one).item() == pytest.approx(1 / 12)
