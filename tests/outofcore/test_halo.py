"""The halo: blocks together give the same result as one piece, also where they meet."""

import math
import time
from dataclasses import replace

import pytest
import torch

import cvtgs
from block_jobs import unfinished_job
from cvtgs import SimplifyConfig, cells, cvt, validity
from cvtgs.cells import Moments
from cvtgs.cvt.nearest import nearest_several
from cvtgs.edit import concatenate
from cvtgs.evaluation import EvaluationSettings
from cvtgs.grouping import REASSIGN, allocation_at
from cvtgs.math.segments import take_columns
from cvtgs.mergenet import correct_cells
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.halo import Balls, OtherBlock, assign_points, bounding_box, halo_cells
from cvtgs.outofcore.merge import read_cells
from cvtgs.outofcore.rows import read_rows
from cvtgs.outofcore.scan import partition_space
from cvtgs.pipeline import shape_merged
from cvtgs.tags import ANTIALIASED
from cvtgs.views import automatic_views
from scenes import same_bits

COUNT, BLOCKS, TARGET = 4000, 5, 120


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return courtyard_job(tmp_path_factory.mktemp("borders"))


@pytest.fixture(scope="module")
def tagged_job(tmp_path_factory):
    return courtyard_job(tmp_path_factory.mktemp("tagged"), comments=(ANTIALIASED.text,))


def courtyard_job(folder, *, comments=()):
    scene = cvtgs.synthetic.scene("courtyard", COUNT, sh_degree=1, seed=8)
    scene = replace(scene, comments=comments)
    config = SimplifyConfig.from_mapping({"cvt": {"weight_floor": 0.03}})  # some are below it
    return unfinished_job(scene, folder, count=TARGET, blocks=BLOCKS, config=config)


def of_all(job, step, name, iteration=None):
    blocks = job.blocks_with_cells()
    return torch.cat([job.read(step, block, iteration)[name] for block in blocks])


def scene_of_all(job, step):
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    return cvtgs.GaussianScene(**{name: of_all(job, step, name) for name in names})


def block_starts(job):
    return torch.tensor([0, *job.targets]).cumsum(0)


def random_blocks(count, dim, *, seed=0):
    """Return random points and sites, split into slabs along the first axis."""
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(900, dim, generator=g)
    sites = torch.rand(60, dim, generator=g).double()
    slab = [(values[:, 0] * count).long() for values in (points, sites)]
    return [(points[slab[0] == k], sites[slab[1] == k]) for k in range(count)]


def others_of(blocks, own):
    return [
        OtherBlock(k, bounding_box(sites), sites) for k, (_, sites) in enumerate(blocks) if k != own
    ]


def test_balls_that_touch_a_box_by_hand():
    points = torch.tensor([[0.0, 0.0], [0.0, 2.0], [5.0, 0.0]])
    box = torch.tensor([[1.0, -1.0], [2.0, 1.0]])
    assert Balls.around(points, torch.tensor([1.5, 1.5, 9.5])).touching(box).tolist() == [0, 2]
    assert Balls.around(points, torch.tensor([1.0, 2.5, 9.0])).touching(box).tolist() == [1]
    assert len(Balls.around(points, torch.zeros(3)).touching(box)) == 0


@pytest.mark.parametrize("count", [1, 2, 7])
@pytest.mark.parametrize("dim", [3, 6])
def test_the_nearest_site_is_found_in_any_block(count, dim):
    blocks = random_blocks(count, dim)
    sites = torch.cat([sites for _, sites in blocks])
    owners = torch.cat([torch.full((len(s),), k) for k, (_, s) in enumerate(blocks)])
    crossed = 0
    for own, (points, own_sites) in enumerate(blocks):
        found = assign_points(points, own_sites, others_of(blocks, own), nearest=cvt.nearest_scipy)
        distances = torch.cdist(points.double(), sites)
        wanted = owners[distances.argmin(dim=1)]
        assert torch.equal(torch.where(found.blocks < 0, own, found.blocks), wanted)
        torch.testing.assert_close(found.squared, distances.amin(dim=1).square())
        for k, (_, theirs) in enumerate(blocks):
            mine = found.blocks == (-1 if k == own else k)
            gaps = (points[mine].double() - theirs[found.labels[mine]]).square().sum(dim=1)
            torch.testing.assert_close(gaps, found.squared[mine])
        crossed += int((found.blocks >= 0).sum())
    assert (crossed > 0) == (count > 1)


def test_a_tie_goes_to_the_site_in_the_own_block():
    others = [OtherBlock(3, torch.tensor([[2.0], [2.0]]), torch.tensor([[2.0]]))]
    found = assign_points(
        torch.tensor([[1.0]]), torch.zeros(1, 1).double(), others, nearest=cvt.nearest_scipy
    )
    assert found.blocks.tolist() == [-1]


