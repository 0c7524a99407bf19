"""Out-of-core runs: exact counts, the same bits in any order of work, seams, unusual files."""

import json
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig, grouping
from cvtgs.boxes import Box
from cvtgs.cli.main import main
from cvtgs.counts import shared_out
from cvtgs.devices import one_thread
from cvtgs.errors import ConfigError, FileFormatError, InvalidArgumentError, InvalidSceneError
from cvtgs.evaluation import EvaluationSettings
from cvtgs.io.ply import open_rows
from cvtgs.math.frames import robust_frame
from cvtgs.outofcore import allocate, scan as scan_module, simplify_file
from cvtgs.outofcore.memory import SMALL_BASE_BYTES, block_count, needed_memory, read_bytes
from cvtgs.outofcore.scan import (
    RangeTotals,
    add_totals,
    in_cells,
    partition_space,
    scan_range,
    scan_scene,
)
from cvtgs.views import automatic_views
from scenes import random_scene, same_bits


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("courtyard", 6000, sh_degree=1, seed=4)


@pytest.fixture(scope="module")
def source(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("blocks") / "in.ply"
    cvtgs.save(scene, path)
    return path


def test_heavy_gaussians_need_one_cell_and_light_ones_a_share():
    weights = torch.tensor([0.5, 2.0, 8.0])
    assert in_cells(weights, 2.0).tolist() == [0.25, 1.0, 1.0]
    assert in_cells(weights, 0.0).tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("total", "shares", "rooms", "wanted"),
    [
        (10, [1.0, 1.0, 2.0], [9, 9, 9], [3, 2, 5]),
        (3, [0.0, 0.0, 1.0], [5, 5, 5], [1, 1, 1]),
        (12, [1.0, 1.0, 1.0], [2, 9, 9], [2, 5, 5]),
        (7, [0.0, 0.0], [0, 7], [0, 7]),
        (0, [1.0], [0], [0]),
    ],
)
def test_counts_are_shared_out(total, shares, rooms, wanted):
    assert shared_out(total, shares, rooms=rooms) == wanted


def test_shared_counts_always_add_up():
    g = torch.Generator().manual_seed(0)
    for _ in range(300):
        n = int(torch.randint(1, 9, (), generator=g))
        rooms = (torch.randint(0, 5, (n,), generator=g) ** 4).tolist()
        shares = torch.exp(5 * torch.randn(n, generator=g, dtype=torch.float64)).tolist()
        least = sum(min(1, room) for room in rooms)
        total = int(torch.randint(least, sum(rooms) + 1, (), generator=g))
        counts = shared_out(total, shares, rooms=rooms)
        assert sum(counts) == total
        assert all(min(1, b) <= a <= b for a, b in zip(counts, rooms, strict=True))
    with pytest.raises(InvalidArgumentError, match="between 1 and 2"):
        shared_out(3, [1.0], rooms=[2])


@pytest.mark.parametrize("count", [1, 2, 3, 7, 16])
def test_blocks_have_equal_measure_despite_far_outliers(count):
    g = torch.Generator().manual_seed(1)
    points = torch.randn(4000, 3, generator=g, dtype=torch.float64)
    points[:5] *= 1e12
    measure = torch.rand(4000, generator=g, dtype=torch.float64)
    blocks = partition_space(points, measure, count).blocks_of(points)
    sums = torch.bincount(blocks, measure, minlength=count)
    assert len(sums) == count
    assert float((sums / sums.sum() * count - 1).abs().max()) < 0.05


@pytest.mark.parametrize(
    ("share", "most"), [(0.07, 4.0), (0.0699, 2.0), (0.01, 1.0), (0.009, -1.0), (0.0, -1.0)]
)
def test_the_lightest_flyaways_are_left_out_up_to_their_share_of_the_mass(share, most):
    """Those of 1, 2 and 4 make up 7 % of a mass of 100."""
    totals = RangeTotals(
        depths=torch.zeros(0, dtype=torch.int64),
        masses=(1e9,),
        falloff_masses=(60.0, 40.0),
        far_masses=(torch.tensor([4.0, 50.0, 1.0, 2.0]).double(),),
        invalid_rows=Counter(),
        valid_count=9,
        kept_count=0,
    )
    assert vars(scan_module)["_max_flyaway_mass"](totals, share) == most


