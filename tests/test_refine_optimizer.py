"""The optimizer of refinements: as Adam where gradients agree, at rest where they do not."""

import pytest
import torch

from cvtgs.refine.optimizer import CarefulAdam

ROWS = torch.arange(2000)


def walked(gradients) -> torch.Tensor:
    """Take a step for each gradient, all rows at once; give where they end."""
    parameter = torch.zeros_like(gradients[0])
    adam = CarefulAdam(parameter)
    for gradient in gradients:
        adam.step(ROWS, gradient, rate=0.01)
    return parameter


def adam_walked(gradients, rate: float) -> torch.Tensor:
    parameter = torch.zeros_like(gradients[0], requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=rate, betas=(0.9, 0.99))
    for gradient in gradients:
        parameter.grad = gradient
        adam.step()
    return parameter.detach()


def noisy(signal: float) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [signal + torch.randn(len(ROWS), 3, generator=generator) for _ in range(100)]


def test_noise_moves_a_row_less_than_adam_does_when_both_get_as_far_with_a_signal():
    agreed = [torch.ones(len(ROWS), 3)] * 100
    ours = walked(agreed)
    rate = 0.01 * float(ours.mean() / adam_walked(agreed, 0.01).mean())
    theirs = adam_walked(agreed, rate)
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)
    wandered, drifted = walked(noisy(0.0)), adam_walked(noisy(0.0), rate)
    assert float(wandered.std()) < 0.25 * float(drifted.std())


def test_a_weak_signal_still_arrives():
    moved = walked(noisy(0.5))
    assert float(moved.mean()) < -4 * float(walked(noisy(0.0)).std())


def test_components_of_a_row_share_their_evidence():
    """Beside a component that agrees, one that hardly has a gradient is believed."""
    alone, together = torch.zeros(len(ROWS), 1), torch.zeros(len(ROWS), 2)
    first, second = CarefulAdam(alone), CarefulAdam(together)
    for noise in noisy(0.0):
        first.step(ROWS, 1e-3 * noise[:, :1], rate=0.01)
        second.step(ROWS, torch.cat([1e-3 * noise[:, :1], torch.ones(2000, 1)], 1), rate=0.01)
    assert float(together[:, 0].std()) > 3 * float(alone.std()) > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-44, 1e-30, 1e25, 3e38, 1e300])
def test_gradients_of_any_size_give_finite_steps(dtype, size):
    gradient = torch.full((1, 3), size, dtype=torch.float64).to(dtype)
    gradient = gradient.clamp_max(torch.finfo(dtype).max)
    parameter = torch.zeros(1, 3, dtype=dtype)
    adam = CarefulAdam(parameter)
    for sign in (1, -1, 1, 1):
        adam.step(torch.tensor([0]), sign * gradient, rate=0.01)
    assert bool(parameter.isfinite().all())
    assert float(parameter.abs().amax()) <= 0.04


def test_a_row_that_was_not_there_keeps_its_place_and_its_state():
    gradients = noisy(1.0)
    every = walked(gradients[:20])
    parameter = torch.zeros_like(gradients[0])
    adam = CarefulAdam(parameter)
    for gradient in gradients[:10]:
        adam.step(ROWS, gradient, rate=0.01)
    before = parameter.clone()
    some = ROWS[::2]
    for gradient in gradients[10:20]:
        adam.step(some, gradient[some], rate=0.01)
    assert torch.equal(parameter[1::2], before[1::2])
    torch.testing.assert_close(parameter[::2], every[::2])
