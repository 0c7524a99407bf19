"""Visibility in blocks: the contributions of Gaussians are those of one piece."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import cvtgs
from block_jobs import unfinished_job
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis.analyze import visibility_cameras
from cvtgs.boxes import Box, inside
from cvtgs.edit import concatenate
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.images import read_apparent_rows, write_views
from cvtgs.outofcore.rows import read_rows
from cvtgs.progress import silent
from cvtgs.rendering import contributions
from refine_cases import ring
from scenes import same_bits

COUNT, BLOCKS, TARGET = 3000, 3, 150
SETTINGS = {
    "visibility": {"views": 6, "size": 96, "stride": 2},
    "filter": {"min_opacity": 0.0, "max_flyaway_share": 0.0},
}
BOX = Box(min=(-0.08, -0.08, -9), max=(0.08, 0.08, 9))


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", COUNT, sh_degree=1, seed=4)


def run(scene, folder, config, *, boxes=()):
    return unfinished_job(scene, folder, count=TARGET, blocks=BLOCKS, config=config, boxes=boxes)


def contributions_of(job):
    blocks = job.blocks_with_rows()
    return torch.cat([job.read("contributions", block)["contributions"] for block in blocks])


def paired(job, scene):
    """Return the row in the scene of every row of the blocks, in order."""
    means = torch.cat([read_rows(job, block).scene.means for block in job.blocks_with_rows()])
    distances, rows = torch.cdist(means.double(), scene.means.double()).min(dim=1)
    assert float(distances.amax()) == 0.0
    return rows


@pytest.mark.long
@pytest.mark.parametrize(
    ("boxes", "comments"), [((), ()), ((BOX,), ()), ((), ("SplatRenderMode: mip",))]
)
def test_contributions_are_those_of_one_piece(scene, tmp_path, boxes, comments):
    scene = replace(scene, comments=comments)
    config = SimplifyConfig.from_mapping(SETTINGS)
    job = run(scene, tmp_path, config, boxes=boxes)
    rows = paired(job, scene)
    kept = int(inside(boxes, scene.means).sum()) if boxes else 0
    assert len(rows.unique()) == COUNT - kept
    found = contributions_of(job)
    wanted = contributions(scene, visibility_cameras(scene, config))[rows]
    assert float(wanted.sum()) > 1000
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_invalid_rows_do_not_enlarge_the_sample(scene, tmp_path):
    """The sample is the whole scene here; invalid rows are dropped from it."""
    config = SimplifyConfig.from_mapping(SETTINGS)
    broken = scene.select(torch.arange(1500))
    broken.means[:] = torch.nan
    job = run(concatenate([broken, scene]), tmp_path, config)
    wanted = contributions(scene, visibility_cameras(scene, config))[paired(job, scene)]
    torch.testing.assert_close(contributions_of(job), wanted, rtol=1e-3, atol=1e-3)


def test_gaussians_of_a_sample_are_enlarged_to_the_mass_of_the_scene(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("cvtgs.outofcore.images.visibility_cameras", lambda *_, **__: ring())
    job = SimpleNamespace(config=SimplifyConfig(), cameras=None, views_path=tmp_path / "views")
    sample = scene.select(torch.arange(0, COUNT, 4))
    write_views(job, sample, total=COUNT)
    log_scales = map_tensors(job.views_path)[0]["scene/log_scales"]
    drawn = sample.with_tensors({"log_scales": log_scales}, {})
    torch.testing.assert_close(drawn.masses, 4 * sample.masses)


@pytest.mark.slow
def test_measured_areas_keep_the_mass_and_move_it_to_what_images_show(scene, tmp_path):
    job = run(scene, tmp_path, SimplifyConfig.from_mapping(SETTINGS))
    plain = [read_rows(job, block, is_slim=True) for block in job.blocks_with_rows()]
    measured = [read_apparent_rows(job, block) for block in job.blocks_with_rows()]
    before, after = (
        torch.cat([one.apparent_areas * one.scene.opacities for one in rows])
        for rows in (plain, measured)
    )
    assert float(after.sum()) == pytest.approx(float(before.sum()), rel=1e-4)
    share = job.config.visibility.mass_share
    hidden = contributions_of(job) == 0
    assert int(hidden.sum()) > 20
    torch.testing.assert_close(after[hidden], share * before[hidden], rtol=1e-5, atol=0)


@pytest.mark.slow
def test_images_that_show_nothing_change_nothing(scene, tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plain = SETTINGS | {"visibility": {"views": 0}}
    expected = run(scene, tmp_path / "a", SimplifyConfig.from_mapping(plain))
    monkeypatch.setattr(
        "cvtgs.outofcore.images.contributions",
        lambda scene, cameras: torch.zeros(len(scene), dtype=torch.float64),
    )
    with pytest.warns(UserWarning, match="images of the scene show nothing"):
        job = run(scene, tmp_path / "b", SimplifyConfig.from_mapping(SETTINGS))
    for block in job.blocks_with_cells():
        assert job.small_path(block).read_bytes() == expected.small_path(block).read_bytes()


def finish(folder, config, listener=silent):
    """Run the job of a folder again."""
    return simplify_file(
        folder / "in.ply",
        folder / "out.ply",
        count=TARGET,
        blocks=BLOCKS,
        simplifier=Simplifier(config=config, device="cpu"),
        listener=listener,
    )


@pytest.mark.long
def test_a_job_with_damaged_views_starts_over(scene, tmp_path):
    config = SimplifyConfig.from_mapping(SETTINGS)
    job = run(scene, tmp_path, config)
    small = [cvtgs.load(job.small_path(block)) for block in job.blocks_with_cells()]
    job.views_path.write_bytes(b"damaged")
    job.path("contributions", 1).unlink()
    assert finish(tmp_path, config).resumed_blocks == 0
    assert same_bits(cvtgs.load(tmp_path / "out.ply"), concatenate(small))


@pytest.mark.slow
def test_damaged_contributions_are_measured_again(scene, tmp_path):
    config = SimplifyConfig.from_mapping(SETTINGS)
    job = run(scene, tmp_path, config)
    whole = job.path("contributions", 1).read_bytes()
    job.path("contributions", 1).write_bytes(whole[:100])
    for path in tmp_path.glob(".out.ply.blocks/*/sample_*"):
        path.unlink()
    seen = {}

    def note(event):
        if event.stage == "assemble":
            seen["again"] = job.path("contributions", 1).read_bytes()

    report = finish(tmp_path, config, note)
    assert seen["again"] == whole
    assert (report.resumed_blocks, report.views) == (BLOCKS, "found")
