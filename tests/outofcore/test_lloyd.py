"""Lloyd over all blocks: sites move to the centroids of all points, and to the blocks of these."""

from types import SimpleNamespace

import pytest
import torch

import cvtgs
from block_jobs import unfinished_job
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.outofcore import lloyd, simplify_file
from cvtgs.outofcore.halo import Assignment, bounding_box
from cvtgs.outofcore.job import Job, Manifest
from cvtgs.outofcore.lloyd import accumulate, move_sites
from hard_cases import duplicates
from hard_scenes import ball, flown


@pytest.fixture
def job_on_a_line(tmp_path, monkeypatch):
    """Return a function that makes a job whose blocks have these points and sites on a line."""
    plan = SimpleNamespace(duplicates=SimpleNamespace(active=False))
    monkeypatch.setattr(Job, "read_scan", lambda job: SimpleNamespace(plan=plan))

    def make(*blocks):
        job = Job(
            folder=str(tmp_path),
            source=None,
            target=1,
            blocks=len(blocks),
            boxes=(),
            config=SimplifyConfig(),
            has_network=False,
            range_rows=1,
        )
        counts = tuple(len(sites) for _, sites in blocks)
        manifest = Manifest(grouped=9, total=1, cells=counts, left_out_mass=0.0)
        job.write_file("manifest.json", manifest.to_json().encode())
        for block, (points, sites) in enumerate(blocks):
            positions, weights = torch.tensor(points).T
            tensors = {"points": positions[:, None], "weights": weights}
            job.write("sample", block, tensors)
            first = torch.tensor(sites).double()[:, None]
            tensors = {"sites": first, "bounds": bounding_box(first)}
            job.write("sites", block, tensors, 0)
        return job

    return make


def moved_sites(job):
    for block in range(job.blocks):
        accumulate(job, 0, block)
    move_sites(job, 0)
    sites = [job.read("sites", block, 1)["sites"] for block in range(job.blocks)]
    return [of_block[:, 0].tolist() for of_block in sites]


OWN = ([(0.0, 1.0), (1.0, 1.0)], [0.0, 10.0])
"""Points with their weights, and sites; no point of this block is nearest to the second site."""


@pytest.mark.parametrize(
    ("weight", "wanted"),
    [(1.0, [[0.5], [22.0, 11.0], [30.0]]), (3.0, [[0.5], [22.0], [30.0, 10.2]])],
)
def test_a_site_goes_to_the_block_with_most_of_its_weight(job_on_a_line, weight, wanted):
    """The points at 11, 13 and, with the given weight, 9 are nearest to the site at 10."""
    second = ([(11.0, 1.0), (13.0, 1.0), (22.0, 1.0), (22.0, 1.0)], [22.0])
    third = ([(9.0, weight), (30.0, 1.0), (30.0, 1.0)], [30.0])
    job = job_on_a_line(OWN, second, third)
    assert moved_sites(job) == wanted
    before = job.path("sites", 0, 1).read_bytes(), job.path("sites", 1, 1).read_bytes()
    job.path("sites", 1, 1).unlink()  # as if the run ended before it was written
    move_sites(job, 0)
    assert (
        job.path("sites", 0, 1).read_bytes(),
        job.path("sites", 1, 1).read_bytes(),
    ) == before


def test_a_site_with_points_of_its_block_stays_there(job_on_a_line):
    first = ([(0.0, 1.0), (10.0, 1.0)], [0.0, 10.0])
    second = ([(11.0, 5.0), (22.0, 1.0), (22.0, 1.0)], [22.0])
    assert moved_sites(job_on_a_line(first, second)) == [[0.0, (10.0 + 55.0) / 6.0], [22.0]]


def test_a_block_gets_fewer_sites_than_it_has_points(job_on_a_line):
    second = ([(11.0, 1.0), (22.0, 1.0)], [22.0])
    assert moved_sites(job_on_a_line(OWN, second)) == [[0.5, 11.0], [22.0]]


def test_a_block_keeps_a_site(job_on_a_line):
    first = ([(99.0, 1.0)], [10.0])
    second = ([(11.0, 1.0), (90.0, 1.0), (90.0, 1.0)], [90.0])
    assert moved_sites(job_on_a_line(first, second)) == [[11.0], [93.0]]


def test_far_points_of_other_blocks_stay_alone(tmp_path):
    """A near point of the site's own block, beside one a million radii away, made a huge cell."""
    scene, config = flown(800, torch.float32, 1e6), SimplifyConfig(preset="paper")
    job = unfinished_job(scene, tmp_path, count=40, blocks=2, config=config)
    merged = [job.read("merged", block)["log_scales"] for block in range(2)]
    assert torch.cat(merged).shape == (40, 3)
    assert torch.cat(merged).max() < 0.0
    sites = [job.read("sites", block, config.cvt.iterations)["sites"] for block in range(2)]
    counts = [len(of_block) for of_block in sites]
    assert sum(counts) == sum(job.cells) == 40
    assert counts != list(job.cells)


def test_an_empty_site_gets_a_point_that_its_cell_can_spare():
    """Site 0 keeps its second point: it is farther, but costs less. The last is a remote one's."""
    points = torch.tensor([[0.1], [0.2], [-9.0]])
    found = Assignment(
        torch.tensor([-1, -1, 3]), torch.tensor([0, 0, 7]), torch.tensor([0.01, 0.04, 0.1]).double()
    )
    weights, sites = torch.tensor([10.0, 1.0, 1.0]).double(), torch.tensor([[0.0], [5.0]]).double()
    filled, refilled = vars(lloyd)["_fill_empty"](found, points, sites, weights)
    assert refilled == 1
    assert filled.blocks.tolist() == [-1, -1, 3]
    assert filled.labels.tolist() == [1, 0, 7]
    assert filled.squared.tolist() == pytest.approx([4.9**2, 0.04, 0.1])


@pytest.mark.parametrize("blocks", [2, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("make", [ball, duplicates])
def test_a_site_without_points_gets_a_near_one(tmp_path, make, blocks):
    """A far point would make a huge cell; seeds that coincide leave sites without points."""
    scene, path = make(1500, torch.float32), tmp_path / "in.ply"
    cvtgs.save(scene, path)
    simplifier = Simplifier(None, preset="paper", device="cpu")
    report = simplify_file(
        path, tmp_path / "out.ply", count=100, blocks=blocks, simplifier=simplifier
    )
    assert report.refilled_cells >= (make is duplicates)
    largest = cvtgs.load(tmp_path / "out.ply").log_scales.max()
    assert largest < simplifier.simplify(scene, count=100).log_scales.max() + 0.2