def test_no_block_has_much_more_than_twice_the_average_of_rows_or_weight(tmp_path):
    """Nine tenths of the Gaussians are tiny, and the others lie beside them."""
    scene, config, tiny = random_scene(1000), SimplifyConfig(), torch.arange(1000)[:, None] < 900
    tensors = {
        "means": scene.means + torch.where(tiny, 0.0, torch.tensor([9.0, 0.0, 0.0])),
        "log_scales": torch.where(tiny, -8.0, -1.0).expand(1000, 3),
        "logit_opacities": torch.full((1000,), 2.0),
    }
    scene = scene.with_tensors(tensors, {})
    cvtgs.save(scene, tmp_path / "in.ply")
    frame = robust_frame(scene.means)
    found = scan_scene(
        scene,
        scan_range(open_rows(tmp_path / "in.ply"), frame, (), range(1000)),
        boxes=(),
        target=100,
        cell_count=100,
        blocks=4,
        config=config,
        frame=frame,
    )
    blocks = found.partition.blocks_of(frame.contract(scene.means))
    for weights in (torch.ones(1000), scene.areas**config.cvt.area_power):
        sums = torch.bincount(blocks, weights.double(), minlength=4)
        assert float(sums.max()) < 2.1 * float(sums.mean())


def test_coincident_points_lie_in_one_block():
    points = torch.zeros(10, 3).double()
    assert (
        len(set(partition_space(points, torch.ones(10).double(), 4).blocks_of(points).tolist()))
        == 1
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blocks", "rho"), [(1, 0.002), (5, 0.002), (2, 0.0501), (5, 0.6), (3, 1.0)]
)
def test_the_total_is_exact_and_the_output_is_an_ordinary_scene(source, tmp_path, blocks, rho):
    report = simplify_file(source, tmp_path / "out.ply", rho, blocks=blocks)
    small = cvtgs.load(tmp_path / "out.ply")
    assert len(small) == report.output_count == cvtgs.target_count(6000, rho)
    assert small.comments == cvtgs.load(source).comments
    assert not cvtgs.validity.invalid_rows(small)
    assert [path.name for path in tmp_path.iterdir()] == ["out.ply"]


def test_one_block_gives_the_same_bits_as_a_run_in_one_piece(scene, source, tmp_path):
    simplify_file(source, tmp_path / "out.ply", 0.05, blocks=1)
    with one_thread():
        whole = Simplifier(device="cpu").simplify(cvtgs.load(source), 0.05)
    assert same_bits(cvtgs.load(tmp_path / "out.ply"), whole)


def test_costs_are_those_of_a_run_in_one_piece(scene, tmp_path, monkeypatch):
    """Their weights depend on the ratio of cells to Gaussians that are not too faint to keep."""
    ratios = []

    def noted(ratio, *rest, **named):
        ratios.append(ratio)
        return grouping.allocation_at(ratio, *rest, **named)

    monkeypatch.setattr("cvtgs.outofcore.allocate.allocation_at", noted)
    faint = torch.arange(6000) % 2 == 0
    logits = torch.where(faint, -5.6, scene.logit_opacities)  # an opacity of 0.0037
    cvtgs.save(scene.with_tensors({"logit_opacities": logits}), tmp_path / "in.ply")
    report = simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 0.05, blocks=2)
    assert report.filtered_count > 2000
    assert set(ratios) == {300 / (6000 - report.filtered_count)}


@pytest.mark.slow
def test_the_order_of_work_does_not_matter(source, tmp_path):
    def backwards(function, items):
        results = {item: function(item) for item in reversed(items)}
        return [results[item] for item in items]

    outputs = [tmp_path / name for name in ("a.ply", "b.ply")]
    simplify_file(source, outputs[0], 0.05, blocks=4, range_rows=1500)
    simplify_file(source, outputs[1], 0.05, blocks=4, range_rows=1500, workers=backwards)
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


@pytest.mark.slow
def test_the_size_of_ranges_does_not_matter(source, tmp_path):
    for name, rows in (("a.ply", 1 << 20), ("b.ply", 1777)):
        simplify_file(source, tmp_path / name, 0.05, blocks=3, range_rows=rows)
    assert same_bits(cvtgs.load(tmp_path / "a.ply"), cvtgs.load(tmp_path / "b.ply"))


@pytest.mark.long
def test_sums_do_not_depend_on_ranges(scene, source, monkeypatch):
    monkeypatch.setattr("cvtgs.outofcore.scan.CHUNK", 10)
    rows, frame = open_rows(source), robust_frame(scene.means)
    whole = scan_range(rows, frame, (), range(6000))
    ends = range(0, 6001, 600)
    parts = [scan_range(rows, frame, (), range(*pair)) for pair in pairwise(ends)]
    by_part = sum(part.mass for part in parts), sum(part.falloff_mass for part in parts)
    assert by_part != (whole.mass, whole.falloff_mass)  # they are rounded differently
    total = add_totals(parts)
    assert (total.mass, total.falloff_mass) == (whole.mass, whole.falloff_mass)


