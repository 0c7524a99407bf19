"""Visibility in blocks: the contributions of Gaussians are those of one piece."""

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis import visibility_cameras
from cvtgs.boxes import Box, inside
from cvtgs.io.ply import open_rows
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import read_rows
from cvtgs.outofcore.visibility import is_measured, read_apparent_rows
from cvtgs.rendering import contributions

COUNT, BLOCKS, TARGET = 3000, 3, 150
SETTINGS = {
    "visibility": {"views": 6, "size": 48, "stride": 1},
    "filter": {"min_opacity": 0.0, "max_flyaway_share": 0.0},
}
BOX = Box(min=(-0.08, -0.08, -9), max=(0.08, 0.08, 9))


class StoppedError(Exception):
    """Ends a run from its listener."""


def stop_before_assemble(event):
    if event.stage == "assemble":
        raise StoppedError


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", COUNT, sh_degree=1, seed=4)


def run(scene, folder, config, *, boxes=()):
    """Return a job that is complete except for the assembly of its blocks."""
    cvtgs.save(scene, folder / "in.ply")
    with pytest.raises(StoppedError):
        simplify_file(
            folder / "in.ply",
            folder / "out.ply",
            count=TARGET,
            blocks=BLOCKS,
            boxes=boxes,
            simplifier=Simplifier(config=config, device="cpu"),
            listener=stop_before_assemble,
        )
    return Job(
        folder=str(next((folder / ".out.ply.blocks").iterdir())),
        source=open_rows(folder / "in.ply"),
        target=TARGET,
        blocks=BLOCKS,
        boxes=tuple(boxes),
        config=config,
        has_network=True,
        range_rows=1 << 26,
    )


def paired(job, scene):
    """Return the row in the scene of every row of the blocks, in order."""
    means = torch.cat([read_rows(job, block).scene.means for block in job.blocks_with_rows()])
    distances, rows = torch.cdist(means.double(), scene.means.double()).min(dim=1)
    assert float(distances.amax()) == 0.0
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("boxes", [(), (BOX,)])
def test_contributions_are_those_of_one_piece(scene, tmp_path, boxes):
    config = SimplifyConfig.from_mapping(SETTINGS)
    job = run(scene, tmp_path, config, boxes=boxes)
    rows = paired(job, scene)
    kept = int(inside(boxes, scene.means).sum()) if boxes else 0
    assert len(rows.unique()) == COUNT - kept
    found = torch.cat([
        map_tensors(job.contributions_path(block))[0]["contributions"]
        for block in job.blocks_with_rows()
    ])  # fmt: skip
    wanted = contributions(scene, visibility_cameras(scene, config))[rows]
    assert float(wanted.sum()) > 1000
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3)


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
    shown = torch.cat([
        map_tensors(job.contributions_path(block))[0]["contributions"]
        for block in job.blocks_with_rows()
    ])  # fmt: skip
    share = job.config.visibility.mass_share
    hidden = shown == 0
    assert int(hidden.sum()) > 20
    torch.testing.assert_close(after[hidden], share * before[hidden], rtol=1e-5, atol=0)


@pytest.mark.slow
def test_images_that_show_nothing_change_nothing(scene, tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plain = SETTINGS | {"visibility": {"views": 0}}
    expected = run(scene, tmp_path / "a", SimplifyConfig.from_mapping(plain))
    monkeypatch.setattr(
        "cvtgs.outofcore.visibility.contributions",
        lambda scene, cameras: torch.zeros(len(scene), dtype=torch.float64),
    )
    job = run(scene, tmp_path / "b", SimplifyConfig.from_mapping(SETTINGS))
    assert not is_measured(job)
    for block in job.blocks_with_cells():
        assert job.small_path(block).read_bytes() == expected.small_path(block).read_bytes()


@pytest.mark.slow
def test_damaged_contributions_are_measured_again(scene, tmp_path):
    config = SimplifyConfig.from_mapping(SETTINGS)
    job = run(scene, tmp_path, config)
    whole = job.contributions_path(1).read_bytes()
    job.contributions_path(1).write_bytes(whole[:100])
    for path in tmp_path.glob(".out.ply.blocks/*/sample_*"):
        path.unlink()
    seen = {}

    def note(event):
        if event.stage == "assemble":
            seen["again"] = job.contributions_path(1).read_bytes()

    report = simplify_file(
        tmp_path / "in.ply",
        tmp_path / "out.ply",
        count=TARGET,
        blocks=BLOCKS,
        simplifier=Simplifier(config=config, device="cpu"),
        listener=note,
    )
    assert seen["again"] == whole
    assert (report.resumed_blocks, report.views) == (BLOCKS, "found")
