"""Training as published: crops of single cells, all bands, and a loop that learns from them."""

import random

import pytest
import torch

from cvtgs.losses import image_loss
from cvtgs.math import parameters, spherical_harmonics
from cvtgs.mergenet import (
    PublishedArchitecture,
    PublishedMergeNet,
    load_checkpoint,
)
from cvtgs.rendering import render
from cvtgs.train import TrainConfig
from cvtgs.train.losses import cut_crops, lay_out_cells, published_loss
from train_cases import History, run, some_case, tiny_config, tiny_data, write_scenes

TILE = 16


def net_of(*, scale: float = 0.0) -> PublishedMergeNet:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = PublishedMergeNet(PublishedArchitecture(width=6, cell_width=10))
        if scale:
            torch.nn.init.normal_(net.residuals.weight, std=scale)
    return net


def grid_of(case, *, count: int, changes: dict | None = None, all_bands: bool = True):
    cells, part = case.cells[:count], case.part.select(torch.arange(count))
    same = case.reference.merged.select(cells).tensors()
    return lay_out_cells(
        case.reference,
        cells,
        part,
        same | (changes or {}),
        rng=random.Random(0),
        tile=TILE,
        apart=2,
        all_bands=all_bands,
    )


def test_crops_are_the_tiles_of_their_cells():
    """A grid of two by two tiles, two pixels wide and four apart, whose pixels are counted."""
    image = torch.arange(64.0).reshape(1, 8, 8, 1).expand(1, 8, 8, 3)
    crops = cut_crops(image, 3, 2, 2)[..., 0]
    assert crops.tolist() == [
        [[9, 10], [17, 18]],
        [[13, 14], [21, 22]],
        [[41, 42], [49, 50]],
    ]


def test_a_cell_changes_its_own_crop_only():
    case = some_case(1500, ratio=0.1)
    merged = case.reference.merged.select(case.cells[:9])
    larger = merged.logit_opacities.clone()
    larger[4] = 6.0
    grids = (grid_of(case, count=9), grid_of(case, count=9, changes={"logit_opacities": larger}))
    before, after = (
        cut_crops(render(grid.corrected, grid.camera, background=torch.zeros(3)).rgb, 9, TILE, 2)
        for grid in grids
    )
    changed = (before != after).flatten(1).any(dim=1)
    assert changed.nonzero()[:, 0].tolist() == [4]


def test_no_window_reaches_across_cells():
    """The loss of several crops is the mean of their own losses."""
    g = torch.Generator().manual_seed(0)
    images, targets = torch.rand(2, 4, TILE, TILE, 3, generator=g).unbind(0)
    single = [image_loss(images[i : i + 1], targets[i : i + 1]).item() for i in range(len(images))]
    assert image_loss(images, targets).item() == pytest.approx(sum(single) / 4, rel=1e-5)


def test_colours_use_all_bands_in_the_direction_of_the_camera():
    case = some_case(600, seed=1)  # of degree 1
    merged = case.reference.merged.select(case.cells[:4])
    assert merged.shN.shape[1] == 3
    grid = grid_of(case, count=4)
    turns = parameters.multiply_quats(
        grid.corrected.quats,
        parameters.normalize_quats(merged.quats) * torch.tensor([1, -1, -1, -1]),
    )
    forward = parameters.quats_to_matrices(turns).mT @ torch.tensor([0.0, 0.0, 1.0])
    wanted = spherical_harmonics.evaluate(merged.sh0, merged.shN, forward)
    found = 0.5 + spherical_harmonics.SH_C0 * grid.corrected.sh0[:, 0]
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    assert not torch.allclose(
        grid.corrected.sh0, grid_of(case, count=4, all_bands=False).corrected.sh0
    )


def test_the_loss_is_the_published_one_without_a_logarithm():
    case = some_case(1500, ratio=0.1)
    config = TrainConfig(kind="published", cells=4, tile=TILE)
    found = published_loss(net_of(), case, config=config, rng=random.Random(5)).item()
    rng = random.Random(5)
    rows = torch.tensor(sorted(rng.sample(range(len(case.cells)), 4)))
    background = torch.tensor([rng.random() for _ in range(3)])
    grid = lay_out_cells(
        case.reference,
        case.cells[rows],
        case.part.select(rows),
        case.reference.merged.select(case.cells[rows]).tensors(),
        rng=rng,
        tile=TILE,
        apart=2,
        all_bands=True,
    )
    image, target = (
        cut_crops(render(scene, grid.camera, background=background).rgb, 4, TILE, 2)
        for scene in (grid.corrected, grid.members)
    )
    assert found == pytest.approx(image_loss(image, target).item(), rel=1e-5)


def test_gradients_reach_every_residual_once_the_last_layer_is_not_zero():
    case = some_case(600, seed=1)
    net, config = net_of(scale=0.01), TrainConfig(kind="published", cells=9, tile=TILE)
    published_loss(net, case, config=config, rng=random.Random(0)).backward()
    moved = net.residuals.bias.grad != 0
    assert bool(moved[: 10 + 3 * 4].all())  # the scene has degree 1
    assert not bool(moved[10 + 3 * 4 :].any())
    assert all(bool((values.grad != 0).any()) for values in net.parameters())


@pytest.mark.parametrize(("members", "drawn"), [(1, 1), (40, None), (10**6, 9)])
def test_a_step_respects_the_limit_of_members(monkeypatch, members, drawn):
    case, taken = some_case(600, ratio=0.05), []
    net, forward = net_of(), PublishedMergeNet.forward
    monkeypatch.setattr(
        PublishedMergeNet,
        "forward",
        lambda net, found: taken.append(found) or forward(net, found),
    )
    config = TrainConfig(kind="published", cells=9, members=members, tile=TILE)
    published_loss(net, case, config=config, rng=random.Random(0))
    cells = len(taken[0].offsets) - 1
    assert cells == drawn if drawn else len(taken[0].members) <= members < 60
    assert cells >= 1


@pytest.mark.long
def test_a_training_run_gains_resumes_and_records_its_kind(tmp_path, monkeypatch):
    monkeypatch.setattr(History, "curves", lambda history: b"an image")
    scenes = write_scenes(tmp_path / "scenes", ["lesson", "exam", "lesson2"], 1500)
    config = tiny_config(
        tiny_data(scenes, validation_ratios=(0.06,)),
        kind="published",
        preset="paper",
        steps=120,
        validate_every=60,
        cells=25,
        tile=TILE,
        learning_rate=1e-2,
    )
    whole, cut = tmp_path / "whole.safetensors", tmp_path / "cut.safetensors"
    history = run(config, whole, tmp_path / "cache")
    assert history.best().mean_gain > 0.3

    def stop(event) -> None:
        if event.stage == "train" and event.done == 70:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(config, cut, tmp_path / "cache", listener=stop)
    run(config, cut, tmp_path / "cache", resume=True)
    assert cut.read_bytes() == whole.read_bytes()
    info = load_checkpoint(whole).info
    assert (info.architecture.kind, info.preset) == ("published", "paper")


def test_a_start_of_the_other_kind_is_an_error(tmp_path):
    scenes = write_scenes(tmp_path / "scenes", ["lesson", "exam"], 300)
    config = tiny_config(tiny_data(scenes), kind="published", start="standard")
    with pytest.raises(ValueError, match=r"start: standard has kind gated, .* kind published"):
        run(config, tmp_path / "net.safetensors", tmp_path / "cache")
