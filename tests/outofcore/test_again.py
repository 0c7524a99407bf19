"""Runs that allocate cells a second time, by errors of given cameras, and are interrupted."""

import os

import pytest

import cvtgs
from block_jobs import StoppedError
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.outofcore import simplify_file
from refine_cases import ring

SETTINGS = {
    "preset": "matched",
    "visibility": {"views": 4, "size": 32, "stride": 1},
    "match": {"color_iterations": 4},
    "refine": {"steps": 0},
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("again") / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 1500, sh_degree=1, seed=4), path)
    return path


def run(source, output, listener=lambda event: None):
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(SETTINGS), device="cpu")
    return simplify_file(
        source, output, count=90, blocks=2, simplifier=simplifier, cameras=ring(6),
        listener=listener,
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(source, tmp_path_factory):
    output = tmp_path_factory.mktemp("whole") / "out.ply"
    run(source, output)
    return output.read_bytes()


def stopped_in(source, output, stage, nth):
    """Run until the ``nth`` start of a stage; return the folder of the blocks."""
    starts = []

    def stop(event):
        if event.stage == stage and event.done == 0:
            starts.append(stage)
            if len(starts) == nth:
                raise StoppedError

    with pytest.raises(StoppedError):
        run(source, output, stop)
    return next(output.parent.glob(".out.ply.blocks/*"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("stage", "nth"), [("errors", 1), ("allocate", 2), ("merge", 2), ("blocks", 2), ("images", 1)]
)
def test_a_run_continues_in_the_second_allocation(source, whole, tmp_path, stage, nth):
    output = tmp_path / "out.ply"
    folder = stopped_in(source, output, stage, nth)
    names = ("parts", "labels", "merged", "small")
    done = {path: path.stat().st_mtime_ns for name in names for path in folder.glob(f"{name}_*")}
    seen = {}

    def note(event):
        if event.stage == "images" and not seen:
            seen.update({path: path.stat().st_mtime_ns for path in done})

    run(source, output, note)
    assert seen == done  # the same files, not made again
    assert output.read_bytes() == whole
    assert not folder.exists()


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [
        "labels_0", "errors", "factors", "targets.", "targets_again", "parts_again", "groups_again",
        "labels_again", "sent_again", "merged_again", "small_again", "small_0",
    ],
)  # fmt: skip
def test_damaged_files_of_both_allocations_are_made_again(source, whole, tmp_path, kind):
    output = tmp_path / "out.ply"
    folder = stopped_in(source, output, "images", 1)
    paths = sorted(folder.glob(f"{kind}*"))
    path = next(path for path in paths if path.stat().st_size)
    os.truncate(path, path.stat().st_size // 2)
    assert run(source, output).output_count == 90
    assert output.read_bytes() == whole


@pytest.mark.slow
def test_the_output_of_unmatched_blocks_has_the_wanted_axes(source, tmp_path):
    """Only the last of the simplified blocks is written in the axes of the output."""
    found = {}
    values = SETTINGS | {"match": {"opacity_rounds": 0, "color_iterations": 0, "error_power": 1.0}}
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(values), device="cpu")
    for axes in ("rdf", "rub"):
        output = tmp_path / f"{axes}.ply"
        simplify_file(
            source, output, count=90, blocks=2, simplifier=simplifier, cameras=ring(6),
            output_axes=axes,
        )  # fmt: skip
        found[axes] = cvtgs.load(output, axes=axes)
    means = [scene.means for scene in found.values()]
    assert len(means[0]) == 90
    assert means[0].tolist() == means[1].tolist()
