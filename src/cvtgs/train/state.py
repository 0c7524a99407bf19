"""State: all that a training needs to go on as if it had never stopped."""

import copy
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cvtgs.errors import CheckpointError
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.mergenet import MergeNet
from cvtgs.train.config import TrainConfig
from cvtgs.train.history import History

AVERAGED_STEPS = 500
"""The network that is kept is a running mean over about this many steps."""


class TrainState:
    """A network in training: its weights, their running mean, the optimiser, and the past."""

    def __init__(self, net: MergeNet, config: TrainConfig) -> None:
        self.net = net
        self.mean_net = copy.deepcopy(net).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            net.parameters(), lr=config.learning_rate, betas=(0.9, 0.98), weight_decay=0.0
        )
        self.history = History()
        self.step = 0

    def average(self) -> None:
        """Let the running mean follow the weights."""
        share = 1 - min(1 - 1 / AVERAGED_STEPS, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for mean, now in zip(self.mean_net.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(now, share)

    def save(self, path: Path, config: TrainConfig) -> None:
        """Write the state to a file."""
        tensors = add_prefix("net/", self.net.state_dict())
        tensors |= add_prefix("mean/", self.mean_net.state_dict())
        for number, values in self.optimizer.state_dict()["state"].items():
            tensors |= add_prefix(f"optimizer/{number}/", values)
        facts = {
            "step": self.step,
            "history": self.history.to_json(),
            "config": _fingerprint(config),
        }
        save_tensors(path, tensors, {"state": json.dumps(facts)})

    def load(self, path: Path, config: TrainConfig) -> None:
        """Take over a state that was saved."""
        try:
            tensors, metadata = map_tensors(path)
            facts = json.loads(metadata["state"])
            if facts["config"] != _fingerprint(config):
                raise CheckpointError(
                    f"{path}: the state belongs to a training with another configuration; "
                    f"remove it, or train to another output."
                )
            self._fill(tensors, facts)
        except (KeyError, ValueError, TypeError, RuntimeError) as error:
            if isinstance(error, CheckpointError):
                raise
            raise CheckpointError(f"{path}: the state of the training is damaged.") from error

    def _fill(self, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
        # Mapped tensors must not be written to: load_state_dict copies, the optimiser does not.
        tensors = {name: values.clone() for name, values in tensors.items()}
        self.net.load_state_dict(under_prefix("net/", tensors))
        self.mean_net.load_state_dict(under_prefix("mean/", tensors))
        state = self.optimizer.state_dict()
        count = len(state["param_groups"][0]["params"])
        kept = {number: under_prefix(f"optimizer/{number}/", tensors) for number in range(count)}
        state["state"] = {number: values for number, values in kept.items() if values}
        self.optimizer.load_state_dict(state)
        self.step = int(facts["step"])
        self.history = History.from_json(facts["history"])


def _fingerprint(config: TrainConfig) -> dict[str, Any]:
    return config.model_dump(mode="json", exclude={"note", "patience"})
