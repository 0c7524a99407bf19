"""Training gains quality, also on unseen scenes and views."""

import hashlib
import json
import random
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.evaluation import psnr
from cvtgs.mergenet import LearnedScene, load_checkpoint, summarize
from cvtgs.rendering import render
from cvtgs.train import DataConfig, Gain, History, TrainConfig, TrainFiles
from cvtgs.train.losses import local_loss, scene_loss
from cvtgs.views import automatic_views
from train_cases import (
    needs_matplotlib,
    run,
    small_net,
    small_scene,
    some_case,
    some_views,
    tiny_config,
    tiny_data,
    write_scenes,
)

pytestmark = needs_matplotlib
COUNT = 1200
UNSEEN = 7
"""Seed of a scene that is used for neither training nor validation."""


@dataclass(frozen=True)
class Trained:
    config: TrainConfig
    history: History
    files: TrainFiles


@pytest.fixture(scope="module", params=["scene", "local"])
def trained(request, tmp_path_factory) -> Trained:
    """The preset ``paper`` leaves most to be learned, so little training gains much."""
    folder = tmp_path_factory.mktemp("scenes")
    write_scenes(folder, ["lesson", "exam", "lesson2"], COUNT)
    config = tiny_config(
        tiny_data(folder),
        kind=request.param,
        preset="paper",
        steps=70,
        validate_every=35,
        learning_rate=0.01,
        seed=3,
    )
    name = tmp_path_factory.mktemp("out") / "net.safetensors"
    history = run(config, name)
    return Trained(config, history, TrainFiles.beside(name))


@pytest.mark.long
def test_an_unseen_scene_gains(trained):
    start, *later = trained.history.validations
    assert start.gains == (Gain("exam", 0.06, 0.0),)
    assert all(entry.mean_gain > 0.5 for entry in later)
    assert trained.history.best().mean_gain > 1.0


@pytest.mark.long
def test_a_training_scene_gains_in_unseen_views(trained):
    """Other views, at another ratio, through the simplifier and the file that was written."""
    scene = small_scene(COUNT, seed=0)
    views = automatic_views(scene, 2, width=48, height=40, seed=9)
    found = {}
    for ckpt in (None, trained.files.checkpoint):
        small = cvtgs.Simplifier(ckpt, config="paper", device="cpu").simplify(scene, 0.07)
        images = render(scene, views).rgb, render(small, views).rgb
        found[ckpt] = psnr(*images).mean().item()
    assert found[trained.files.checkpoint] > found[None] + 1.0


@pytest.mark.slow
def test_the_loss_of_an_unseen_scene_falls(trained):
    config = trained.config
    case = some_case(COUNT, seed=UNSEEN, ratio=0.05, preset="paper")
    views = some_views(COUNT, seed=UNSEEN)

    def loss(net) -> float:
        total = 0.0
        for seed in range(4):
            rng = random.Random(seed)
            if config.kind == "local":
                total += local_loss(net, case, config=config, rng=rng).item()
            else:
                total += scene_loss(net, case, views, config=config, rng=rng).item()
        return total / 4

    net = load_checkpoint(trained.files.checkpoint).net
    assert loss(net) < loss(small_net()) - 0.05


@pytest.mark.slow
def test_the_checkpoint_is_described(trained):
    info = load_checkpoint(trained.files.checkpoint).info
    assert info.preset == "paper"
    assert info.training == f"{trained.config.kind} training"
    assert info.steps == trained.history.best().step > 0
    assert (info.seed, info.version) == (3, cvtgs.__version__)
    assert (info.architecture.width, info.architecture.cell_width) == (6, 10)


@pytest.mark.slow
def test_the_checkpoint_records_how_to_reproduce_it(trained):
    info = load_checkpoint(trained.files.checkpoint).info
    told = json.loads(info.config)
    assert "folders" not in told["data"]
    assert "start" not in told
    folders = trained.config.data.folders
    data = DataConfig(**told.pop("data"), folders=folders)
    assert TrainConfig(**told, data=data) == trained.config
    assert info.start == ""
    assert info.scenes == tuple(
        LearnedScene(
            name=name,
            count=COUNT,
            sha256=hashlib.sha256((folders[0] / f"{name}.ply").read_bytes()).hexdigest(),
            is_validation=name == "exam",
        )
        for name in ("exam", "lesson", "lesson2")
    )


@pytest.mark.long
def test_a_second_training_names_the_first(trained, tmp_path):
    """It discards the known range of the first: only its own training cases count."""
    folders = (write_scenes(tmp_path / "other", ["exam", "lesson"]),)
    config = trained.config.model_copy(
        update={
            "start": trained.files.checkpoint,
            "steps": 1,
            "validate_every": 1,
            "data": trained.config.data.model_copy(update={"folders": folders}),
        }
    )
    run(config, tmp_path / "second.safetensors")
    first, second = (
        load_checkpoint(path)
        for path in (trained.files.checkpoint, tmp_path / "second.safetensors")
    )
    assert second.info.start == first.digest
    assert [scene.count for scene in second.info.scenes] == [600, 600]
    assert not torch.equal(first.net.known.low, second.net.known.low)


@pytest.mark.slow
def test_the_known_range_is_that_of_the_training_cases(trained):
    """Most training cells are within it; very different cells are not."""
    known = load_checkpoint(trained.files.checkpoint).net.known
    lessons = some_case(COUNT, seed=1, ratio=0.05, preset="paper")
    shares = known(summarize(lessons.descriptors))
    assert float(shares.mean()) > 0.8
    wild = replace(lessons.descriptors, cells=lessons.descriptors.cells + 100)
    assert not bool(known(summarize(wild)).any())


@pytest.mark.slow
def test_curves_are_an_image(trained):
    content = trained.files.curves.read_bytes()
    assert content == trained.history.curves()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_no_other_files_are_left_behind(trained):
    folder = Path(trained.files.checkpoint).parent
    names = {path.name for path in folder.iterdir()}
    assert names == {"net.safetensors", "net.state", "net.png", "net.cache"}
    assert len(list(trained.files.cache.iterdir())) == 6