@pytest.mark.slow
def test_seams_cost_little(scene, source, tmp_path):
    simplify_file(source, tmp_path / "out.ply", 0.1, blocks=4)
    small = {
        "one": Simplifier(device="cpu").simplify(scene, 0.1),
        "four": cvtgs.load(tmp_path / "out.ply"),
    }
    cameras = automatic_views(scene, 4, width=96, height=72)
    scores = cvtgs.evaluate(scene, small, cameras, settings=EvaluationSettings(lpips="off")).scenes
    assert scores[1].psnr.mean > scores[0].psnr.mean - 0.5  # 150 cells per block: many seams


def test_protected_rows_come_first_with_unchanged_bits(scene, source, tmp_path):
    box = Box(min=(-0.5, -9, -0.5), max=(0.5, 9, 0.5))
    kept = scene.select(cvtgs.boxes.inside([box], scene.means))
    assert 0 < len(kept) < 1000
    report = simplify_file(
        source, tmp_path / "out.ply", 0.2, blocks=3, range_rows=2000, boxes=[box]
    )
    small = cvtgs.load(tmp_path / "out.ply")
    assert (len(small), report.kept_count) == (1200, len(kept))
    first = small.select(torch.arange(len(kept)))
    assert all(torch.equal(a, kept.tensors()[name]) for name, a in first.tensors().items())
    everything = Box(min=(-1e30,) * 3, max=(1e30,) * 3)
    with pytest.raises(InvalidArgumentError, match="the target must be at least"):
        simplify_file(source, tmp_path / "no.ply", 0.2, blocks=3, boxes=[everything])


@pytest.mark.slow
def test_invalid_rows_are_dropped_and_flyaways_do_no_harm(tmp_path):
    scene = random_scene(2000, degree=0)
    means, logits = scene.means.clone(), scene.logit_opacities.clone()
    means[7], means[11] = torch.nan, 1e9
    logits[20] = torch.inf
    changed = scene.with_tensors({"means": means, "logit_opacities": logits}, {})
    cvtgs.save(changed, tmp_path / "in.ply")
    with pytest.warns(UserWarning, match="dropped 1 of 2,000"):
        report = simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 0.1, blocks=4)
    assert (report.output_count, report.invalid_count) == (200, 1)
    assert not cvtgs.validity.invalid_rows(cvtgs.load(tmp_path / "out.ply"))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_a_target_below_the_number_of_blocks_is_met(source, tmp_path, count):
    report = simplify_file(source, tmp_path / "out.ply", count=count, blocks=8)
    assert (report.output_count, len(cvtgs.load(tmp_path / "out.ply"))) == (count, count)


def test_gaussians_of_blocks_without_cells_are_merged(tmp_path):
    """Protected Gaussians use up so much of the target that four of six blocks get no cells."""
    scene = random_scene(500, degree=0)
    scene = scene.with_tensors({"logit_opacities": torch.full((500,), 2.0)}, {})
    cvtgs.save(scene, tmp_path / "in.ply")
    box = Box(min=(-9.0, -9.0, 0.5), max=(9.0, 9.0, 9.0))
    kept = int((scene.means[:, 2] >= 0.5).sum())
    report = simplify_file(
        tmp_path / "in.ply", tmp_path / "out.ply", count=kept + 2, blocks=6, boxes=[box]
    )
    assert (report.kept_count, report.output_count, report.blocks) == (kept, kept + 2, 6)
    assert report.filtered_count == 0
    assert report.largest_cell >= (500 - kept) / 2
    assert report.energy > 0


def test_a_filter_that_leaves_too_few_is_switched_off(tmp_path):
    """Nine tenths of the Gaussians are faint, and the target exceeds the number of the others."""
    scene = random_scene(600, seed=5)
    logits = torch.where(torch.arange(600) % 10 == 0, 4.0, -8.0)
    cvtgs.save(scene.with_tensors({"logit_opacities": logits}, {}), tmp_path / "in.ply")
    report = simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 0.9, blocks=3)
    assert (report.output_count, report.shortfall) == (540, "")


def test_files_without_a_valid_row_are_refused(tmp_path):
    scene = random_scene(20)
    nothing = scene.with_tensors({"means": torch.full_like(scene.means, torch.nan)}, {})
    cvtgs.save(nothing, tmp_path / "in.ply")
    with pytest.raises(InvalidSceneError, match="found no valid Gaussian"):
        simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 0.5, blocks=2)
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.slow
def test_extra_columns_are_kept_and_other_output_formats_work(tmp_path):
    scene = random_scene(500, degree=0)
    extra = {"id": torch.arange(500, dtype=torch.int32), "heat": torch.rand(500)}
    cvtgs.save(scene.with_tensors({}, extra), tmp_path / "in.ply")
    box = Box(min=(0, 0, 0), max=(1, 1, 1))
    simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 0.5, blocks=3, boxes=[box])
    assert set(cvtgs.load(tmp_path / "out.ply").extras) == {"id", "heat"}
    with pytest.warns(UserWarning, match="do not hold"):
        simplify_file(tmp_path / "in.ply", tmp_path / "out.splat", 0.5, blocks=3, boxes=[box])
    assert len(cvtgs.load(tmp_path / "out.splat")) == 250
    (tmp_path / "in.splat").write_bytes(b" " * 32)
    with pytest.raises(FileFormatError):
        simplify_file(tmp_path / "in.splat", tmp_path / "no.ply", 0.5, blocks=3)


