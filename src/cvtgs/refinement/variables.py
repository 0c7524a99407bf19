"""What a refinement changes: the six tensors of a scene, row by row."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.config import Rates
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene
from cvtgs.validity import standardized, valid_rows, with_finite_opacities

_BETAS = (0.6, 0.99)
_LEAST_ROOT = 1e-15


class Variables:
    """A scene as a start plus changes, and the optimiser of the changes.

    A step of Adam (Kingma and Ba 2015, as ``SparseAdam`` does it) moves the Gaussians alone that a
    image shows, as far as they are free to: all others have no gradient, keep their momentum for
    later, and stay as they are. Memory: five times the scene.
    """

    def __init__(self, scene: GaussianScene, rates: Rates, *, freedom: Float[Tensor, "n"]) -> None:
        self._scene = scene
        self._start = _started(scene)
        self._units = _units(scene, freedom)
        self._changes = {
            name: torch.zeros_like(tensor, requires_grad=True)
            for name, tensor in self._start.items()
        }
        self._rates = {
            name: rate
            for name, rate in rates.model_dump().items()
            if rate > 0 and self._start[name].numel()
        }
        self._moved = torch.zeros(len(scene), dtype=torch.bool, device=scene.device)
        groups = [
            {"params": [self._changes[name]], "lr": rate} for name, rate in self._rates.items()
        ]
        self._optimizer = (
            torch.optim.SparseAdam(groups, betas=_BETAS, eps=_LEAST_ROOT) if groups else None
        )

    def scene(self) -> GaussianScene:
        """Return the scene, differentiable in the changes."""
        tensors = {
            name: start + self._changes[name] * self._units[name]
            for name, start in self._start.items()
        }
        return self._scene.with_tensors(tensors, self._scene.extras)

    def step(self, loss: Tensor, *, factor: float) -> None:
        """Move every Gaussian that has a finite gradient which is not zero."""
        if self._optimizer is None or not loss.requires_grad:
            return
        changes = [self._changes[name] for name in self._rates]
        gradients = torch.autograd.grad(loss, changes, materialize_grads=True)
        rows = _rows_to_move(gradients)
        for group, rate, change, gradient in zip(
            self._optimizer.param_groups, self._rates.values(), changes, gradients, strict=True
        ):
            group["lr"] = factor * rate
            largest = 0.5 * torch.finfo(gradient.dtype).max ** 0.5  # else its square overflows
            change.grad = torch.sparse_coo_tensor(
                rows[None],
                gradient[rows].clamp(-largest, largest),
                change.shape,
                is_coalesced=True,
                check_invariants=True,
            )
        self._optimizer.step()
        self._moved[rows] = True

    @torch.no_grad()
    def result(self) -> GaussianScene:
        """Return the scene as it would be saved."""
        now = standardized(self.scene())
        moved = self._moved & valid_rows(now)
        tensors = {
            name: torch.where(_beside(moved, old), now.tensors()[name], old)
            for name, old in self._scene.tensors().items()
        }
        return self._scene.with_tensors(tensors, self._scene.extras)


def changed_count(before: GaussianScene, after: GaussianScene) -> int:
    """Count the Gaussians that are not what they were."""
    changed = torch.zeros(len(before), dtype=torch.bool, device=before.device)
    for name, old in before.tensors().items():
        new = after.tensors()[name]
        differs = (new != old) & ~(new.isnan() & old.isnan())
        changed |= differs.flatten(start_dim=1).any(dim=1) if old.ndim > 1 else differs
    return int(changed.sum())


def _started(scene: GaussianScene) -> dict[str, Tensor]:
    """Return the tensors with finite opacities and unit quaternions, which paint the same."""
    start = with_finite_opacities(scene).tensors()
    return start | {"quats": parameters.normalize_quats(start["quats"])}


def _units(scene: GaussianScene, freedom: Float[Tensor, "n"]) -> dict[str, Tensor]:
    """Return the length of one unit of change; positions use the mean standard deviation."""
    widths = torch.where(freedom > 0, torch.exp(scene.log_scales).mean(dim=1), 0.0)
    units = {name: _beside(freedom, tensor) for name, tensor in scene.tensors().items()}
    return units | {"means": (freedom * widths)[:, None]}


def _rows_to_move(gradients: tuple[Tensor, ...]) -> Tensor:
    some = torch.zeros(len(gradients[0]), dtype=torch.bool, device=gradients[0].device)
    sane = ~some
    for gradient in gradients:
        flat = gradient.reshape(len(gradient), -1)
        some |= (flat != 0).any(dim=1)
        sane &= flat.isfinite().all(dim=1)
    return (some & sane).nonzero()[:, 0]


def _beside(mask: Tensor, tensor: Tensor) -> Tensor:
    return mask.reshape(-1, *[1] * (tensor.ndim - 1))