def test_several_nearest_sites_match_brute_force():
    g = torch.Generator().manual_seed(1)
    points, sites = torch.rand(50, 3, generator=g), torch.rand(20, 3, generator=g)
    rows, distances = nearest_several(points, sites, 4)
    wanted = torch.cdist(points.double(), sites.double()).sort(dim=1)
    assert torch.equal(rows, wanted.indices[:, :4])
    torch.testing.assert_close(distances, wanted.values[:, :4])
    assert nearest_several(points, sites, 99)[0].shape == (50, 20)


def test_coincident_sites_do_not_take_quadratic_time():
    """A naive search is quadratic: it takes six times as long as for separate sites."""
    apart = torch.rand(30_000, 3, generator=torch.Generator().manual_seed(0)).double()
    seconds = []
    for sites in (apart, torch.zeros_like(apart)):
        start = time.process_time()
        _, distances = nearest_several(sites, sites, 9)
        seconds.append(time.process_time() - start)
    assert float(distances.amax()) < 1e-6
    assert seconds[1] < 2 * seconds[0] + 0.1


@pytest.mark.parametrize("count", [2, 7, 30])  # many of 30 blocks have fewer cells than neighbours
def test_a_halo_holds_all_possible_neighbours(count):
    blocks = [(None, sites) for _, sites in random_blocks(count, 3, seed=2) if len(sites)]
    starts = torch.tensor([0, *[len(sites) for _, sites in blocks]]).cumsum(0)
    centers = torch.cat([sites for _, sites in blocks])
    wanted = cvt.nearest_neighbors(centers, 8)
    for own, (_, sites) in enumerate(blocks):
        found = halo_cells(sites, others_of(blocks, own), count=8)
        held = set((starts[found[:, 0]] + found[:, 1]).tolist())
        held |= set(range(int(starts[own]), int(starts[own + 1])))
        assert set(wanted[starts[own] : starts[own + 1]].flatten().tolist()) <= held


@pytest.mark.parametrize(("place", "cells_found"), [(3.0, [[7, 0]]), (5.0, [])])
def test_a_halo_reaches_as_far_as_the_last_own_neighbour(place, cells_found):
    centers, theirs = torch.tensor([[0.0, 0, 0], [0, 0, 4]]), torch.tensor([[place, 0.0, 0.0]])
    others = [OtherBlock(7, bounding_box(theirs), theirs)]
    assert halo_cells(centers, others, count=1).tolist() == cells_found


@pytest.mark.slow
def test_points_weigh_as_in_one_piece(job):
    config, parts = job.config.cvt, []
    for block in job.blocks_with_rows():
        rows, order = read_rows(job, block), job.read("sample", block)["order"]
        parts.append((rows.scene.opacities[order.long()], rows.apparent_areas[order.long()]))
    opacities, areas = (torch.cat(values) for values in zip(*parts, strict=True))
    wanted = cvt.tessellation_weights(
        opacities, areas, area_power=config.area_power, floor=config.weight_floor
    )
    assert int((wanted == config.weight_floor).sum()) > 10
    torch.testing.assert_close(of_all(job, "sample", "weights"), wanted)


def test_sites_move_as_in_one_piece(job):
    points = of_all(job, "sample", "points")
    weights = of_all(job, "sample", "weights")
    sites = of_all(job, "sites", "sites", 0)
    moves = len(list(job.path("").glob("sites_00000_*"))) - 1
    assert moves == job.config.cvt.iterations
    whole = cvt.lloyd(
        points, weights, sites, nearest=cvt.nearest_scipy, iterations=moves, tolerance=0.0
    )
    moved = of_all(job, "sites", "sites", moves)
    torch.testing.assert_close(moved, whole.sites)


def test_gaussians_go_to_cells_of_other_blocks(job):
    labels = [job.read("labels", block) for block in job.blocks_with_cells()]
    left = sum(int((one["labels"] < 0).sum()) for one in labels)
    assert left == sum(int(one["sent"].sum()) for one in labels) > COUNT // 50
    scan = job.read_scan()
    sizes = of_all(job, "merged", "sizes")
    assert (len(sizes), int(sizes.amin())) == (TARGET, 1)
    blocks = job.blocks_with_cells()
    members = sum(int(read_cells(job, block).partition.counts.sum()) for block in blocks)
    rows = sum(job.path("rows", block, 0).stat().st_size for block in blocks)
    assert rows % members == 0  # every Gaussian is in one cell
    assert members <= scan.row_count


def in_order(columns):
    return columns[:, columns[0].argsort()]


