"""The loop: the network that is kept, stopping, bad scenes and bad losses."""

import math
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.errors import (
    CheckpointError,
    ConfigError,
    DeviceError,
    InvalidArgumentError,
    InvalidSceneError,
    MissingDependencyError,
    OutputError,
    TrainingError,
)
from cvtgs.mergenet import load_checkpoint
from cvtgs.progress import ProgressEvent
from cvtgs.train import Gain, History, TrainConfig, TrainFiles, loop as train_loop, train
from train_cases import bits_of, run, small_scene, tiny_config, tiny_data, write_scenes


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"), ["exam", "lesson"])


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _quick_curves(monkeypatch) -> None:
    """Drawing takes longer than training here."""
    monkeypatch.setattr(History, "curves", lambda history: b"an image")


def config_of(scenes: Path, **changes) -> TrainConfig:
    return tiny_config(tiny_data(scenes), **changes)


class Marks:
    """Stands for ``validation_psnr``: gains as given, one per validation."""

    def __init__(self, *gains: float) -> None:
        self.gains, self.nets = list(gains), []

    def __call__(self, net, case, views) -> tuple[float, float]:
        self.nets.append(bits_of(net.state_dict()))
        return 20.0, 20.0 + self.gains[len(self.nets) - 1]


def test_files_are_named_after_the_checkpoint():
    files = TrainFiles.beside(Path("out/net.v2.safetensors"))
    assert files.checkpoint == Path("out/net.v2.safetensors")
    assert (files.state, files.curves) == (Path("out/net.v2.state"), Path("out/net.v2.png"))
    assert files.cache == Path("out/net.v2.cache")
    assert TrainFiles.beside("a.safetensors", "c").cache == Path("c")
    for name in ("net.png", "net.state", "net"):  # two of its files would be one
        with pytest.raises(OutputError, match="the name must end in"):
            TrainFiles.beside(name)


def test_arguments_of_another_kind_are_named(scenes, tmp_path):
    files = TrainFiles.beside(tmp_path / "net.safetensors")
    with pytest.raises(InvalidArgumentError, match="files must be of type TrainFiles, found str"):
        train(config_of(scenes), "net.safetensors")
    with pytest.raises(InvalidArgumentError, match="config must be of type TrainConfig"):
        train({}, files)
    with pytest.raises(DeviceError, match="cudaa"):
        train(config_of(scenes), files, device="cudaa")
    with pytest.raises(InvalidArgumentError, match="on_validation must be a function of a history"):
        train(config_of(scenes), files, on_validation=3)


@pytest.mark.slow
def test_validations_run_at_every_interval_and_at_the_end(scenes, cache, tmp_path):
    seen: list[list[int]] = []

    def watch(history: History) -> None:
        seen.append([entry.step for entry in history.validations])

    config = config_of(scenes, steps=5)
    history = run(config, tmp_path / "net.safetensors", cache, on_validation=watch)
    assert seen == [[0], [0, 2], [0, 2, 4], [0, 2, 4, 5]]
    first, *later = history.validations
    assert first.gains == (Gain("exam", 0.06, 0.0),)
    assert math.isnan(first.loss)
    assert all(math.isfinite(entry.loss) for entry in later)


@pytest.mark.slow
def test_progress_is_reported_for_scenes_and_steps(scenes, cache, tmp_path):
    events: list[ProgressEvent] = []
    run(config_of(scenes, steps=3), tmp_path / "net.safetensors", cache, listener=events.append)
    found = [(event.stage, event.done, event.total) for event in events]
    assert found == [
        *(("prepare", done, 2) for done in (0, 1, 2)),
        *(("train", done, 3) for done in (1, 2, 3)),
    ]


@pytest.mark.slow
def test_the_same_training_gives_the_same_bytes(scenes, cache, tmp_path):
    for kind in ("scene", "local"):
        config, contents = config_of(scenes, kind=kind, steps=4), []
        for name in ("one", "two"):
            path = tmp_path / f"{kind}_{name}.safetensors"
            run(config, path, cache)
            contents.append((path.read_bytes(), path.with_suffix(".state").read_bytes()))
        assert contents[0] == contents[1]


@pytest.mark.slow
def test_the_random_state_of_torch_is_kept(scenes, cache, tmp_path):
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    run(config_of(scenes, steps=1), tmp_path / "net.safetensors", cache)
    assert torch.equal(torch.rand(3), wanted)


def test_the_best_network_is_kept(scenes, cache, tmp_path, monkeypatch):
    marks = Marks(0.0, 0.5, 0.2, 0.4)
    monkeypatch.setattr(train_loop, "validation_psnr", marks)
    path = tmp_path / "net.safetensors"
    history = run(config_of(scenes), path, cache)
    kept = load_checkpoint(path)
    assert history.best().step == kept.info.steps == 2
    assert bits_of(kept.net.state_dict()) == marks.nets[1]
    assert len({str(net) for net in marks.nets}) == 4


