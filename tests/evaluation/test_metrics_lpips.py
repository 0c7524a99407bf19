"""LPIPS against a numpy implementation with random weights."""

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from cvtgs.evaluation import lpips
from lpips_cases import LAYERS, random_images, random_state, random_weights


def lpips_by_numpy(network: str, first: np.ndarray, second: np.ndarray) -> float:
    state = {name: tensor.double().numpy() for name, tensor in random_state(network).items()}
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    images = [((2 * image - 1 - shift) / scale).transpose(2, 0, 1) for image in (first, second)]
    total, tap = 0.0, 0
    for layer in LAYERS[network]:
        if layer == "tap":
            one, other = (image / (np.sqrt((image**2).sum(axis=0)) + 1e-10) for image in images)
            head = state[f"lin{tap}.weight"][0, :, 0, 0]
            total += float(np.tensordot(head, (one - other) ** 2, axes=1).mean())
            tap += 1
        elif len(layer) == 1:
            images = [
                sliding_window_view(image, (layer[0],) * 2, axis=(1, 2))[:, ::2, ::2].max((3, 4))
                for image in images
            ]
        else:
            index, _, _, side, stride, pad = layer
            weight, bias = state[f"features.{index}.weight"], state[f"features.{index}.bias"]
            padded = [np.pad(image, ((0, 0), (pad, pad), (pad, pad))) for image in images]
            windows = [
                sliding_window_view(image, (side, side), axis=(1, 2))[:, ::stride, ::stride]
                for image in padded
            ]
            images = [
                np.maximum(
                    np.tensordot(weight, w, axes=((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0
                )
                for w in windows
            ]
    return total


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "size"),
    [("alex", (31, 31)), ("alex", (50, 37)), ("vgg", (16, 16)), ("vgg", (19, 34))],
)
def test_lpips_equals_that_by_numpy(network, size) -> None:
    first, second = random_images(*size)
    wanted = lpips_by_numpy(network, first[0].numpy(), second[0].numpy())
    weights = random_weights(network)
    found = lpips(first, second, network=network, weights=weights)
    assert found.dtype == torch.float64
    assert found.item() == pytest.approx(wanted, rel=1e-12)
    single = lpips(first.float(), second.float(), network=network, weights=weights)
    assert single.dtype == torch.float32
    assert single.item() == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_lpips_is_0_for_equal_images_symmetric_and_grows_with_noise(network) -> None:
    side = {"alex": 31, "vgg": 16}[network]
    first, noise = (images.float() for images in random_images(side, side, count=2))
    weights = random_weights(network)
    assert lpips(first, first, network=network, weights=weights).tolist() == [0.0, 0.0]
    values = []
    for share in (0.05, 0.2, 0.8):
        mixed = (1 - share) * first + share * noise
        value = lpips(first, mixed, network=network, weights=weights)
        torch.testing.assert_close(value, lpips(mixed, first, network=network, weights=weights))
        values.append(value)
    assert (values[0] < values[1]).all()
    assert (values[1] < values[2]).all()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_cuda_gives_the_same_values(network) -> None:
    first, second = (images.float() for images in random_images(50, 37))
    weights = random_weights(network)
    wanted = lpips(first, second, network=network, weights=weights)
    found = lpips(first.cuda(), second.cuda(), network=network, weights=weights)
    assert found.is_cuda
    torch.testing.assert_close(found.cpu(), wanted, rtol=1e-2, atol=1e-4)  # TF32 convolutions


def test_images_are_clipped_but_not_mutated() -> None:
    first, second = random_images(31, 31)
    wide = second.clone().round() * 2 - 0.5
    copy = wide.clone()
    weights = random_weights("alex")
    found = lpips(first, wide, network="alex", weights=weights)
    assert torch.equal(wide, copy)
    assert torch.equal(found, lpips(first, second.round(), network="alex", weights=weights))


def test_lpips_has_no_gradient() -> None:
    first, second = random_images(31, 31)
    first.requires_grad_()
    assert not lpips(first, second, network="alex", weights=random_weights("alex")).requires_grad