def test_cells_merge_and_gaussians_move_as_in_one_piece(job):
    starts, scenes, labels, areas = torch.tensor([0, *job.cells]).cumsum(0), [], [], []
    for block in job.blocks_with_rows():
        rows, parts = read_rows(job, block), job.read("parts", block)
        of_parts = [torch.arange(job.cells[block]) + starts[block]]
        of_parts.append(starts[parts["remote"][:, 0]] + parts["remote"][:, 1])
        labels.append(torch.cat(of_parts)[parts["parts"].long()])
        scenes.append(rows.scene)
        areas.append(rows.apparent_areas)
    scene, labels = concatenate(scenes), torch.cat(labels)
    assert job.read_scan().view_components.shape[1] > 0
    members = cells.gaussian_moments(
        scene,
        torch.arange(len(scene)),
        job.read_scan().frame,
        masses=scene.masses,
        apparent_masses=torch.cat(areas) * scene.opacities,
        components=job.read_scan().view_components,
    )
    scan, masses = job.read_scan(), torch.cat(areas).double() * scene.opacities
    unbounded, area = scan.plan.unbounded.strength, float(masses.sum()) / scan.frame.radius**2
    config = allocation_at(TARGET / COUNT, job.config.allocation, unbounded=unbounded)
    fine = sum(job.cells)
    assert fine > TARGET + 50
    whole = cells.group_moments(members, labels, fine)
    near = cvt.nearest_neighbors(whole.means.T, config.neighbors)
    merged = cells.merge_pairs(whole, near, TARGET, config, area=area)
    wanted = cells.group_moments(whole, merged, TARGET)
    found = torch.cat([job.read("groups", block)["means"] for block in job.blocks_with_cells()], 1)
    torch.testing.assert_close(in_order(found), in_order(wanted.means))
    # Every group keeps a Gaussian of the block with its heaviest cell; else all is as in one piece.
    blocks = torch.repeat_interleave(torch.arange(BLOCKS), torch.tensor(job.cells))
    heaviest = torch.stack([
        of_group[whole.masses[of_group].argmax()]
        for of_group in ((merged == group).nonzero()[:, 0] for group in range(TARGET))
    ])  # fmt: skip
    near = cvt.nearest_neighbors(wanted.means.T, REASSIGN)
    final, start = [], 0
    for block, part in zip(job.blocks_with_rows(), scenes, strict=True):
        rows = torch.arange(start, start + len(part))
        must_stay = blocks[heaviest] == block
        some, own = Moments(*(take_columns(rows, one) for one in members)), merged[labels][rows]
        final.append(cells.reassign(some, own, wanted, near, config, must_stay=must_stay))
        start += len(part)
    found = [read_cells(job, block) for block in job.blocks_with_cells()]
    sizes = torch.cat([one.partition.counts for one in found])
    wanted_sizes = torch.bincount(torch.cat(final), minlength=TARGET)
    assert torch.equal(sizes.sort().values, wanted_sizes.sort().values)
    one_piece = cells.reassign(members, merged[labels], wanted, near, config)
    moved = int((one_piece != merged[labels]).sum())
    assert moved > COUNT // 50
    assert int((torch.cat(final) != one_piece).sum()) < moved // 50


@pytest.mark.slow
def test_cells_that_exceed_the_memory_are_merged_in_parts(tmp_path, monkeypatch):
    cvtgs.save(cvtgs.synthetic.scene("room", 900, sh_degree=0, seed=2), tmp_path / "in.ply")
    monkeypatch.setattr("cvtgs.outofcore.memory.CELL_ROOM", 50)
    with pytest.warns(UserWarning, match="compared within 5 parts"):
        report = simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", count=70, blocks=5)
    assert len(cvtgs.load(tmp_path / "out.ply")) == 70 == report.output_count


def test_cells_have_the_same_neighbours_as_in_one_piece(job):
    merged = scene_of_all(job, "merged")
    wanted = cvt.nearest_neighbors(merged.means, 8)
    starts, crossed = block_starts(job), 0
    for block in job.blocks_with_cells():
        own = job.read("inflated", block)
        remote = own["remote"]
        numbers = torch.cat(
            [
                torch.arange(len(own["means"])) + starts[block],
                starts[remote[:, 0]] + remote[:, 1],
            ]
        )
        found = numbers[own["neighbors"]]
        assert torch.equal(found, wanted[starts[block] : starts[block + 1]])
        crossed += int((own["neighbors"] >= len(own["means"])).any(dim=1).sum())
    assert crossed > TARGET // 5


def test_no_neighbours_are_searched_that_nothing_uses(tmp_path):
    """The published network sees single cells, and ``paper`` neither aligns nor inflates them."""
    scene, config = (
        cvtgs.synthetic.scene("object", 400, sh_degree=0),
        SimplifyConfig(preset="paper"),
    )
    job = unfinished_job(scene, tmp_path, count=40, blocks=2, config=config)
    for block in job.blocks_with_cells():
        found = job.read("inflated", block)
        assert (found["remote"].shape, found["neighbors"].shape[1]) == ((0, 2), 0)


