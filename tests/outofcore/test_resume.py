"""A killed run continues with the missing steps, or starts over; no file is left behind."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import SimplifyConfig
from cvtgs.boxes import Box
from cvtgs.errors import InputError, InvalidSceneError, OutputError
from cvtgs.io.locks import hidden_path
from cvtgs.io.ply import open_rows
from cvtgs.io.tensors import save_tensors
from cvtgs.mergenet import load_checkpoint
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.folders import can_continue
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import LEAST_BYTES
from cvtgs.outofcore.sort import Attempt
from cvtgs.streams import stream_file
from refine_cases import ring

CODE = """
import sys
from cvtgs.outofcore import simplify_file
simplify_file(sys.argv[1], sys.argv[2], 0.05, blocks=8)
"""


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 20_000, sh_degree=1, seed=4), path)
    return path


def start(source, output):
    return subprocess.Popen([sys.executable, "-c", CODE, str(source), str(output)])


def kill_when(process, found):
    """Kill a process as soon as ``found()`` is true; return False if the process ends first."""
    while process.poll() is None:
        if found():
            process.send_signal(signal.SIGKILL)
            process.wait()
            return True
        time.sleep(0.002)
    return False


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
def test_a_killed_run_continues_with_the_missing_blocks(source, tmp_path):
    output, folder = tmp_path / "out.ply", tmp_path / ".out.ply.blocks"
    whole = tmp_path / "whole.ply"
    simplify_file(source, whole, 0.05, blocks=8)
    assert kill_when(start(source, output), lambda: len(list(folder.glob("*/small_*.ply"))) >= 2)
    assert not output.exists()
    done = {path.name: path.stat().st_mtime_ns for path in folder.glob("*/small_*.ply")}
    seen = {}

    def note(event):
        seen.update({path.name: path.stat().st_mtime_ns for path in folder.glob("*/small_*.ply")})

    report = simplify_file(source, output, 0.05, blocks=8, listener=note)
    assert report.resumed_blocks == len(done) >= 2
    assert done.items() <= seen.items()  # the same files, not made again
    assert output.read_bytes() == whole.read_bytes()
    assert not folder.exists()


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
@pytest.mark.parametrize(
    "step", ["sums_*_00001", "parts", "groups", "labels", "merged", "inflated"]
)
def test_a_run_killed_between_steps_of_all_blocks_continues(source, tmp_path, step):
    output, folder = tmp_path / "out.ply", tmp_path / ".out.ply.blocks"
    whole = tmp_path / "whole.ply"
    simplify_file(source, whole, 0.05, blocks=8)
    assert kill_when(start(source, output), lambda: len(list(folder.glob(f"*/{step}*"))) >= 3)
    assert not output.exists()
    names = ("sample", "sites", "sums", "parts", "groups", "labels", "merged", "inflated")
    kept = [name for name in names if (name, step) != ("groups", "groups")]  # all blocks at once
    files = [path for name in kept for path in folder.glob(f"*/{name}_*")]
    done = {path: path.stat().st_mtime_ns for path in files}
    seen = {}

    def note(event):
        if event.stage == "blocks":
            seen.update({path: path.stat().st_mtime_ns for path in done})

    simplify_file(source, output, 0.05, blocks=8, listener=note)
    assert seen == done  # the same files, not made again
    assert output.read_bytes() == whole.read_bytes()


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
def test_a_run_killed_before_all_rows_were_sorted_starts_over(source, tmp_path):
    output, folder = tmp_path / "out.ply", tmp_path / ".out.ply.blocks"
    killed = kill_when(start(source, output), folder.exists)
    assert killed
    assert not list(folder.glob("*/manifest.json"))
    report = simplify_file(source, output, 0.05, blocks=8)
    assert report.resumed_blocks == 0
    assert len(cvtgs.load(output)) == 1000
    assert not folder.exists()


class StoppedError(Exception):
    """Ends a run from its listener."""


def stop_in_blocks(event):
    if event.stage == "blocks" and event.done == 3:
        raise StoppedError


@pytest.mark.long
@pytest.mark.parametrize(
    "change", ["rho", "blocks", "file", "config", "manifest", "scan", "rows", "size"]
)
def test_blocks_of_another_job_are_not_used(source, tmp_path, change):
    output, folder = tmp_path / "out.ply", tmp_path / ".out.ply.blocks"
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    assert len(list(folder.glob("*/small_*.ply"))) == 3
    simplifier = cvtgs.Simplifier(config="draft" if change == "config" else None, device="cpu")
    if change == "file":
        os.utime(source, ns=(0, 0))
    if change == "manifest":
        next(folder.glob("*/manifest.json")).write_text("[]")
    if change == "scan":
        save_tensors(next(folder.glob("*/scan.safetensors")), {}, {})
    if change == "rows":
        with next(folder.glob("*/rows_*")).open("r+b") as file:
            file.write(b"wrong")
    if change == "size":
        with next(folder.glob("*/rows_*")).open("ab") as file:
            file.write(b"more")
    rho, blocks = (0.04 if change == "rho" else 0.05), (7 if change == "blocks" else 8)
    report = simplify_file(source, output, rho, blocks=blocks, simplifier=simplifier)
    assert report.resumed_blocks == 0
    assert len(cvtgs.load(output)) == cvtgs.target_count(20_000, rho)
    assert not folder.exists()


def test_everything_that_a_result_depends_on_changes_the_key_of_a_job(tmp_path, monkeypatch):
    path, scene = tmp_path / "in.ply", cvtgs.synthetic.scene("object", 50, sh_degree=1)
    cvtgs.save(replace(scene, comments=("first",)), path)
    changed_at = path.stat().st_mtime_ns
    job = Job(
        folder="",
        source=open_rows(path),
        target=9,
        blocks=2,
        boxes=(),
        config=SimplifyConfig(),
        has_network=True,
        range_rows=100,
    )
    cameras = ring(2)
    others = [
        {"source": open_rows(path, sh_degree=0)},
        {"source": open_rows(path, axes="lub")},
        {"target": 8},
        {"blocks": 3},
        {"boxes": (Box(min=(0, 0, 0), max=(1, 1, 1)),)},
        {"boxes": (Box(min=(0, 0, 0), max=(1, 1, 2)),)},
        {"config": SimplifyConfig.from_preset("draft")},
        {"range_rows": 99},
        {"sample_rows": 98},
        {"cell_room": 97},
        {"axes": "lub"},
        {"cameras": cameras},
        {"cameras": replace(cameras, Ks=2 * cameras.Ks)},
        {"cameras": replace(cameras, strides=(1, 2))},
        {"cameras": replace(cameras, ignores_tag=(False, True))},
    ]
    keys = {replace(job, **other).key(None) for other in others}
    keys |= {job.key(None), job.key(load_checkpoint("standard")), job.key(load_checkpoint("paper"))}
    assert replace(job, folder="elsewhere").key(None) in keys
    cvtgs.save(replace(scene, comments=("other",)), path, overwrite=True)
    os.utime(path, ns=(changed_at, changed_at))
    keys.add(job.key(None))
    os.utime(path, ns=(0, 0))
    keys.add(job.key(None))
    monkeypatch.setattr(cvtgs, "__version__", "0")
    keys.add(job.key(None))
    assert len(keys) == len(others) + 6


@pytest.mark.long
@pytest.mark.parametrize("is_gone", [True, False])
def test_a_damaged_network_is_written_again(source, tmp_path, is_gone):
    output, whole = tmp_path / "out.ply", tmp_path / "whole.ply"
    simplify_file(source, whole, 0.05, blocks=8)
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    network = next(tmp_path.glob(".out.ply.blocks/*/network.safetensors"))
    if is_gone:
        network.unlink()
    else:
        os.truncate(network, 1000)
    assert simplify_file(source, output, 0.05, blocks=8).resumed_blocks == 3
    assert output.read_bytes() == whole.read_bytes()


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    ["parts", "sample", "groups", "targets", "labels", "sent", "merged", "inflated", "small"],
)
def test_damaged_files_of_steps_are_made_again(source, tmp_path, kind):
    output, folder, whole = tmp_path / "out.ply", tmp_path / ".out.ply.blocks", tmp_path / "w.ply"
    simplify_file(source, whole, 0.05, blocks=8)
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    paths = sorted(folder.glob(f"*/{kind}[._]*"))
    path = next(path for path in paths if path.stat().st_size)
    os.truncate(path, path.stat().st_size // 2)
    report = simplify_file(source, output, 0.05, blocks=8)
    assert report.resumed_blocks == {"small": 2, "targets": 0}.get(kind, 3)
    assert output.read_bytes() == whole.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the maps of Linux")
def test_damaged_files_are_not_mapped_when_they_are_removed(source, tmp_path, monkeypatch):
    """Windows does not remove mapped files."""
    output, seen, unlink = tmp_path / "out.ply", [], Path.unlink
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    sent = next(path for path in tmp_path.glob(".out.ply.blocks/*/sent_*") if path.stat().st_size)
    os.truncate(sent, sent.stat().st_size // 2)

    def look(self, **options):
        maps = Path("/proc/self/maps").read_text(encoding="utf-8")
        seen.append((self.name, str(self) in maps))
        unlink(self, **options)

    monkeypatch.setattr(Path, "unlink", look)
    simplify_file(source, output, 0.05, blocks=8)
    labels = sent.name.replace("sent", "labels")
    assert (labels, False) in seen
    assert not [name for name, is_mapped in seen if is_mapped]


def test_a_job_that_fails_before_it_can_resume_leaves_no_folder(source, tmp_path):
    scene = cvtgs.load(source)
    bad = scene.with_tensors({"means": torch.full_like(scene.means, torch.nan)}, {})
    cvtgs.save(bad, source, overwrite=True)
    with pytest.raises(InvalidSceneError):
        simplify_file(source, tmp_path / "out.ply", 0.05, blocks=3)
    with pytest.raises(InvalidSceneError):
        stream_file(source, tmp_path / "stream", [0.5, 0.1], kind="sog", blocks=3)
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


def test_rows_that_cannot_be_written_are_one_sentence(tmp_path):
    with pytest.raises(OutputError, match=r"attempt_rows_\S*: the output must be writable, found"):
        Attempt(str(tmp_path / "gone")).append("rows", b"1")


def test_a_listener_that_raises_at_the_end_leaves_only_the_output(source, tmp_path):
    def stop(event):
        if event.stage == "assemble" and event.done == event.total:
            raise KeyError(event.stage)

    with pytest.raises(KeyError, match="assemble"):
        simplify_file(source, tmp_path / "out.ply", 0.05, blocks=3, listener=stop)
    assert len(cvtgs.load(tmp_path / "out.ply")) == 1000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.ply", "out.ply"]


def replaced(source):
    scene = cvtgs.load(source)
    cvtgs.save(scene.with_tensors({"means": scene.means + 100}, {}), source, overwrite=True)
    os.utime(source, ns=(0, 0))


def shortened(source):
    os.truncate(source, source.stat().st_size // 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "found"),
    [(replaced, "it changed; start again"), (shortened, "it shorter"), (Path.unlink, "no such f")],
)
@pytest.mark.parametrize(
    "run",
    [
        partial(simplify_file, rho=0.05, blocks=3),
        partial(stream_file, rhos=[0.5, 0.1], kind="sog", blocks=3),
    ],
)
def test_a_source_that_changes_while_it_is_sorted_is_refused(source, tmp_path, change, found, run):
    def spoil(event):
        if event.stage == "sort" and event.done == 0:
            change(source)

    with pytest.raises(InputError, match=f"in.ply: must stay as it is while .*, found {found}"):
        run(source, tmp_path / "out.ply", listener=spoil)
    assert {path.name for path in tmp_path.iterdir()} <= {"in.ply"}


@pytest.mark.parametrize("stage", ["scan", "sort"])
def test_an_interrupt_before_all_rows_are_sorted_leaves_no_folder(source, tmp_path, stage):
    def interrupt(event):
        if event.stage == stage and event.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simplify_file(source, tmp_path / "out.ply", 0.05, blocks=3, listener=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    [
        partial(simplify_file, rho=0.05, blocks=3),
        partial(stream_file, rhos=[0.5, 0.1], kind="sog", blocks=3),
    ],
)
def test_a_finished_run_that_is_interrupted_is_not_offered_to_be_continued(
    source, tmp_path, monkeypatch, run
):
    def interrupted(folder, **_):
        if output.exists():  # before that, earlier files are removed
            raise KeyboardInterrupt

    output = tmp_path / "out"
    output = output if run.func is stream_file else output.with_suffix(".ply")
    monkeypatch.setattr(shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(source, output)
    assert hidden_path(output, "blocks").is_dir()
    assert not can_continue(output)


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "second", "continues"),
    [(0, 0, True), (0, 1, True), (0, 50, True), (0, 600, True), (50, 0, False), (600, 30, False)],
)
def test_a_run_continues_with_its_blocks_if_the_memory_is_enough(
    source, tmp_path, monkeypatch, first, second, continues
):
    """The memory is in MB, above the least; with less than 40, the sample is smaller, too."""

    def count(rows, memory, *, merging=0):
        return 8 if memory < LEAST_BYTES + 20_000_000 else 4

    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", count)
    first, second = (LEAST_BYTES + 1_000_000 * more for more in (first, second))
    output, whole = tmp_path / "out.ply", tmp_path / "whole.ply"
    simplify_file(source, whole, 0.05, memory=first)
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, memory=first, listener=stop_in_blocks)
    report = simplify_file(source, output, 0.05, memory=second)
    wanted = (3, 8) if continues else (0, count(None, second))
    assert (report.resumed_blocks, report.blocks) == wanted
    assert not continues or output.read_bytes() == whole.read_bytes()
    assert not (tmp_path / ".out.ply.blocks").exists()


@pytest.mark.long
def test_blocks_that_were_asked_for_are_used(source, tmp_path):
    output = tmp_path / "out.ply"
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    assert simplify_file(source, output, 0.05, blocks=4).resumed_blocks == 0


@pytest.mark.long
@pytest.mark.parametrize("damage", [b"", b"{}", b'{"blocks": 8}'])
def test_a_run_without_readable_sizes_is_not_continued_by_another_memory(
    source, tmp_path, monkeypatch, damage
):
    output = tmp_path / "out.ply"
    with pytest.raises(StoppedError):
        simplify_file(source, output, 0.05, blocks=8, listener=stop_in_blocks)
    next(tmp_path.glob(".out.ply.blocks/*/sizes.json")).write_bytes(damage)
    report = simplify_file(source, output, 0.05)
    assert (report.resumed_blocks, report.blocks) == (0, 1)
