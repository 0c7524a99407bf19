"""Adam for a few rows at a time, which moves only as far as pictures agree."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.math.activations import divide

_DECAYS = (0.9, 0.99)
_LEAST_ROOT = 1e-15


class CarefulAdam:
    """Adam (Kingma and Ba 2015) whose steps shrink where gradients contradict one another.

    Each picture gives another gradient, and Adam's steps are as long for a parameter whose
    gradients all agree as for one whose gradients only have noise, which then wanders off. Here
    a step is multiplied by ``2 g``, where ``g = |m|^2 / (|m|^2 + |v|)`` compares the running mean m
    of the gradients of a row with that of their squares, v (after the variance adaptation of Balles
    and Hennig, "Dissecting Adam", 2018). m starts at zero: what few pictures have shown moves
    little.

    A row without a gradient keeps its state and its place, as with ``torch.optim.SparseAdam``.

    Args:
        parameter: ``(n, *)`` what to change, in place.
    """

    def __init__(self, parameter: Tensor) -> None:
        self._parameter = parameter
        self._mean = torch.zeros_like(parameter)
        self._square = torch.zeros_like(parameter)
        self._count = parameter.new_zeros(len(parameter))

    @torch.no_grad()
    def step(
        self,
        rows: Int[Tensor, "k"],
        gradients: Float[Tensor, "k *d"],
        *,
        rate: float,
    ) -> None:
        """Move some rows.

        Args:
            rows: Which ones, each once.
            gradients: Their gradients.
            rate: Length of a step where all gradients agree.

        Example:
            >>> parameter, rows = torch.zeros(2, 1), torch.tensor([1])
            >>> adam = CarefulAdam(parameter)
            >>> for _ in range(100):
            ...     adam.step(rows, torch.tensor([[3.0]]), rate=0.01)
            >>> [round(value, 1) for value in parameter.flatten().tolist()]
            [0.0, -0.9]
        """
        keep, keep_square = _DECAYS
        count = self._count[rows] + 1
        mean = keep * self._mean[rows] + (1 - keep) * gradients
        square = keep_square * self._square[rows] + (1 - keep_square) * gradients.square()
        self._count[rows], self._mean[rows], self._square[rows] = count, mean, square
        beside = (-1, *[1] * (gradients.ndim - 1))
        spread = square / (1 - keep_square**count).reshape(beside)
        agreeing = _row_sums(mean.double().square())
        everything = agreeing + _row_sums(spread.double())
        share = divide(agreeing, everything).nan_to_num(0.0)  # squares that overflow
        share = share.to(mean.dtype).reshape(beside)
        self._parameter[rows] -= 2 * rate * share * mean / (spread.sqrt() + _LEAST_ROOT)


def _row_sums(values: Float[Tensor, "k *d"]) -> Float[Tensor, "k"]:
    return values.flatten(1).sum(dim=1) if values.ndim > 1 else values