def test_settings_that_blocks_cannot_use_are_refused(source, tmp_path):
    config = SimplifyConfig.from_mapping({"refine": {"seconds": 3.0}})
    simplifier = Simplifier(config=config, device="cpu")
    with pytest.raises(ConfigError, match=r"number of steps .* found 3 s"):
        simplify_file(source, tmp_path / "no.ply", 0.1, blocks=2, simplifier=simplifier)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("preset", ["draft", "paper"])
@pytest.mark.slow
def test_other_presets_work_in_blocks(source, tmp_path, preset):
    simplifier = Simplifier(config=SimplifyConfig.from_preset(preset), device="cpu")
    simplify_file(source, tmp_path / "out.ply", 0.03, blocks=3, simplifier=simplifier)
    assert len(cvtgs.load(tmp_path / "out.ply")) == 180


@pytest.mark.parametrize(
    ("text", "wanted"), [("4GB", 4 * 10**9), ("2 GiB", 2**31), ("700mb", 7 * 10**8)]
)
def test_amounts_of_memory_are_parsed(text, wanted):
    assert read_bytes(text) == wanted


@pytest.mark.parametrize("text", ["", "4XB", "-1GB", "much", "300MB"])
def test_bad_amounts_of_memory_are_refused(text):
    with pytest.raises(InvalidArgumentError, match="memory must be"):
        read_bytes(text)


@pytest.mark.parametrize(
    ("counts", "regions"),
    [
        ([4, 4, 4], [[0], [1], [2]]),
        ([3, 3, 0, 5, 1], [[0, 1], [3, 4]]),
        ([9, 2, 4], [[0], [1, 2]]),
        ([0, 6], [[1]]),
    ],
)
def test_neighbouring_blocks_whose_cells_fit_together_are_a_region(counts, regions):
    assert vars(allocate)["_regions"](counts, 6) == regions


@pytest.mark.parametrize("memory", [10**9, 4 * 10**9, 32 * 10**9])
def test_a_block_of_twice_the_mean_size_fits_into_memory(memory):
    rows = SimpleNamespace(count=10**8, dtype=np.dtype([("x", "u1", 248)]))
    blocks = block_count(rows, memory)
    assert blocks % 4 == 0
    sizes = [needed_memory(rows, 2 * rows.count // number) for number in (blocks - 4, blocks)]
    assert sizes[1] <= memory < sizes[0]


def test_less_memory_makes_more_blocks(source):
    rows = open_rows(source)
    assert block_count(rows, 10**10) == 1
    few, more = (block_count(rows, SMALL_BASE_BYTES + rest) for rest in (500_000, 100_000))
    assert more > few > 1


@pytest.mark.long
def test_the_command_cuts_the_scene_if_memory_is_low(source, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("cvtgs.outofcore.memory.BASE_BYTES", 10)
    monkeypatch.setattr("cvtgs.outofcore.memory.LEAST_BYTES", 20)
    monkeypatch.setattr(
        "cvtgs.outofcore.memory.needed_memory", lambda source, rows, merging=0: 10 + 1000 * rows
    )
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.01"]
    words += ["--report", str(tmp_path / "report.json"), "--overwrite"]
    assert main([*words, "--memory", "2MB"]) == 0
    assert "In 8 blocks." in capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["output_count"], report["blocks"]) == (60, 8)
    assert main([*words, "--memory", "7MB"]) == 0
    assert "blocks" not in capsys.readouterr().out
    monkeypatch.setattr("cvtgs.outofcore.memory.available_memory", lambda: 3_000_000)
    assert main(words) == 0
    assert "In 8 blocks." in capsys.readouterr().out
    assert main([*words, "--memory", "2MB", "--refine", "3"]) == 1
    assert main([*words, "--memory", "2MB", "--time-budget", "20s"]) == 1


def test_the_number_of_blocks_may_be_one_of_numpy(tmp_path):
    random_scene(300).save(tmp_path / "scene.ply")
    report = simplify_file(tmp_path / "scene.ply", tmp_path / "a.ply", 0.1, blocks=np.int64(2))
    assert report.blocks == 2