def test_axes_and_inflation_are_the_same_as_in_one_piece(job):
    merged, inflated = scene_of_all(job, "merged"), scene_of_all(job, "inflated")
    sizes = of_all(job, "merged", "sizes")
    partition = cells.Partition.from_labels(
        torch.repeat_interleave(torch.arange(TARGET), sizes), TARGET
    )
    neighbors = cvt.nearest_neighbors(merged.means, 8)
    wanted = shape_merged(merged, partition, neighbors, job.config.merge)
    assert bool((inflated.log_scales != merged.log_scales).any())
    assert same_bits(inflated, wanted)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["job", "tagged_job"])
def test_the_network_corrects_as_in_one_piece(which, request):
    job = request.getfixturevalue(which)
    members = [read_cells(job, block) for block in job.blocks_with_cells()]
    visibility = torch.cat([one.visibility for one in members])
    scene = concatenate([one.scene for one in members])
    assert scene.antialiased == (which == "tagged_job")
    counts = torch.cat([one.partition.counts for one in members])
    firsts = torch.tensor([0, *[len(one.scene) for one in members]]).cumsum(0)
    pairs = list(zip(members, firsts[:-1], strict=True))
    order = torch.cat([one.partition.order + first for one, first in pairs])
    partition = cells.Partition(
        order=order, offsets=torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    )
    representatives = [
        job.read("merged", block)["representatives"] for block in job.blocks_with_cells()
    ]
    representatives = torch.cat(
        [
            torch.where(rows < 0, -1, rows + first)
            for rows, (_, first) in zip(representatives, pairs, strict=True)
        ]
    )
    shown = partition.keep_only(representatives)
    assert int((representatives >= 0).sum()) > 0
    inflated = scene_of_all(job, "inflated")
    neighbors = cvt.nearest_neighbors(inflated.means, 8)
    wanted = validity.standardized(
        correct_cells(
            job.read_network(scene.dtype),
            scene,
            inflated,
            shown,
            neighbors=neighbors,
            visibility=visibility,
            pixel_size=job.read_scan().frame.radius / 400,
        )
    )
    small = [cvtgs.load(job.small_path(block)) for block in job.blocks_with_cells()]
    assert bool((inflated.means != wanted.means).any())
    for name, values in wanted.tensors().items():
        found = torch.cat([one.tensors()[name] for one in small])
        torch.testing.assert_close(found, values, rtol=1e-4, atol=1e-5)


@pytest.mark.long
def test_seams_cost_less_than_a_tenth_of_a_decibel(tmp_path):
    """Average over several counts, since a single PSNR varies by more than the limit."""
    scene = cvtgs.synthetic.scene("object", 20_000, sh_degree=0, seed=3)
    source, counts = tmp_path / "in.ply", range(950, 1050, 10)
    cvtgs.save(scene, source)
    small = {}
    for blocks in (1, 8):
        for count in counts:
            output = tmp_path / f"{blocks}_{count}.ply"
            simplify_file(source, output, count=count, blocks=blocks)
            small[output.stem] = cvtgs.load(output)
    cameras = automatic_views(scene, 6, width=120, height=90)
    settings = EvaluationSettings(lpips="off")
    found = cvtgs.evaluate(scene, small, cameras, settings=settings).scenes
    psnr = [one.psnr.mean for one in found]
    whole, cut = sum(psnr[:10]) / 10, sum(psnr[10:]) / 10
    assert cut > whole - 0.1


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 2])
def test_a_ratio_of_one_keeps_every_gaussian_unchanged_in_blocks(tmp_path, degree):
    scene = cvtgs.synthetic.scene("room", 600, sh_degree=degree, seed=1)
    cvtgs.save(scene, tmp_path / "in.ply")
    simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 1.0, blocks=4)
    small = cvtgs.load(tmp_path / "out.ply")
    first, second = (
        torch.cat([s.means, s.log_scales, s.sh.flatten(1)], dim=1) for s in (scene, small)
    )
    assert set(map(tuple, first.tolist())) == set(map(tuple, second.tolist()))


def test_neighbouring_floats_lie_on_both_sides_of_a_plane():
    """Their mean rounds to the smaller one, and only points below the plane go left."""
    points = torch.zeros(2, 3, dtype=torch.float64)
    points[:, 0] = torch.tensor([1.0, math.nextafter(1.0, 2.0)], dtype=torch.float64)
    partition = partition_space(points, torch.ones(2, dtype=torch.float64), 2)
    assert partition.blocks_of(points).tolist() == [0, 1]
