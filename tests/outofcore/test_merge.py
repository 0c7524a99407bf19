"""Files of finished blocks."""

from types import SimpleNamespace

from cvtgs.outofcore import merge
from cvtgs.outofcore.merge import BlockReport
from scenes import random_scene


def test_the_report_of_a_block_is_written_before_its_scene(tmp_path, monkeypatch):
    """Scene files tell which blocks are finished, so a kill in between must not leave only them."""
    written = []
    monkeypatch.setattr(merge, "save", lambda scene, path, **more: written.append(path.name))
    paths = {
        "small_path": lambda block: tmp_path / f"small_{block}.ply",
        "finished_path": lambda block: tmp_path / f"finished_{block}.ply",
        "report_path": lambda block: tmp_path / f"report_{block}.json",
    }
    job = SimpleNamespace(axes="rdf", write_file=lambda name, _: written.append(name), **paths)
    job.last = job
    report = BlockReport(input_count=5, mass_out=1.0)
    for is_improved in (False, True):
        merge.write_block(job, 3, random_scene(2), report, is_improved=is_improved)
    assert written == ["report_3.json", "small_3.ply", "report_3.json", "finished_3.ply"]
