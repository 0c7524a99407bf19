"""Interrupted training: a resumed run gives the bits of an uninterrupted one."""

from pathlib import Path

import pytest
import torch

from cvtgs.errors import CheckpointError, OutputExistsError
from cvtgs.mergenet import load_checkpoint
from cvtgs.progress import ProgressEvent
from cvtgs.train import History, TrainConfig, TrainFiles, loop as train_loop
from train_cases import (
    bits_of_state,
    needs_matplotlib,
    run,
    tiny_config,
    tiny_data,
    write_scenes,
)

STEPS = 7


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"), ["lesson", "exam", "lesson2"])


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def _quick_curves(monkeypatch) -> None:
    """Drawing takes longer than training here."""
    monkeypatch.setattr(History, "curves", lambda history: repr(history.to_list()).encode())


def config_of(scenes: Path, **changes) -> TrainConfig:
    data = tiny_data(scenes, copies=1, ratios=(0.1, 0.05))
    return tiny_config(data, **{"steps": STEPS} | changes)


class PowerCutError(Exception):
    """Stands for anything that ends a process."""


def interrupting(step: int):
    """Return a listener that raises after a step, wherever validations are."""

    def listen(event: ProgressEvent) -> None:
        if event.stage == "train" and event.done == step:
            raise PowerCutError

    return listen


def rising(net, case, views) -> tuple[float, float]:
    """Stands for ``validation_psnr``: every validation is the best so far."""
    return 20.0, 20.0 + float(net.decoder.weight.abs().sum())


def assert_same_files(first: Path, second: Path) -> None:
    ours, theirs = TrainFiles.beside(first), TrainFiles.beside(second)
    assert ours.checkpoint.read_bytes() == theirs.checkpoint.read_bytes()
    assert bits_of_state(ours.state) == bits_of_state(theirs.state)
    assert ours.state.read_bytes() == theirs.state.read_bytes()
    assert ours.curves.read_bytes() == theirs.curves.read_bytes()


