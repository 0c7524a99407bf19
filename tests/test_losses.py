"""Losses between images."""

import math
import os
import subprocess
import sys

import pytest
import torch
from kornia.metrics import ssim

from cvtgs.errors import InvalidArgumentError
from cvtgs.losses import (
    gradient_loss,
    image_loss,
    l1_loss,
    mean_ssim,
    relative_loss,
    ssim_loss,
)

LOSSES = [l1_loss, ssim_loss, gradient_loss, image_loss]


def pair(height: int = 12, width: int = 13, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    shape = (count, height, width, 3)
    first = torch.rand(shape, generator=g, dtype=torch.float64)
    return first, torch.rand(shape, generator=g, dtype=torch.float64)


def from_rows(rows: list[list[float]]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)[None, :, :, None].expand(1, -1, -1, 3)


def test_l1_by_hand() -> None:
    loss = l1_loss(from_rows([[0.0, 1.0], [0.5, 0.0]]), from_rows([[0.5, 0.0], [0.5, 0.25]]))
    assert loss.item() == (0.5 + 1.0 + 0.0 + 0.25) / 4


def test_gradient_by_hand() -> None:
    difference = from_rows([[0.0, 1.0, 1.0], [2.0, 0.0, 1.0]])
    loss = gradient_loss(difference + 0.25, torch.full_like(difference, 0.25))
    dx = (1 + 0 + 2 + 1) / 4
    dy = (2 + 1 + 0) / 3
    assert loss.item() == pytest.approx(dx + dy, rel=1e-15)


def test_the_gradient_loss_ignores_an_offset() -> None:
    first, _ = pair()
    assert gradient_loss(first, first + 0.125).item() == pytest.approx(0.0, abs=1e-15)


def test_ssim_of_flat_images_by_hand() -> None:
    """Without variance only the luminance term is left."""
    first, second = 0.5, 0.25
    luminance = (2 * first * second + 1e-4) / (first**2 + second**2 + 1e-4)
    flat = torch.ones(1, 11, 14, 3, dtype=torch.float64)
    assert ssim_loss(first * flat, second * flat).item() == pytest.approx(1 - luminance, abs=1e-12)


def test_ssim_of_one_bright_pixel_by_hand() -> None:
    """In the only window one pixel, the centre, is bright: its weight gives the moments."""
    taps = [math.exp(-0.5 * (i / 1.5) ** 2) for i in range(-5, 6)]
    weight = (1 / sum(taps)) ** 2
    image = torch.zeros(1, 11, 11, 3, dtype=torch.float64)
    image[:, 5, 5] = 1.0
    mean, variance = weight, weight - weight**2
    similarity = (1e-4 / (mean**2 + 1e-4)) * (9e-4 / (variance + 9e-4))
    loss = ssim_loss(image, torch.zeros_like(image)).item()
    assert loss == pytest.approx(1 - similarity, abs=1e-12)


def test_image_loss_is_the_sum_of_its_terms() -> None:
    first, second = pair(count=2)
    wanted = (
        0.7 * l1_loss(first, second)
        + 0.3 * ssim_loss(first, second)
        + 0.5 * gradient_loss(first, second)
    )
    loss = image_loss(first, second, ssim_weight=0.3, gradient_weight=0.5)
    torch.testing.assert_close(loss, wanted)
    default = 0.8 * l1_loss(first, second) + 0.2 * ssim_loss(first, second)
    default = default + 0.2 * gradient_loss(first, second)
    torch.testing.assert_close(image_loss(first, second), default)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("loss", LOSSES)
def test_losses_are_scalars_that_are_zero_for_equal_images(loss, dtype) -> None:
    first, second = (images.to(dtype) for images in pair(count=3))
    value = loss(first, second)
    assert value.shape == ()
    assert value.dtype == dtype
    assert value.item() > 0.05
    assert abs(loss(first, first).item()) < 1e-6


def test_ssim_and_its_gradient_are_those_of_kornia() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(2, 17, 23, 3, generator=generator, dtype=torch.float64)
    image = target + 0.2 * torch.randn(target.shape, generator=generator, dtype=torch.float64)
    image.requires_grad_()
    ours = mean_ssim(image, target)
    channels_first = (images.permute(0, 3, 1, 2) for images in (image, target))
    theirs = ssim(*channels_first, 11, max_val=1.0, eps=0.0, padding="valid").mean(dim=(1, 2, 3))
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)
    gradients = [torch.autograd.grad(values.sum(), image)[0] for values in (ours, theirs)]
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (10, 40)])
def test_images_smaller_than_the_window_are_refused_by_ssim(size) -> None:
    first, second = pair(*size)
    assert l1_loss(first, second).item() > 0
    assert gradient_loss(first, second).item() >= 0
    without = image_loss(first, second, ssim_weight=0.0)
    torch.testing.assert_close(without, l1_loss(first, second) + 0.2 * gradient_loss(first, second))
    for loss in (ssim_loss, image_loss):
        with pytest.raises(InvalidArgumentError) as error:
            loss(first, second)
        assert str(error.value) == (
            "there must be images of at least 11 x 11 pixels, found 1 image of "
            f"{size[1]} x {size[0]}."
        )


