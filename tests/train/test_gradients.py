"""Gradients of a step of several cases: their mean, alone and in processes."""

import math
from pathlib import Path

import pytest
import torch

from cvtgs.errors import TrainingError
from cvtgs.mergenet import load_checkpoint
from cvtgs.train import TrainConfig, TrainFiles, loop as train_loop
from cvtgs.train.cases import DeviceCopies
from cvtgs.train.scenes import find_sources, prepare_scene
from train_cases import bits_of, run, small_net, tiny_config, tiny_data, write_scenes

COPIES = DeviceCopies(torch.device("cpu"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    return write_scenes(tmp_path_factory.mktemp("scenes"), ["exam", "first", "second", "third"])


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


def config_of(scenes: Path, **changes) -> TrainConfig:
    return tiny_config(tiny_data(scenes), width=6, cell_width=10, **changes)


def cases_of(config: TrainConfig, cache: Path) -> list[train_loop.CaseWithViews]:
    sources = find_sources(config.data, seed=config.seed)
    prepared = [prepare_scene(one, config, cache) for one in sources if not one.is_validation]
    return [(case, scene.views) for scene in prepared for case in scene.cases]


def results_of(config: TrainConfig, cache: Path, step: int = 3) -> list[train_loop.CaseGradient]:
    cases = cases_of(config, cache)
    with train_loop.step_gradients(cases, config, cache, COPIES) as compute:
        return compute(small_net(), step)


@pytest.mark.long
def test_the_cases_of_a_step_differ_and_are_the_same_every_time(scenes, cache):
    config = config_of(scenes, cases_per_step=4)
    results = results_of(config, cache)
    assert len({result.loss for result in results}) == 4
    assert [result.loss for result in results_of(config, cache)] == [one.loss for one in results]
    assert len({one.loss for one in results + results_of(config, cache, step=4)}) == 8


@pytest.mark.slow
def test_the_first_case_of_a_step_does_not_depend_on_their_number(scenes, cache):
    one, two = (results_of(config_of(scenes, cases_per_step=count), cache) for count in (1, 2))
    assert one[0].loss == two[0].loss
    assert (len(one), len(two)) == (1, 2)


@pytest.mark.long
def test_processes_compute_what_one_does(scenes, cache, monkeypatch):
    config = config_of(scenes, cases_per_step=2)
    alone = results_of(config, cache)
    monkeypatch.setattr(train_loop, "thread_count", lambda: 2)
    together = results_of(config, cache)
    for ours, theirs in zip(alone, together, strict=True):
        assert ours.name == theirs.name
        assert theirs.loss == pytest.approx(ours.loss, rel=1e-5)
        for some, others in zip(ours.gradients, theirs.gradients, strict=True):
            torch.testing.assert_close(others, some, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_a_step_follows_the_mean_gradient(scenes, cache, tmp_path, monkeypatch):
    config = config_of(scenes, cases_per_step=2, steps=1)
    seen: list[torch.Tensor] = []
    clip = torch.nn.utils.clip_grad_norm_

    def watched(parameters, *arguments):
        parameters = list(parameters)
        seen.extend(parameter.grad.clone() for parameter in parameters)
        return clip(parameters, *arguments)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", watched)
    run(config, tmp_path / "net.safetensors", cache)
    cases = cases_of(config, cache)
    net = train_loop._first_net(config)
    net.known.fit(train_loop.summarize(case.descriptors) for case, _ in cases)
    with train_loop.step_gradients(cases, config, cache, COPIES) as compute:
        first, second = compute(net, 0)
    for gradient, one, other in zip(seen, first.gradients, second.gradients, strict=True):
        torch.testing.assert_close(gradient, (one + other) / 2)


@pytest.mark.long
def test_a_resumed_training_of_several_cases_gives_the_same_bits(scenes, cache, tmp_path):
    config = config_of(scenes, cases_per_step=3, steps=4)
    run(config, tmp_path / "whole.safetensors", cache)
    files = TrainFiles.beside(tmp_path / "parts.safetensors", cache)

    def stop(event) -> None:
        if event.stage == "train" and event.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_loop.train(config, files, listener=stop)
    train_loop.train(config, files, resume=True)
    whole, parts = (
        load_checkpoint(tmp_path / f"{name}.safetensors") for name in ("whole", "parts")
    )
    assert bits_of(whole.net.state_dict()) == bits_of(parts.net.state_dict())


def test_a_bad_loss_names_its_own_scene(scenes, cache, tmp_path, monkeypatch):
    whole = train_loop.scene_loss

    def spoilt(net, case, views, **options):
        loss = whole(net, case, views, **options)
        return loss * math.nan if case.scene_name == "third" else loss

    monkeypatch.setattr(train_loop, "scene_loss", spoilt)
    monkeypatch.setattr(train_loop, "thread_count", lambda: 1)  # no processes, which have their own
    with pytest.raises(TrainingError, match="third at"):
        run(config_of(scenes, cases_per_step=3, steps=20), tmp_path / "net.safetensors", cache)
