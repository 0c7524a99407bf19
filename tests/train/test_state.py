"""The training state: saving and loading; its history, and curves of the history."""

import copy
import json
import math
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.config import Section
from cvtgs.errors import CheckpointError
from cvtgs.io.tensors import map_tensors, save_tensors, tensors_digest
from cvtgs.mergenet import (
    Architecture,
    CheckpointInfo,
    LearnedScene,
    MergeNet,
    encode_checkpoint,
)
from cvtgs.train import DataConfig, Gain, History, LossConfig, TrainConfig, Validation
from cvtgs.train.state import TrainState
from mergenet_cases import some_case
from train_cases import bits_of, needs_matplotlib, small_net

CONFIG = TrainConfig(steps=10, width=6, cell_width=10)


def stepped(state: TrainState, steps: int) -> TrainState:
    """Take steps on a loss that depends on every weight."""
    seen = some_case(dtype=torch.float32).describe()
    for _ in range(steps):
        residuals = state.net(seen)
        loss = (residuals.d_log_scales - 0.1).square().sum() + (
            residuals.d_means - 0.1
        ).square().sum()
        state.optimizer.zero_grad()
        loss.backward()
        state.optimizer.step()
        state.average()
        state.step += 1
    return state


def saved(path: Path) -> Path:
    state = stepped(TrainState(small_net(), CONFIG), 3)
    gains = (Gain("room", 0.1, 0.1 + 0.2), Gain("room", 0.01, -1e-9))
    state.history.validations.append(Validation(step=0, loss=math.nan, gains=gains))
    state.save(path)
    return path


def loaded(path: Path, config: TrainConfig = CONFIG) -> TrainState:
    state = TrainState(small_net(seed=1), config)
    state.load(path)
    return state


def test_loading_restores_what_was_saved(tmp_path):
    path = saved(tmp_path / "a.state")
    state, wanted = loaded(path), stepped(TrainState(small_net(), CONFIG), 3)
    assert state.step == 3
    assert bits_of(state.net.state_dict()) == bits_of(wanted.net.state_dict())
    assert bits_of(state.mean_net.state_dict()) == bits_of(wanted.mean_net.state_dict())
    entry = state.history.validations[0]
    assert math.isnan(entry.loss)
    assert entry.gains == (Gain("room", 0.1, 0.1 + 0.2), Gain("room", 0.01, -1e-9))


def test_continuing_gives_the_same_bits(tmp_path):
    state = stepped(loaded(saved(tmp_path / "a.state")), 4)
    wanted = stepped(TrainState(small_net(), CONFIG), 7)
    assert bits_of(state.net.state_dict()) == bits_of(wanted.net.state_dict())
    assert bits_of(state.mean_net.state_dict()) == bits_of(wanted.mean_net.state_dict())


def test_saving_again_gives_the_same_bytes(tmp_path):
    path = saved(tmp_path / "a.state")
    state = loaded(path)
    state.save(tmp_path / "b.state")
    assert (tmp_path / "b.state").read_bytes() == path.read_bytes()


def test_continuing_does_not_change_the_file(tmp_path):
    path = saved(tmp_path / "a.state")
    before = path.read_bytes()
    stepped(loaded(path), 2)
    assert path.read_bytes() == before


def test_a_state_before_the_first_step(tmp_path):
    path = tmp_path / "a.state"
    TrainState(small_net(), CONFIG).save(path)
    state = stepped(loaded(path), 2)
    wanted = stepped(TrainState(small_net(), CONFIG), 2)
    assert bits_of(state.net.state_dict()) == bits_of(wanted.net.state_dict())


def test_the_running_mean_starts_fast_and_becomes_slow():
    """After the first step a tenth of the start is left; late steps contribute a five-hundredth."""
    state = TrainState(small_net(), CONFIG)
    with torch.no_grad():
        for values in (*state.net.parameters(), *state.mean_net.parameters()):
            values.zero_()
        for values in state.net.parameters():
            values.fill_(1.0)
    state.average()
    share = next(state.mean_net.parameters()).flatten()[0].item()
    assert share == pytest.approx(1 - 1 / 10)
    state.step = 10**6
    state.average()
    late = next(state.mean_net.parameters()).flatten()[0].item()
    assert late == pytest.approx(share + (1 - share) / CONFIG.averaged_steps)