def test_the_gradient_of_one_column_has_no_x_part() -> None:
    first, second = pair(5, 1)
    wanted = (first - second).diff(dim=1).abs().mean()
    torch.testing.assert_close(gradient_loss(first, second), wanted)


def test_the_images_are_not_changed() -> None:
    first, second = pair()
    copies = first.clone(), second.clone()
    image_loss(first, second)
    assert torch.equal(first, copies[0])
    assert torch.equal(second, copies[1])


ZEROS = torch.zeros(1, 12, 12, 3)
WRONG = {
    "not floats": (
        (ZEROS.int(), ZEROS),
        "the first stack of images must be a tensor of floats of shape (c, h, w, 3), "
        "found torch.int32 of shape (1, 12, 12, 3).",
    ),
    "not a tensor": (
        ([0.0], ZEROS),
        "the first stack of images must be a tensor of floats of shape (c, h, w, 3), found list.",
    ),
    "one image": (
        (ZEROS[0], ZEROS[0]),
        "the first stack of images must be a tensor of floats of shape (c, h, w, 3), "
        "found torch.float32 of shape (12, 12, 3).",
    ),
    "channels first": (
        (ZEROS, ZEROS.permute(0, 3, 1, 2)),
        "the second one must be a tensor of floats of shape (1, 12, 12, 3), "
        "found torch.float32 of shape (1, 3, 12, 12).",
    ),
    "two shapes": (
        (ZEROS, ZEROS[:, :11]),
        "the second one must be a tensor of floats of shape (1, 12, 12, 3), "
        "found torch.float32 of shape (1, 11, 12, 3).",
    ),
    "two dtypes": (
        (ZEROS, ZEROS.double()),
        "both stacks of images must share dtype and device, "
        "found torch.float32 on cpu and torch.float64 on cpu.",
    ),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("loss", [*LOSSES, relative_loss])
def test_error_texts(loss, case) -> None:
    images, text = WRONG[case]
    with pytest.raises(InvalidArgumentError) as error:
        loss(*images)
    assert str(error.value) == text


@pytest.mark.parametrize("loss", [*LOSSES, relative_loss])
def test_no_images_are_refused(loss) -> None:
    with pytest.raises(InvalidArgumentError, match=r"there must be .*, found 0 images of 12 x 12"):
        loss(ZEROS[:0], ZEROS[:0])


def test_weights_out_of_range_are_refused() -> None:
    for weight in (-0.1, 1.5, math.nan, "a", None):
        with pytest.raises(InvalidArgumentError, match="ssim_weight must be from 0 to 1, found"):
            image_loss(ZEROS, ZEROS, ssim_weight=weight)
    for weight in (-0.1, math.inf, math.nan, "a", None):
        with pytest.raises(InvalidArgumentError, match="gradient_weight must be a finite number"):
            image_loss(ZEROS, ZEROS, gradient_weight=weight)
        for name in ("mse_weight", "image_weight", "ssim_weight"):
            with pytest.raises(InvalidArgumentError, match=f"{name} must be a finite number"):
                relative_loss(ZEROS, ZEROS, **{name: weight})


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_match_finite_differences(loss) -> None:
    first, second = (images.requires_grad_() for images in pair(11, 12))
    assert torch.autograd.gradcheck(loss, (first, second), fast_mode=True)


def test_the_relative_loss_by_hand() -> None:
    target = torch.full((1, 12, 12, 3), 0.4, dtype=torch.float64)
    squared = relative_loss(target + 0.1, target, mse_weight=0.5, image_weight=0.0)
    assert squared.item() == pytest.approx(0.5 * math.log(0.01 + 1e-5))
    both = relative_loss(target + 0.1, target, mse_weight=0.5, image_weight=2.0)
    image = 2.0 * math.log(image_loss(target + 0.1, target).item() + 1e-3)
    assert both.item() == pytest.approx(squared.item() + image)
    whole = relative_loss(target + 0.1, target, image_weight=0.0, ssim_weight=0.3)
    structure = 0.3 * math.log(ssim_loss(target + 0.1, target).item() + 1e-3)
    assert whole.item() == pytest.approx(squared.item() + structure)
    nothing = relative_loss(target + 0.1, target, mse_weight=0.0, image_weight=0.0)
    assert nothing.item() == 0


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("loss", LOSSES)
def test_cuda_gives_the_same_values_and_gradients(loss) -> None:
    first, second = (images.float() for images in pair(30, 41))
    values, gradients = [], []
    for device in ("cpu", "cuda"):
        prediction = first.to(device).requires_grad_()
        value = loss(prediction, second.to(device))
        (gradient,) = torch.autograd.grad(value, prediction)
        values.append(value.detach().cpu())
        gradients.append(gradient.cpu())
    torch.testing.assert_close(values[1], values[0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_importing_losses_is_light() -> None:
    program = (
        "import sys, cvtgs, cvtgs.losses, cvtgs.evaluation, cvtgs.io\n"
        "print(sorted({'kornia', 'scipy', 'lpips', 'torchvision'} & set(sys.modules)))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert result.stdout == "[]\n"


def test_a_weight_of_0_leaves_a_term_out() -> None:
    first, second = torch.rand(1, 12, 13, 3), torch.rand(1, 12, 13, 3)
    loss = image_loss(first, second, ssim_weight=0.0, gradient_weight=0.0)
    assert float(loss) == float(l1_loss(first, second))


@pytest.mark.parametrize("loss", [*LOSSES, relative_loss])
def test_autocast_does_not_change_losses(loss) -> None:
    """In bfloat16, the variances of SSIM would be differences of rounded means."""
    target = pair(16, 16)[0].float()
    prediction = (0.97 * target).requires_grad_()
    wanted = loss(prediction, target)
    (slope,) = torch.autograd.grad(wanted, prediction)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = loss(prediction, target)
    assert found.dtype == torch.float32
    assert torch.equal(found, wanted)
    assert torch.equal(torch.autograd.grad(found, prediction)[0], slope)


@pytest.mark.parametrize("bright", [0.9, 1.0])
@pytest.mark.parametrize("dark", [0.1, 0.9])
def test_ssim_of_even_images_is_no_rounding_error(bright, dark):
    """Variances are differences of squares, 0.8 here, beside a constant of 0.0009."""
    one = torch.full((1, 32, 32, 3), bright)
    one[:, :16] = dark
    found, exact = (float(mean_ssim(image, image - 1e-3)) for image in (one, one.double()))
    assert found == pytest.approx(exact, abs=1e-4 if dark != bright else 2e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("loss", [*LOSSES, relative_loss])
def test_losses_of_16_bit_images_are_those_of_32_bits(loss, dtype) -> None:
    """In float16, a sum over an image overflows, and a product of two small numbers is 0."""
    stripes = (torch.arange(160) % 2).to(dtype)[None, None, :, None].expand(1, 160, 160, 3)
    black = torch.zeros_like(stripes)
    for first, second in ((stripes, black), (black, black), (black + 0.02, black)):
        prediction, wide = (
            first.detach().to(kind, copy=True).requires_grad_() for kind in (dtype, torch.float32)
        )
        found, wanted = loss(prediction, second), loss(wide, second.float())
        assert found.dtype == torch.float32
        assert torch.equal(found, wanted)
        found.backward()
        wanted.backward()
        assert torch.equal(prediction.grad, wide.grad.to(dtype))