def test_the_last_network_is_kept_if_the_configuration_says_so(
    scenes, cache, tmp_path, monkeypatch
):
    marks = Marks(0.0, 0.5, 0.2, 0.4)
    monkeypatch.setattr(train_loop, "validation_psnr", marks)
    path = tmp_path / "net.safetensors"
    history = run(config_of(scenes, keep="last"), path, cache)
    kept = load_checkpoint(path)
    assert (history.best().step, kept.info.steps) == (2, 6)
    assert bits_of(kept.net.state_dict()) == marks.nets[-1]


@pytest.mark.parametrize("keep", ["best", "last"])
def test_a_missing_checkpoint_is_written_again(scenes, cache, tmp_path, monkeypatch, keep):
    gains = (0.0, 0.5) if keep == "best" else (0.0, -0.5)
    monkeypatch.setattr(train_loop, "validation_psnr", Marks(*gains))
    path, config = tmp_path / "net.safetensors", config_of(scenes, steps=2, keep=keep)
    run(config, path, cache)
    content = path.read_bytes()
    path.unlink()
    run(config, path, cache, resume=True)
    assert path.read_bytes() == content


def test_a_missing_checkpoint_that_the_state_does_not_hold_is_an_error(
    scenes, cache, tmp_path, monkeypatch
):
    monkeypatch.setattr(train_loop, "validation_psnr", Marks(0.0, -0.5))
    path, config = tmp_path / "net.safetensors", config_of(scenes, steps=2)
    run(config, path, cache)
    path.unlink()
    with pytest.raises(CheckpointError) as caught:
        run(config, path, cache, resume=True)
    assert str(caught.value) == (
        f"{path}: the network of the best validation is missing, and {path.with_suffix('.state')} "
        f"holds only a later one; restore the file, or train to another output."
    )
    assert not path.exists()


def test_training_stops_when_patience_runs_out(scenes, cache, tmp_path, monkeypatch):
    monkeypatch.setattr(train_loop, "validation_psnr", Marks(0.0, 0.5, 0.2, 0.4, 0.1, 0.9))
    config = config_of(scenes, steps=100, patience=2)
    history = run(config, tmp_path / "net.safetensors", cache)
    assert [entry.step for entry in history.validations] == [0, 2, 4, 6]


def test_without_any_gain_the_untrained_network_is_kept(scenes, cache, tmp_path, monkeypatch):
    monkeypatch.setattr(train_loop, "validation_psnr", Marks(0.0, -0.5, -0.2, -0.1))
    path = tmp_path / "net.safetensors"
    run(config_of(scenes), path, cache)
    kept = load_checkpoint(path)
    assert kept.info.steps == 0
    assert float(kept.net.decoder.weight.abs().amax()) == 0.0


def test_the_learning_rate_falls_once_or_twice():
    def rates(*steps, **settings):
        config = TrainConfig(learning_rate=0.4, restart_rate=0.2, **settings)
        return [train_loop._learning_rate(config, step) for step in steps]

    once = rates(0, 49, 500, 1000, steps=1000)
    assert once == pytest.approx([0.008, 0.4 * 0.9941, 0.2, 0.0], abs=1e-5)
    twice = rates(0, 500, 999, 1000, 1049, 1250, 1500, steps=1500, restart_step=1000)
    assert twice[:2] == once[:1] + once[2:3]
    assert twice[2:] == pytest.approx([0.0, 0.004, 0.2 * 0.97651, 0.1, 0.0], abs=1e-5)


@pytest.mark.slow
def test_a_training_may_start_from_a_checkpoint(scenes, cache, tmp_path):
    first, second = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    run(config_of(scenes, preset="paper"), first, cache)
    config = config_of(scenes, start=first, steps=1, learning_rate=1e-30)
    run(config.model_copy(update={"preset": "paper"}), second, cache)
    found, wanted = (load_checkpoint(path).net.state_dict() for path in (second, first))
    for name, values in wanted.items():
        torch.testing.assert_close(found[name], values, rtol=0, atol=1e-6)


@pytest.mark.parametrize("change", [{"width": 7}, {"cell_width": 11}, {"largest_growth": 1.5}])
def test_a_start_of_another_size_is_an_error(scenes, cache, tmp_path, change):
    first = tmp_path / "a.safetensors"
    run(config_of(scenes, steps=1), first, cache)
    with pytest.raises(
        ConfigError, match=r"has kind gated, width 6, cell_width 10, largest_growth 0\.6; the"
    ):
        run(config_of(scenes, start=first, **change), tmp_path / "b.safetensors", cache)


