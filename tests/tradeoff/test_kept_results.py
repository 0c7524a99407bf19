"""Results that are kept: all of them replace those of an earlier tradeoff together, or none."""

import os
import stat
from pathlib import Path

import pytest

import cvtgs
from cvtgs import Simplifier
from cvtgs.errors import OutputError, RunError
from cvtgs.tradeoff import measure_tradeoff
from cvtgs.tradeoff.measure import Run, Task
from cvtgs.tradeoff.process_cost import ProcessCost
from cvtgs.views import automatic_views

NAMES = ["draft_0.1.ply", "fast_0.1.ply"]
COST = ProcessCost(
    wall_seconds=1.0, user_seconds=1.0, peak_memory_bytes=10**8, output="", errors=""
)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    cvtgs.save(cvtgs.synthetic.scene("object", 200, sh_degree=0), tmp_path / "in.ply")
    return tmp_path / "in.ply"


def measure(
    source: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, *, failing: BaseException | None
) -> None:
    """Run two presets in this process; the second one fails, if it should."""

    def run(source: Path, task: Task, folder: Path, **_: object) -> Run:
        if failing is not None and task.preset == "fast":
            raise failing
        small = Simplifier(preset=task.preset, device="cpu").run(cvtgs.load(source), task.rho)
        path = folder / task.file_name
        cvtgs.save(small.scene, path, overwrite=True)
        return Run(task=task, path=path, cost=COST, report=small.report)

    monkeypatch.setattr("cvtgs.tradeoff.measure.run_task", run)
    monkeypatch.setattr("cvtgs.tradeoff.measure.start_seconds", lambda: 0.0)
    measure_tradeoff(
        source,
        presets=["draft", "fast"],
        rhos=[0.1],
        cameras=lambda scene: automatic_views(scene, 1, width=24, height=16),
        folder=folder,
    )


@pytest.mark.slow
@pytest.mark.parametrize("failing", [KeyboardInterrupt(), RunError("it failed"), None])
def test_an_interrupt_leaves_the_results_that_the_old_page_describes(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, failing: BaseException | None
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    for name in (*NAMES, "index.html"):
        (folder / name).write_bytes(b"old")
    if isinstance(failing, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            measure(source, folder, monkeypatch, failing=failing)
        replaced = set()
    elif failing is not None:  # what did not fail is replaced
        with pytest.warns(UserWarning, match="fast 0.1 failed: it failed"):
            measure(source, folder, monkeypatch, failing=failing)
        replaced = {NAMES[0]}
    else:
        measure(source, folder, monkeypatch, failing=failing)
        replaced = set(NAMES)
    assert sorted(path.name for path in folder.iterdir()) == [*NAMES, "index.html"]
    assert {name for name in NAMES if (folder / name).read_bytes() != b"old"} == replaced


@pytest.mark.skipif(os.name == "nt", reason="Windows has other permissions and few links")
def test_kept_results_follow_links_and_keep_permissions(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out").mkdir()
    target, link = tmp_path / "target.ply", tmp_path / "out" / NAMES[0]
    target.write_bytes(b"old")
    target.chmod(0o640)
    link.symlink_to(target)
    measure(source, tmp_path / "out", monkeypatch, failing=None)
    assert link.is_symlink()
    assert len(cvtgs.load(target)) == 20
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_results_that_cannot_be_kept_are_refused_before_the_work(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out" / NAMES[1]).mkdir(parents=True)
    with pytest.raises(OutputError, match=r"fast_0\.1\.ply: the output must be a file, found a d"):
        measure(source, tmp_path / "out", monkeypatch, failing=AssertionError())
