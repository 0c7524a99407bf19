"""Runs in blocks that stop before their end, so that tests can read the files of their steps."""

import pytest

import cvtgs
from cvtgs import Simplifier
from cvtgs.io.ply import open_rows
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.job import Job


class StoppedError(Exception):
    """Ends a run from its listener."""


def stop_before_assemble(event):
    if event.stage == "assemble":
        raise StoppedError


def unfinished_job(scene, folder, *, count, blocks, config=None, boxes=(), cameras=None):
    """Return a job that is complete except for the assembly of its blocks."""
    source, simplifier = folder / "in.ply", Simplifier(config=config, device="cpu")
    cvtgs.save(scene, source)
    with pytest.raises(StoppedError):
        simplify_file(
            source,
            folder / "out.ply",
            count=count,
            blocks=blocks,
            boxes=boxes,
            simplifier=simplifier,
            cameras=cameras,
            listener=stop_before_assemble,
        )
    return Job(
        folder=str(next((folder / ".out.ply.blocks").iterdir())),
        source=open_rows(source),
        target=count,
        blocks=blocks,
        boxes=tuple(boxes),
        config=simplifier.config,
        has_network=True,
        range_rows=1 << 26,
        cameras=cameras,
    )