def test_a_missing_start_is_an_error(scenes, cache, tmp_path):
    config = config_of(scenes, start=tmp_path / "none.safetensors")
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        run(config, tmp_path / "net.safetensors", cache)


@pytest.mark.parametrize("bad", ["loss", "gradient"])
@pytest.mark.parametrize("kind", ["scene", "local"])
@pytest.mark.slow
def test_training_stops_at_a_loss_that_is_not_finite(
    scenes, cache, tmp_path, monkeypatch, kind, bad
):
    name, path, calls = f"{kind}_loss", tmp_path / "net.safetensors", []
    true_loss = getattr(train_loop, name)

    def loss(net, *arguments, **options) -> torch.Tensor:
        value = true_loss(net, *arguments, **options)
        calls.append(value)
        if len(calls) < 4:
            return value
        if bad == "loss":
            return value * math.nan
        zero = net.decoder.bias - net.decoder.bias.detach()
        return value + zero.abs().sqrt().sum()

    monkeypatch.setattr(train_loop, name, loss)
    with pytest.raises(TrainingError) as caught:
        run(config_of(scenes, kind=kind), path, cache)
    assert str(caught.value) == (
        f"the loss or its gradient is not finite at step 3, lesson at 0.05; "
        f"last good checkpoint: {path}."
    )
    assert load_checkpoint(path).info.steps in (0, 2)


@pytest.mark.slow
def test_a_failed_training_can_be_resumed(scenes, cache, tmp_path, monkeypatch):
    path, whole = tmp_path / "net.safetensors", tmp_path / "whole.safetensors"
    true_loss = train_loop.scene_loss
    with monkeypatch.context() as patch:
        patch.setattr(train_loop, "scene_loss", lambda *a, **o: true_loss(*a, **o) * math.inf)
        with pytest.raises(TrainingError):
            run(config_of(scenes), path, cache)
    run(config_of(scenes), path, cache, resume=True)
    run(config_of(scenes), whole, cache)
    assert path.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"ratios": (0.999,)}, "training"), ({"validation_ratios": (0.999,)}, "validation")],
)
def test_scenes_too_small_for_their_ratios_are_an_error(scenes, cache, tmp_path, changes, text):
    config = tiny_config(tiny_data(scenes, **changes))
    with pytest.raises(ConfigError, match=f"the {text} scenes are too small for their ratios"):
        run(config, tmp_path / "net.safetensors", cache)


def test_a_scene_that_cannot_be_used_is_named(tmp_path):
    scenes = write_scenes(tmp_path / "scenes", ["exam", "lesson"])
    broken = small_scene(20)
    broken = broken.with_tensors({"means": broken.means * math.nan}, {})
    cvtgs.save(broken, scenes / "broken.ply")
    with pytest.raises(InvalidSceneError, match="scene broken: automatic views need a scene"):
        run(config_of(scenes), tmp_path / "net.safetensors")


def test_a_cache_that_is_a_file_is_an_error(scenes, tmp_path):
    (tmp_path / "cache").write_text("precious")
    with pytest.raises(OutputError, match="must be a folder or a new path"):
        run(config_of(scenes), tmp_path / "net.safetensors", tmp_path / "cache")
    assert (tmp_path / "cache").read_text() == "precious"


def test_curves_that_cannot_be_drawn_do_not_end_a_training(scenes, cache, tmp_path, monkeypatch):
    def curves(history: History) -> bytes:
        raise ValueError("Key backend: 'bogus' is not a valid value")

    monkeypatch.setattr(History, "curves", curves)
    with pytest.warns(UserWarning, match="the curves are not drawn: Key backend: 'bogus'"):
        history = run(config_of(scenes, steps=1), tmp_path / "net.safetensors", cache)
    assert [entry.step for entry in history.validations] == [0, 1]


def test_without_matplotlib_there_is_a_network_and_no_image(scenes, cache, tmp_path, monkeypatch):
    def curves(history: History) -> bytes:
        raise MissingDependencyError("charts need matplotlib")

    monkeypatch.setattr(History, "curves", curves)
    (tmp_path / "net.png").write_bytes(b"the curves of an earlier training")
    run(config_of(scenes), tmp_path / "net.safetensors", cache, overwrite=True)
    assert (tmp_path / "net.safetensors").is_file()
    assert not (tmp_path / "net.png").exists()


@pytest.mark.slow
def test_scenes_may_have_double_precision(tmp_path):
    for number, name in enumerate(("exam", "lesson")):
        scene = small_scene(400 + number)
        double = {key: tensor.double() for key, tensor in scene.tensors().items()}
        cvtgs.save(scene.with_tensors(double, {}), tmp_path / f"{name}.ply")
    assert cvtgs.load(tmp_path / "exam.ply").dtype == torch.float64
    run(tiny_config(tiny_data(tmp_path)), tmp_path / "net.safetensors")