@pytest.mark.long
@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.parametrize("kind", ["scene", "local"])
@pytest.mark.parametrize("stops", [[1], [2], [1, 3, 4, 5]], ids=str)
def test_a_run_interrupted_anywhere_can_be_resumed(scenes, cache, tmp_path, kind, stops):
    whole, cut = tmp_path / "whole.safetensors", tmp_path / "cut.safetensors"
    config = config_of(scenes, kind=kind)
    wanted = run(config, whole, cache)
    for stop in stops:
        with pytest.raises(PowerCutError):
            run(config, cut, cache, resume=True, listener=interrupting(stop))
    found = run(config, cut, cache, resume=True)
    assert repr(found.validations) == repr(wanted.validations)
    assert [entry.step for entry in found.validations] == [0, 2, 4, 6, 7]
    assert_same_files(cut, whole)


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.parametrize(("where", "count"), [("validation_psnr", 2), ("write_atomically", 3)])
@pytest.mark.long
def test_a_run_interrupted_during_validation_can_be_resumed(
    scenes, cache, tmp_path, monkeypatch, where, count
):
    whole, cut = tmp_path / "whole.safetensors", tmp_path / "cut.safetensors"
    config, calls = config_of(scenes), []
    run(config, whole, cache)
    true = getattr(train_loop, where)

    def breaking(*arguments, **options):
        calls.append(arguments)
        if len(calls) == count:
            raise PowerCutError
        return true(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(train_loop, where, breaking)
        with pytest.raises(PowerCutError):
            run(config, cut, cache)
    run(config, cut, cache, resume=True)
    assert_same_files(cut, whole)


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.long
def test_a_run_interrupted_between_checkpoint_and_state_can_be_resumed(
    scenes, cache, tmp_path, monkeypatch
):
    """The checkpoint is then newer than the state, and is written again."""
    whole, cut = tmp_path / "whole.safetensors", tmp_path / "cut.safetensors"
    config, calls = config_of(scenes), []
    monkeypatch.setattr(train_loop, "validation_psnr", rising)
    run(config, whole, cache)
    true = train_loop.TrainState.save

    def breaking(state, path):
        calls.append(state.step)
        if len(calls) == 3:
            raise PowerCutError
        true(state, path)

    with monkeypatch.context() as patch:
        patch.setattr(train_loop.TrainState, "save", breaking)
        with pytest.raises(PowerCutError):
            run(config, cut, cache)
    assert load_checkpoint(cut).info.steps == 4
    run(config, cut, cache, resume=True)
    assert_same_files(cut, whole)


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_resuming_a_finished_run_changes_nothing(scenes, cache, tmp_path):
    path = tmp_path / "net.safetensors"
    first = run(config_of(scenes), path, cache)
    files = {entry: entry.read_bytes() for entry in tmp_path.iterdir() if entry.is_file()}
    calls: list[History] = []
    again = run(config_of(scenes), path, cache, resume=True, on_validation=calls.append)
    assert repr(again.validations) == repr(first.validations)
    assert calls == []
    TrainFiles.beside(path).curves.unlink()
    run(config_of(scenes), path, cache, resume=True)  # draws them again
    assert {entry: entry.read_bytes() for entry in tmp_path.iterdir() if entry.is_file()} == files


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_without_resume_a_training_starts_over(scenes, cache, tmp_path):
    path = tmp_path / "net.safetensors"
    with pytest.raises(PowerCutError):
        run(config_of(scenes), path, cache, listener=interrupting(5))
    before = path.read_bytes()
    with pytest.raises(
        OutputExistsError, match=r"net\.state: the output must not exist yet, found the state"
    ):
        run(config_of(scenes), path, cache)
    path.with_suffix(".state").rename(tmp_path / "elsewhere")
    with pytest.raises(OutputExistsError, match=r"net\.safetensors: the output must not exist yet"):
        run(config_of(scenes), path, cache)
    assert path.read_bytes() == before
    history = run(config_of(scenes), path, cache, overwrite=True)
    assert [entry.step for entry in history.validations] == [0, 2, 4, 6, 7]


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_more_patience_lets_a_training_continue(scenes, cache, tmp_path, monkeypatch):
    path, whole = tmp_path / "net.safetensors", tmp_path / "whole.safetensors"
    true_psnr = train_loop.validation_psnr

    def falling(net, case, views):
        before, after = true_psnr(net, case, views)
        return before, before - abs(after - before)

    monkeypatch.setattr(train_loop, "validation_psnr", falling)
    wanted = run(config_of(scenes), whole, cache)
    stopped = run(config_of(scenes, patience=1), path, cache)
    assert [entry.step for entry in stopped.validations] == [0, 2]
    found = run(config_of(scenes), path, cache, resume=True)
    assert repr(found.validations) == repr(wanted.validations)
    first, second = load_checkpoint(path).net, load_checkpoint(whole).net
    assert all(map(torch.equal, first.state_dict().values(), second.state_dict().values()))


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_a_finished_training_goes_on_as_if_it_had_never_ended(scenes, cache, tmp_path):
    whole, path = tmp_path / "whole.safetensors", tmp_path / "net.safetensors"
    more = {"steps": 6, "restart_step": 4, "restart_rate": 1e-3}
    wanted = run(config_of(scenes, **more), whole, cache)
    run(config_of(scenes, steps=4), path, cache)
    with pytest.raises(CheckpointError, match=r"another configuration \(steps differs\)"):
        run(config_of(scenes, **more | {"restart_step": 3}), path, cache, resume=True)
    found = run(config_of(scenes, **more), path, cache, resume=True)
    assert repr(found.validations) == repr(wanted.validations)
    first, second = load_checkpoint(path).net, load_checkpoint(whole).net
    assert all(map(torch.equal, first.state_dict().values(), second.state_dict().values()))


@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_another_configuration_or_a_damaged_state_is_one_clear_error(scenes, cache, tmp_path):
    path = tmp_path / "net.safetensors"
    run(config_of(scenes), path, cache)
    checkpoint, state = path.read_bytes(), path.with_suffix(".state")
    for changes in ({"seed": 1}, {"width": 7}, {"learning_rate": 0.1}):
        with pytest.raises(CheckpointError, match="a training run with another configuration"):
            run(config_of(scenes, **changes), path, cache, resume=True)
    state.write_bytes(state.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="the training state is damaged; remove it"):
        run(config_of(scenes), path, cache, resume=True)
    assert path.read_bytes() == checkpoint


@pytest.mark.long
@needs_matplotlib
def test_the_curves_cover_the_whole_training(scenes, cache, tmp_path):
    whole, cut = tmp_path / "whole.safetensors", tmp_path / "cut.safetensors"
    config = config_of(scenes, validate_every=4)
    run(config, whole, cache)
    with pytest.raises(PowerCutError):
        run(config, cut, cache, listener=interrupting(5))
    run(config, cut, cache, resume=True)
    assert_same_files(cut, whole)


@pytest.mark.long
@pytest.mark.usefixtures("_quick_curves")
@pytest.mark.slow
def test_the_checkpoint_of_another_training_is_refused(scenes, cache, tmp_path):
    """It has another seed, or is the network of a step that this training did not keep."""
    path = tmp_path / "net.safetensors"
    run(config_of(scenes, keep="last"), path, cache)
    for changes in ({"seed": 5}, {"steps": STEPS - 2}):
        other = tmp_path / f"{next(iter(changes))}.safetensors"
        run(config_of(scenes, keep="last", **changes), other, cache)
        path.write_bytes(other.read_bytes())
        with pytest.raises(CheckpointError, match="the network is of another training run than"):
            run(config_of(scenes, keep="last"), path, cache, resume=True)


@pytest.mark.long
@pytest.mark.usefixtures("_quick_curves")
def test_settings_of_torch_do_not_change_the_network(scenes, cache, tmp_path):
    """Neither a default dtype or device, nor autocast, nor that gradients are off."""
    whole, other = tmp_path / "whole.safetensors", tmp_path / "other.safetensors"
    config = config_of(scenes, steps=2)
    run(config, whole, cache)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"), torch.autocast("cpu"), torch.inference_mode():
            run(config, other, tmp_path / "other cache")
    finally:
        torch.set_default_dtype(torch.float32)
    assert_same_files(other, whole)
