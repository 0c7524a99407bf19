"""The ablation from end to end on a tiny scene, and the k-NN grouping that it compares with."""

import sys

import numpy as np
import pytest
import torch

import cvtgs
import lpips_cases
from benchmarks import ablation, quality
from benchmarks.ablation import grouped_simplifier, nearest_groups, regroup
from cvtgs.mergenet import load_checkpoint
from cvtgs.train.cases import merge_scene

pytestmark = pytest.mark.slow

JUDGE = """
import json, sys
print(json.dumps([{"psnr": 20.0 + k, "ssim": 0.5} for k in range(len(sys.argv) - 2)]))
"""


@pytest.fixture
def scene() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 2000, sh_degree=1, seed=0)


@pytest.fixture
def file(scene, tmp_path):
    cvtgs.save(scene, tmp_path / "thing.ply")
    return tmp_path / "thing.ply"


@pytest.fixture(autouse=True)
def _small_images(monkeypatch):
    monkeypatch.setattr(quality, "VIEWS", 2)
    monkeypatch.setattr(quality, "SIZE", 48)


def groups_one_by_one(places: np.ndarray, seeds: list[int]) -> list[int]:
    """Every seed takes its nearest free points in turn; the rest join their nearest seed."""
    labels = {row: group for group, row in enumerate(seeds)}
    for group, seed in enumerate(seeds):
        free = [row for row in range(len(places)) if row not in labels]
        free.sort(key=lambda row: sum((places[row] - places[seed]) ** 2))
        labels |= dict.fromkeys(free[: len(places) // len(seeds) - 1], group)
    for row in set(range(len(places))) - set(labels):
        distances = [sum((places[row] - places[seed]) ** 2) for seed in seeds]
        labels[row] = distances.index(min(distances))
    return [labels[row] for row in range(len(places))]


def rows_of(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_grouping_by_hand():
    """Groups of two, and the compact ones where one seed falls on each side."""
    points = torch.tensor([[0.0], [1.0], [9.0], [8.0]])
    found = {tuple(nearest_groups(points, 2, seed=seed).tolist()) for seed in range(20)}
    assert {(0, 0, 1, 1), (1, 1, 0, 0)} <= found
    assert all(sorted(labels) == [0, 0, 1, 1] for labels in found)


@pytest.mark.parametrize("count", [1, 7, 20, 100, 119, 240])
def test_grouping_equals_the_scalar_oracle(count):
    points = torch.randn(240, 3, generator=torch.Generator().manual_seed(1))
    seeds = torch.randperm(240, generator=torch.Generator().manual_seed(3))[:count].tolist()
    labels = nearest_groups(points, count, seed=3)
    assert labels.tolist() == groups_one_by_one(points.double().numpy(), seeds)


@pytest.mark.parametrize("count", [1, 30, 700, 1999, 2000])
def test_every_gaussian_is_in_one_group_and_no_group_is_empty(scene, count):
    labels = nearest_groups(scene.means, count, seed=0)
    sizes = labels.bincount(minlength=count)
    assert labels.shape == (2000,)
    assert len(sizes) == count
    assert int(sizes.amin()) >= 2000 // count
    assert int(sizes.sum()) == 2000


def test_coincident_points_are_grouped_too():
    sizes = nearest_groups(torch.zeros(50, 3), 7, seed=0).bincount(minlength=7)
    assert sorted(sizes.tolist()) == [7, 7, 7, 7, 7, 7, 8]


@pytest.mark.parametrize("preset", ablation.PRESETS)
def test_groups_are_merged_as_the_stages_merge_cells(scene, preset):
    config, net = cvtgs.SimplifyConfig.from_preset(preset), load_checkpoint(preset).net
    reference = merge_scene(scene, 100, config)
    small = regroup(reference, reference.partition, config, net=net)
    wanted = cvtgs.Simplifier(preset, device="cpu").simplify(scene, count=100)
    for name, values in wanted.tensors().items():
        assert torch.equal(getattr(small, name), values), name


def test_grouping_ignores_filtered_gaussians(scene):
    faint = torch.full_like(scene.logit_opacities, -5.0)
    faint[:300] = 1.0
    mostly_faint = scene.with_tensors({"logit_opacities": faint}, scene.extras)
    config = cvtgs.SimplifyConfig.from_preset("paper")
    small = grouped_simplifier(config, None)(mostly_faint, 0.15)
    assert set(map(tuple, small.means.tolist())) == set(map(tuple, scene.means[:300].tolist()))


def test_a_ratio_that_keeps_all_leaves_nothing_to_group(scene):
    small = grouped_simplifier(cvtgs.SimplifyConfig.from_preset("paper"), None)(scene, 1.0)
    assert torch.equal(small.means, scene.means)


@pytest.mark.slow
def test_the_table_and_the_files_are_complete(file, tmp_path, capsys):
    ablation.main([str(file), "--rho", "0.05", "-o", str(tmp_path / "new")])
    text = capsys.readouterr().out
    head, _, *rows = rows_of(text)
    names = ("PSNR", "SSIM", "LPIPS", "alpha error")
    assert head == ["scene", "variant", *(f"{name} at 0.05" for name in names)]
    parts = ["w/o CVT", "w/o filter", "w/o MergeNet", "full"]
    variants = [
        *(f"paper, {part}" for part in [*parts, "our network"]),
        *(f"standard, {part}" for part in parts),
    ]
    assert [row[:2] for row in rows] == [
        [scene, variant] for scene in ("mean", "thing") for variant in variants
    ]
    assert all(5 < float(row[2]) < 60 and 0 < float(row[3]) <= 1 for row in rows)
    assert {row[4] for row in rows} == {"-"}
    assert all(0 < float(row[5]) < 1 for row in rows)
    assert (tmp_path / "new" / "ablation.md").read_text().strip() == text.strip()
    assert (tmp_path / "new" / "ablation.png").read_bytes()[1:4] == b"PNG"


def test_lpips_is_measured_with_weights(file, tmp_path, capsys):
    torch.save(dict(lpips_cases.random_state("alex")), tmp_path / "weights.pth")
    weights = str(tmp_path / "weights.pth")
    ablation.main([str(file), "--rho", "0.05", "--means", "--lpips", weights])
    _, _, *rows = rows_of(capsys.readouterr().out)
    assert len(rows) == 9
    assert all(float(row[4]) > 0 for row in rows)


def test_another_judge_gets_every_small_scene(file, tmp_path, capsys):
    (tmp_path / "judge.py").write_text(JUDGE)
    command = f"{sys.executable} {tmp_path / 'judge.py'} {{full}} {{small}}"
    ablation.main([str(file), "--rho", "0.1", "0.05", "--means", "--scorer", command])
    _, _, *rows = rows_of(capsys.readouterr().out)
    found = [float(row[column]) for row in rows for column in (2, 6)]
    assert found == [20.0 + number for number in range(18)]


def test_means_are_over_scenes_and_unknown_lpips_stays_unknown():
    low = quality.Quality(psnr=20.0, ssim=0.5, lpips=0.2, alpha_error=0.25)
    high = quality.Quality(psnr=30.0, ssim=0.7, alpha_error=0.75)
    table = {"a": {"full": [low, low]}, "b": {"full": [high, low]}}
    mixed, same = quality.means(table)["full"]
    assert mixed == quality.Quality(psnr=25.0, ssim=0.6, lpips=None, alpha_error=0.5)
    assert same == low
    assert quality.markdown(table, [0.1, 0.01], means_only=True).splitlines()[-1] == (
        "| mean | full | 25.00 | 0.6000 | - | 0.5000 | 20.00 | 0.5000 | 0.2000 | 0.2500 |"
    )
