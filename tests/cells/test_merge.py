"""Cells become Gaussians: hand-computed merges, cells of one, chunks, extra columns."""

import math

import pytest
import torch

from cvtgs import GaussianScene
from cvtgs.cells import Partition, merge_cells
from cvtgs.config import MergeConfig, SimplifyConfig
from scenes import random_scene, same_bits

PAPER = SimplifyConfig.from_preset("paper").merge
STANDARD = SimplifyConfig.from_preset("standard").merge
CONFIGS = {"paper": PAPER, "standard": STANDARD}
each_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
INF = float("inf")


def merged(
    scene: GaussianScene, labels: list[int] | torch.Tensor, config: MergeConfig
) -> GaussianScene:
    labels = torch.as_tensor(labels)
    cells = Partition.from_labels(labels, int(labels.amax()) + 1)
    return merge_cells(scene, cells, config=config)


def pair(opacities: tuple[float, float], sizes: tuple[float, float]) -> GaussianScene:
    """Two round Gaussians at x = 0 and x = 4."""
    quats = torch.tensor([[1.0, 0, 0, 0], [0.5, 0.5, 0.5, 0.5]], dtype=torch.float64)
    a = torch.tensor(opacities, dtype=torch.float64)
    return GaussianScene(
        means=torch.tensor([[0.0, 0, 0], [4.0, 0, 0]], dtype=torch.float64),
        quats=quats,
        log_scales=torch.tensor(sizes, dtype=torch.float64).log()[:, None].repeat(1, 3),
        logit_opacities=torch.logit(a),
        sh0=torch.tensor([[[0.0, 1.0, 2.0]], [[4.0, 1.0, -2.0]]], dtype=torch.float64),
        shN=torch.zeros(2, 0, 3, dtype=torch.float64),
    )


def area_of_needle(long: float, thin: float) -> float:
    p = 1.6075
    return math.pi * ((2 * (long * thin) ** p + thin ** (2 * p)) / 3) ** (1 / p)


def test_two_gaussians_in_the_paper():
    """Weights 1/4 and 3/4 by opacity: mean 3, variance along x 1 + 3/16 * 16 = 4, else 1."""
    small = merged(pair((0.25, 0.75), (1.0, 1.0)), [0, 0], PAPER)
    torch.testing.assert_close(small.means, torch.tensor([[3.0, 0, 0]]).double())
    torch.testing.assert_close(small.scales, torch.tensor([[2.0, 1, 1]]).double())
    assert small.sh0.flatten().tolist() == pytest.approx([3.0, 1.0, -1.0])
    assert small.opacities.item() == pytest.approx(1 - 0.75 * 0.25)


def test_two_gaussians_by_mass():
    """Areas pi and 4 pi, opacities 0.8 and 0.2: equal weights, mean 2, variances 6.5 and 2.5."""
    config = MergeConfig(area_power=1.0, opacity="saturating")
    small = merged(pair((0.8, 0.2), (1.0, 2.0)), [0, 0], config)
    torch.testing.assert_close(small.means, torch.tensor([[2.0, 0, 0]]).double())
    long, thin = math.sqrt(6.5), math.sqrt(2.5)
    torch.testing.assert_close(small.scales, torch.tensor([[long, thin, thin]]).double())
    depth = (-math.log(0.2) * math.pi - math.log(0.8) * 4 * math.pi) / area_of_needle(long, thin)
    assert small.opacities.item() == pytest.approx(1 - math.exp(-depth))


@each_config
def test_a_cell_of_one_is_returned_bit_for_bit(config):
    scene = random_scene(6, degree=3)
    quats, logits = scene.quats.clone(), scene.logit_opacities.clone()
    quats[0] *= 1e-20
    quats[1] *= -7.0
    logits[:4] = torch.tensor([INF, -INF, 700.0, -700.0])
    scene = scene.with_tensors({"quats": quats, "logit_opacities": logits}, {"a": logits})
    assert same_bits(merged(scene, [0, 1, 2, 3, 4, 5], config), scene)
    some = merged(scene, [2, 0, 1, 3, 3, 3], config)
    assert same_bits(some.select(torch.tensor([0, 1, 2])), scene.select(torch.tensor([1, 2, 0])))


@each_config
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_shapes_and_dtypes(degree, dtype, config):
    scene = random_scene(20, degree=degree, dtype=dtype)
    small = merged(scene, torch.arange(20) % 3, config)
    assert len(small) == 3
    assert small.sh_degree == degree
    assert small.dtype == dtype


@each_config
def test_identical_members_change_neither_place_nor_shape_nor_colour(config):
    one = random_scene(1, dtype=torch.float64)
    small = merged(one.select(torch.zeros(5, dtype=torch.int64)), [0] * 5, config)
    torch.testing.assert_close(small.means, one.means)
    torch.testing.assert_close(small.scales, one.scales.sort(descending=True).values)
    torch.testing.assert_close(small.sh, one.sh)


@each_config
@pytest.mark.parametrize("limit", [1, 10, 37])
def test_chunks_do_not_change_a_bit(monkeypatch, limit, config):
    scene = random_scene(300, degree=2)
    scene = scene.with_tensors({}, {"a": torch.rand(300), "b": torch.arange(300)})
    labels = torch.randint(0, 40, (300,), generator=torch.Generator().manual_seed(0))
    labels[:40] = torch.arange(40)
    whole = merged(scene, labels, config)
    monkeypatch.setitem(merge_cells.__globals__, "CHUNK_MEMBERS", limit)
    assert same_bits(merged(scene, labels, config), whole)


def test_extra_columns_of_floats_are_averaged_and_of_integers_taken_from_the_heaviest():
    scene = pair((0.25, 0.75), (1.0, 1.0))
    extras = {
        "heat": torch.tensor([1.0, 5.0]),
        "half": torch.tensor([1.0, 5.0], dtype=torch.float16),
        "label": torch.tensor([7, 9], dtype=torch.uint8),
        "flag": torch.tensor([False, True]),
    }
    small = merged(scene.with_tensors({}, extras), [0, 0], PAPER)
    assert small.extras["heat"].item() == pytest.approx(4.0)
    assert small.extras["half"].item() == 4.0
    assert small.extras["label"].item() == 9
    assert small.extras["flag"].item() is True
    assert {name: column.dtype for name, column in small.extras.items()} == {
        name: column.dtype for name, column in extras.items()
    }


def test_integers_come_from_the_heaviest_not_the_most_opaque():
    scene = pair((0.9, 0.1), (1.0, 10.0)).with_tensors({}, {"label": torch.tensor([7, 9])})
    assert merged(scene, [0, 0], STANDARD).extras["label"].item() == 9


@each_config
def test_comments_and_layout_are_kept(config):
    scene = random_scene(4)
    tagged = GaussianScene(
        **scene.tensors(), comments=("SplatRenderMode: mip",), layout=(("x", "float"),)
    )
    small = merged(tagged, [0, 0, 1, 1], config)
    assert small.comments == tagged.comments
    assert small.layout == tagged.layout


def test_done_cells_are_told(monkeypatch):
    monkeypatch.setitem(merge_cells.__globals__, "CHUNK_MEMBERS", 4)
    scene, told = random_scene(10), []
    cells = Partition.from_labels(torch.tensor([0, 0, 1, 2, 2, 2, 3, 3, 4, 0]), 5)
    merge_cells(scene, cells, config=STANDARD, on_cells=told.append)
    assert told == [3, 4, 5]


def test_input_is_not_changed():
    scene = random_scene(30)
    before = scene.select(torch.arange(30))
    merged(scene, torch.arange(30) % 7, STANDARD)
    assert same_bits(scene, before)