def test_the_running_mean_is_a_separate_network():
    state = TrainState(small_net(), CONFIG)
    before = copy.deepcopy(state.mean_net.state_dict())
    with torch.no_grad():
        next(state.net.parameters()).fill_(5.0)
    assert bits_of(state.mean_net.state_dict()) == bits_of(before)
    assert not any(values.requires_grad for values in state.mean_net.parameters())


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"steps": 11},
        {"learning_rate": 0.1},
        {"kind": "local"},
        {"width": 7},
        {"keep": "last"},
        {"data": DataConfig(copies=1)},
        {"loss": LossConfig(residual_weight=1.0)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_another_configuration_is_one_clear_error(tmp_path, changes):
    (name, value), *_ = changes.items()
    if isinstance(value, Section):
        name += "." + next(key for key, one in value if one != getattr(getattr(CONFIG, name), key))
    path = saved(tmp_path / "a.state")
    config = CONFIG.model_copy(update=changes)
    state = TrainState(
        MergeNet(Architecture(width=config.width, cell_width=config.cell_width)), config
    )
    with pytest.raises(CheckpointError) as caught:
        state.load(path)
    assert str(caught.value) == (
        f"{path}: the state belongs to a training run with another configuration "
        f"({name} differs); restore the setting, or train to another output"
        f"{'; restart_step = 10 continues a finished one' * (name == 'steps')}."
    )
    assert state.step == 0


def test_a_training_with_a_restart_is_not_told_to_restart(tmp_path):
    """It cannot go on once more."""
    restarted = CONFIG.model_copy(update={"steps": 10, "restart_step": 5})
    path = tmp_path / "a.state"
    stepped(TrainState(small_net(), restarted), 10).save(path)
    longer = restarted.model_copy(update={"steps": 15, "restart_step": 10})
    with pytest.raises(CheckpointError) as caught:
        loaded(path, longer)
    assert str(caught.value).endswith("restore the setting, or train to another output.")


def test_note_and_patience_may_change(tmp_path):
    path = saved(tmp_path / "a.state")
    assert loaded(path, CONFIG.model_copy(update={"note": "more", "patience": 3})).step == 3


def test_the_folders_of_scenes_may_move(tmp_path):
    path, data = saved(tmp_path / "a.state"), DataConfig(folders=(tmp_path,))
    assert loaded(path, CONFIG.model_copy(update={"data": data})).step == 3


def test_the_start_may_move_but_not_change(tmp_path):
    path, starts = tmp_path / "a.state", [tmp_path / f"{name}.safetensors" for name in "abc"]
    for seed, start in zip((0, 0, 1), starts, strict=True):
        info = CheckpointInfo(architecture=small_net().architecture, preset="standard", seed=seed)
        start.write_bytes(encode_checkpoint(small_net(), info))
    first, moved, other = (CONFIG.model_copy(update={"start": start}) for start in starts)
    TrainState(small_net(), first).save(path)
    TrainState(small_net(), moved).load(path)
    for config in (other, CONFIG):
        with pytest.raises(CheckpointError, match=r"another configuration \(start differs\)"):
            TrainState(small_net(), config).load(path)


def test_a_state_of_other_settings_is_of_another_version(tmp_path):
    path = saved(tmp_path / "a.state")
    tensors, metadata = map_tensors(path)
    facts = json.loads(metadata["state"])
    facts["config"].pop("keep")
    old = tmp_path / "old.state"
    text = json.dumps(facts)
    save_tensors(old, tensors, {"state": text, "sha256": tensors_digest(tensors, text)})
    with pytest.raises(CheckpointError) as caught:
        loaded(old)
    assert str(caught.value) == (
        f"{old}: the state was written by another version of cvtgs, which has other settings; "
        f"remove it, or train to another output."
    )


SCENES = (LearnedScene(name="room", count=5, sha256="ab"), LearnedScene(name="exam", count=7))


@pytest.mark.parametrize(
    ("scenes", "odd"),
    [
        (SCENES[:1], "exam"),
        (SCENES[1:], "room"),
        ((*SCENES, SCENES[1].model_copy(update={"name": "hall"})), "hall"),
        ((*SCENES, SCENES[1]), "their number"),
        ((*SCENES[:1], SCENES[1].model_copy(update={"count": 8})), "exam"),
        (SCENES[::-1], "exam"),
        ((*SCENES[:1], SCENES[1].model_copy(update={"cameras_sha256": "cd"})), "exam"),
    ],
    ids=["fewer", "without the first", "more", "twice", "other", "other order", "other cameras"],
)
def test_other_scenes_are_one_clear_error(tmp_path, scenes, odd):
    """Otherwise the checkpoint would name scenes that only the last steps saw."""
    path = tmp_path / "a.state"
    TrainState(small_net(), CONFIG, SCENES).save(path)
    TrainState(small_net(), CONFIG, SCENES).load(path)
    with pytest.raises(CheckpointError) as caught:
        TrainState(small_net(), CONFIG, scenes).load(path)
    assert str(caught.value) == (
        f"{path}: the state belongs to a training run on other scenes, in another order or "
        f"with other cameras ({odd} differs); restore these, or train to another output."
    )


def test_the_state_of_another_version_is_one_clear_error(tmp_path, monkeypatch):
    path = saved(tmp_path / "a.state")
    here = cvtgs.__version__
    monkeypatch.setattr(cvtgs, "__version__", "9.9")
    with pytest.raises(CheckpointError) as caught:
        loaded(path)
    assert str(caught.value) == (
        f"{path}: the state was written by cvtgs {here}, but this is 9.9; "
        f"remove it, or train to another output."
    )


def damaged(path: Path, kind: str) -> None:
    content, (tensors, metadata) = path.read_bytes(), map_tensors(path)
    tensors = {name: values.clone() for name, values in tensors.items()}
    text = metadata["state"]
    facts = json.loads(text)
    path.unlink()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut short":
        path.write_bytes(content[:-1])
    elif kind == "header":
        path.write_bytes(content[:9] + b"\xff" + content[10:])
    elif kind == "a flipped bit":
        path.write_bytes(content[:-101] + bytes([content[-101] ^ 64]) + content[-100:])
    elif kind == "zeros":
        zeros = {name: torch.zeros_like(values) for name, values in tensors.items()}
        save_tensors(path, zeros, metadata)
    elif kind == "a network":
        save_tensors(path, tensors, {})
    else:
        if kind == "without weights":
            tensors.pop(next(name for name in tensors if name.startswith("net/")))
        elif kind == "weights of another shape":
            tensors["mean/decoder.bias"] = torch.zeros(7)
        elif kind == "without a step":
            facts.pop("step")
            text = json.dumps(facts)
        elif kind == "no facts":
            text = "[]"
        elif kind == "facts cut short":
            text = text[:-5]
        save_tensors(path, tensors, {"state": text, "sha256": tensors_digest(tensors, text)})


@pytest.mark.parametrize(
    "kind",
    [
        "empty",
        "cut short",
        "header",
        "a flipped bit",
        "zeros",
        "a network",
        "without weights",
        "weights of another shape",
        "without a step",
        "no facts",
        "facts cut short",
    ],
)
@pytest.mark.slow
def test_a_damaged_file_is_one_clear_error(tmp_path, kind):
    path = saved(tmp_path / "a.state")
    damaged(path, kind)
    with pytest.raises(CheckpointError) as caught:
        loaded(path)
    assert (
        str(caught.value)
        == f"{path}: the training state is damaged; remove it, or train to another output."
    )


GAINS = (
    Gain("room", 0.1, 1.0),
    Gain("room", 0.01, 4.0),
    Gain("tree", 0.1, -0.5),
    Gain("tree", 0.01, 0.5),
    Gain("dot", 0.1, 0.0),
)


def history_of(*gains: float) -> History:
    history = History()
    for number, gain in enumerate(gains):
        loss = 1.0 / number if number else math.nan
        history.validations.append(
            Validation(step=10 * number, loss=loss, gains=(Gain("room", 0.1, gain),))
        )
    return history


def test_the_gain_is_the_mean_over_scenes_and_ratios():
    assert Validation(step=0, loss=1.0, gains=GAINS).mean_gain == pytest.approx(1.0)


def test_gains_by_ratio_the_largest_first():
    found = Validation(step=0, loss=1.0, gains=GAINS).by_ratio()
    assert list(found.items()) == [(0.1, [1.0, -0.5, 0.0]), (0.01, [4.0, 0.5])]


@pytest.mark.parametrize(
    ("gains", "best", "since"),
    [
        ([0.0], 0, 0),
        ([0.0, 1.0], 1, 0),
        ([0.0, 1.0, 0.5, 0.9], 1, 2),
        ([0.0, 1.0, 1.0], 1, 1),
        ([0.0, -1.0, -2.0, -0.5], 0, 3),
    ],
)
def test_the_best_is_the_first_of_the_largest_gains(gains, best, since):
    history = history_of(*gains)
    assert history.best() is history.validations[best]
    assert history.since_best() == since


def test_before_the_first_validation():
    assert History().best() is None
    assert History().since_best() == 0


def test_json_and_back_keeps_every_digit():
    history = history_of(0.0, 0.1 + 0.2, -1e-300)
    history.validations.append(Validation(step=30, loss=1 / 3, gains=GAINS))
    history.validations.append(Validation(step=40, loss=math.nan, gains=GAINS))
    again = History.from_list(json.loads(json.dumps(history.to_list(), allow_nan=False)))
    assert repr(again.validations) == repr(history.validations)
    assert again.to_list()[1:] == history.to_list()[1:]
    assert History.from_list(History().to_list()).validations == []


@pytest.mark.slow
@needs_matplotlib
@pytest.mark.parametrize("count", [1, 2, 5])
def test_curves_are_an_image(count):
    history = history_of(*range(count))
    assert history.curves()[:8] == b"\x89PNG\r\n\x1a\n"
    assert history.curves() == history.curves()
