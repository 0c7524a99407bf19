"""The state of a training, which can be saved and resumed: networks, optimiser, validations."""

import copy
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple, Self

import pydantic
import torch
from torch import Tensor

import cvtgs
from cvtgs.errors import CheckpointError, OutputError
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, tensors_digest, under_prefix
from cvtgs.mergenet import LearnedScene, MergeNet, Net, load_checkpoint
from cvtgs.plots import Panel, Series, line_chart
from cvtgs.train.config import TrainConfig

# Plotted statistics of the gains over all scenes, and their titles
CURVES: tuple[tuple[Callable[[list[float]], float], str], ...] = (
    (mean, "mean gain, validation scenes"),
    (min, "gain of the worst validation scene"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainFiles:
    """Output files of a training.

    Attributes:
        checkpoint: The network of the best validation so far, or of the last one.
        state: State to resume from.
        curves: Plot of the history; not written without matplotlib.
        cache: Folder of prepared scenes.
    """

    checkpoint: Path
    state: Path
    curves: Path
    cache: Path

    @classmethod
    def beside(
        cls, checkpoint: str | os.PathLike[str], cache: str | os.PathLike[str] | None = None
    ) -> "TrainFiles":
        """Return the default paths for a checkpoint.

        Args:
            checkpoint: Path of the checkpoint.
            cache: Folder of prepared scenes; None puts it beside the checkpoint.

        Returns:
            Paths with the stem of the checkpoint.

        Raises:
            OutputError: The name of the checkpoint does not end in ``.safetensors``.

        Example:
            >>> TrainFiles.beside(Path("net.safetensors")).curves.name
            'net.png'
        """
        checkpoint = Path(checkpoint)
        if checkpoint.suffix != ".safetensors":
            raise OutputError(f"{checkpoint}: the name must end in .safetensors.")
        return cls(
            checkpoint=checkpoint,
            state=checkpoint.with_suffix(".state"),
            curves=checkpoint.with_suffix(".png"),
            cache=Path(cache or checkpoint.with_suffix(".cache")),
        )


class Gain(NamedTuple):
    """The gain of the network on one validation scene at one ratio.

    Attributes:
        scene: Name of the scene.
        ratio: Share of Gaussians kept.
        decibels: PSNR with the network minus PSNR without it.
    """

    scene: str
    ratio: float
    decibels: float


class Validation(NamedTuple):
    """Gains of the running mean of the network on the validation scenes.

    Attributes:
        step: Number of steps before this validation.
        loss: Mean training loss since the last validation; NaN before the first step.
        gains: Gains by scene and ratio.
    """

    step: int
    loss: float
    gains: tuple[Gain, ...]

    @property
    def mean_gain(self) -> float:
        """The mean gain over scenes and ratios, in decibels."""
        return mean(gain.decibels for gain in self.gains)

    def by_ratio(self) -> dict[float, list[float]]:
        """Return the gains of all scenes, by ratio.

        Returns:
            Decibels by ratio, largest ratio first.
        """
        ratios = sorted({gain.ratio for gain in self.gains}, reverse=True)
        return {
            ratio: [gain.decibels for gain in self.gains if gain.ratio == ratio] for ratio in ratios
        }


_VALIDATIONS = pydantic.TypeAdapter(
    list[Validation], config=pydantic.ConfigDict(ser_json_inf_nan="strings")
)


class History:
    """The validations of a training, in order.

    Example:
        >>> history = History()
        >>> for step, decibels in ((0, 0.0), (500, 0.3), (1000, 0.2)):
        ...     gains = (Gain(scene="room", ratio=0.1, decibels=decibels),)
        ...     history.validations.append(Validation(step=step, loss=1.0, gains=gains))
        >>> history.best().step, history.since_best()
        (500, 1)
    """

    def __init__(self) -> None:
        self.validations: list[Validation] = []

    def best(self) -> Validation | None:
        """Return the first validation with the largest mean gain.

        Returns:
            The validation, or None before the first.
        """
        return max(self.validations, key=lambda entry: entry.mean_gain, default=None)

    def since_best(self) -> int:
        """Count the validations after the best one."""
        best = self.best()
        return 0 if best is None else len(self.validations) - 1 - self.validations.index(best)

    def to_list(self) -> list[Any]:
        """Return the validations as plain values.

        Returns:
            Lists, numbers and strings, for :meth:`from_list`.
        """
        values: list[Any] = json.loads(_VALIDATIONS.dump_json(self.validations))  # NaN as text
        return values

    @classmethod
    def from_list(cls, values: list[Any]) -> Self:
        """Build a history from plain values.

        Args:
            values: Result of :meth:`to_list`.

        Raises:
            ValueError: The values do not describe a history.
        """
        history = cls()
        history.validations = _VALIDATIONS.validate_python(values)
        return history

    def curves(self) -> bytes:
        """Plot the training loss, and the mean and smallest gains by ratio.

        There must be at least one validation.

        Returns:
            A PNG file.

        Raises:
            MissingDependencyError: matplotlib is missing.
        """
        steps = [entry.step for entry in self.validations]
        losses = Panel(
            series=[Series(name="loss", x=steps, y=[entry.loss for entry in self.validations])],
            title="training loss",
            x_label="step",
        )
        table = [entry.by_ratio() for entry in self.validations]
        panels = [
            Panel(
                series=[
                    Series(
                        name=f"rho {ratio:g}", x=steps, y=[statistic(row[ratio]) for row in table]
                    )
                    for ratio in table[0]
                ],
                title=title,
                x_label="step",
                y_label="dB",
            )
            for statistic, title in CURVES
        ]
        return line_chart([losses, *panels], columns=3, width=1500, height=450)


class TrainState:
    """A network in training: its weights, their running mean, the optimiser, the history."""

    def __init__(self, net: Net, config: TrainConfig, scenes: Iterable[LearnedScene] = ()) -> None:
        self.net, self.config = net, config
        self.mean_net = copy.deepcopy(net).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            net.parameters(), lr=config.learning_rate, betas=(0.9, 0.98), weight_decay=0.0
        )
        self.history = History()
        self.scenes = tuple(scenes)
        self.start = "" if config.start is None else load_checkpoint(config.start).digest
        self.step = 0

    def learn_range(self, cases: Iterable[Tensor]) -> None:
        """Fit the known range of both networks, if they have one, to the summaries of all cases."""
        if isinstance(self.net, MergeNet) and isinstance(self.mean_net, MergeNet):
            self.net.known.fit(cases)
            self.mean_net.known.load_state_dict(self.net.known.state_dict())

    def average(self) -> None:
        """Update the running mean of the weights."""
        share = 1 - min(1 - 1 / self.config.averaged_steps, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for average, now in zip(self.mean_net.parameters(), self.net.parameters(), strict=True):
                average.lerp_(now, share)

    def save(self, path: Path) -> None:
        """Write the state to a file."""
        tensors = add_prefix("net/", self.net.state_dict())
        tensors |= add_prefix("mean/", self.mean_net.state_dict())
        for number, values in self.optimizer.state_dict()["state"].items():
            tensors |= add_prefix(f"optimizer/{number}/", values)
        record = {
            "step": self.step,
            "history": self.history.to_list(),
            "config": self._settings(),
            "version": cvtgs.__version__,
            "scenes": [scene.model_dump() for scene in self.scenes],
        }
        text = json.dumps(record)
        save_tensors(path, tensors, {"state": text, "sha256": tensors_digest(tensors, text)})

    def load(self, path: Path) -> None:
        """Read the state from a file that :meth:`save` wrote."""
        try:
            tensors, metadata = map_tensors(path)
            record = json.loads(metadata["state"])
            if record["version"] != cvtgs.__version__:  # a checkpoint names one version
                raise CheckpointError(
                    f"{path}: the state was written by cvtgs {record['version']}, but this is "
                    f"{cvtgs.__version__}; remove it, or train to another output."
                )
            self._check_settings(path, record["config"])
            self._check_scenes(path, record["scenes"])
            if metadata["sha256"] != tensors_digest(tensors, metadata["state"]):
                raise ValueError("the content has another hash")
            # Mapped tensors must not be written to, and the optimiser does not copy them: clone.
            self._load_tensors({name: values.clone() for name, values in tensors.items()})
            self.step = int(record["step"])
            self.history = History.from_list(record["history"])
        except CheckpointError:
            raise
        except (KeyError, ValueError, TypeError, RuntimeError) as error:
            raise CheckpointError(
                f"{path}: the training state is damaged; remove it, or train to another output."
            ) from error

    def _settings(self) -> dict[str, Any]:
        """Return the settings that must not change between start and resume, by dotted key."""
        # Paths may change: the scenes and the digest of the start are compared instead.
        values = self.config.model_dump(
            mode="json", exclude={"note": True, "patience": True, "data": {"folders"}}
        )
        settings: dict[str, Any] = {}
        for key, value in values.items():
            if isinstance(value, dict):
                settings |= {f"{key}.{name}": inner for name, inner in value.items()}
            else:
                settings[key] = value
        return settings | {"start": self.start}

    def _check_settings(self, path: Path, theirs: dict[str, Any]) -> None:
        """Raise for other settings, but for a restart at the end of a finished training."""
        ours = self._settings()
        if set(theirs) != set(ours):
            raise CheckpointError(
                f"{path}: the state was written by another version of cvtgs, which has other "
                f"settings; remove it, or train to another output."
            )
        if theirs["restart_step"] == 0 and ours["restart_step"] == theirs["steps"]:
            theirs = theirs | {key: ours[key] for key in ("steps", "restart_step", "restart_rate")}
        odd = [key for key in ours if theirs[key] != ours[key]]
        if odd:
            continues = odd[0] == "steps" and theirs["restart_step"] == 0
            more = f"; restart_step = {theirs['steps']} continues a finished one"
            raise CheckpointError(
                f"{path}: the state belongs to a training run with another configuration "
                f"({odd[0]} differs); restore the setting, or train to another output"
                f"{more * continues}."
            )

    def _check_scenes(self, path: Path, scenes: list[dict[str, Any]]) -> None:
        """Raise an error for other scenes, or another order, in which steps draw them."""
        theirs = [LearnedScene.model_validate(scene) for scene in scenes]
        if not self.scenes or self.scenes == tuple(theirs):
            return
        missing = [one.name for one in theirs if one not in self.scenes]
        new = [one.name for one in self.scenes if one not in theirs]
        moved = [one.name for one, other in zip(self.scenes, theirs, strict=False) if one != other]
        odd = [*missing, *new, *moved, "their number"]
        raise CheckpointError(
            f"{path}: the state belongs to a training run on other scenes, in another order or "
            f"with other cameras ({odd[0]} differs); restore these, or train to another output."
        )

    def _load_tensors(self, tensors: dict[str, Tensor]) -> None:
        self.net.load_state_dict(under_prefix("net/", tensors))
        self.mean_net.load_state_dict(under_prefix("mean/", tensors))
        state = self.optimizer.state_dict()
        count = len(state["param_groups"][0]["params"])
        kept = {number: under_prefix(f"optimizer/{number}/", tensors) for number in range(count)}
        state["state"] = {number: values for number, values in kept.items() if values}
        self.optimizer.load_state_dict(state)
