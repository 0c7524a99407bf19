"""Many scenes in one command, of which some fail, or whose results another program moves."""

import json
import os
import weakref
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import InputError, OutOfMemoryError

RUN = ("simplify", ".", "-o", "out", "--rho", "0.1", "--preset", "draft")


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three scenes of 100, 200 and 300 Gaussians in the working directory."""
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path / "in")
    for number, name in enumerate("abc", start=1):
        scene = cvtgs.synthetic.scene("object", 100 * number, sh_degree=0, seed=3)
        cvtgs.save(scene, f"{name}.ply")
    return tmp_path


def written() -> list[str]:
    return sorted(path.name for path in Path("out").iterdir())


@pytest.mark.skipif(os.name != "posix", reason="Windows limits whole paths")
def test_names_may_be_as_long_as_the_system_allows() -> None:
    name = f"{'x' * 251}.ply"
    Path("b.ply").rename(name)
    assert main([*RUN, "--report", "report.json", "--quiet"]) == 0
    assert written() == ["a.ply", "c.ply", name]
    assert len(json.loads(Path("report.json").read_text())) == 3


def test_a_failed_run_removes_the_folder_that_a_link_leads_to() -> None:
    Path("out").symlink_to(Path("../real"))
    assert main([*RUN, "--quiet", "--keep", "none.json"]) == 1
    assert not Path("out").exists()
    assert main([*RUN, "--quiet"]) == 0
    assert written() == ["a.ply", "b.ply", "c.ply"]
    assert Path("out").is_symlink()


@pytest.mark.parametrize(
    "words", [RUN, ("convert", ".", "-o", "out", "--suffix", ".splat")], ids=lambda words: words[0]
)
def test_another_run_may_remove_the_empty_folder_meanwhile(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failed run removes a folder that it made, in which others have not written yet."""
    read = cvtgs.io.load

    def read_and_remove(*arguments: object, **options: object) -> cvtgs.GaussianScene:
        if not list(Path("out").iterdir()):
            Path("out").rmdir()
        return read(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(cvtgs, "load", read_and_remove)  # which is looked up in cvtgs.io once
    monkeypatch.setattr(cvtgs.io, "load", read_and_remove)
    assert main([*words, "--quiet"]) == 0
    assert len(written()) == 3


def test_results_may_be_moved_away_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save = cvtgs.io.save

    def save_and_move(scene: cvtgs.GaussianScene, path: Path, **options: object) -> None:
        save(scene, path, **options)  # type: ignore[arg-type]
        if path.name == "b.ply":
            path.rename("moved.ply")

    monkeypatch.setattr(cvtgs.io, "save", save_and_move)
    assert main([*RUN]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == [
        "[1/3] a.ply",
        "[2/3] b.ply",
        "[3/3] c.ply",
    ]
    assert "200 -> 20 Gaussians, 14.1 kB -> moved away, " in lines[1]
    assert lines[3].startswith("3 scenes in out, ")
    assert main(["simplify", "b.ply", "out/b.ply", "--rho", "0.1", "--preset", "draft"]) == 0
    assert "out/b.ply: 200 -> 20 Gaussians, 14.1 kB -> moved away" in capsys.readouterr().out


def test_the_report_has_the_scenes_before_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    load = cvtgs.io.load

    def interrupted_load(path: Path, **options: object) -> cvtgs.GaussianScene:
        if path.name == "c.ply":
            raise KeyboardInterrupt
        return load(path, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(cvtgs.io, "load", interrupted_load)
    with pytest.raises(KeyboardInterrupt):
        main([*RUN, "--report", "report.json", "--quiet"])
    entries = json.loads(Path("report.json").read_text())
    assert [entry["output"] for entry in entries] == [f"out{os.sep}a.ply", f"out{os.sep}b.ply"]


def test_a_report_that_fails_too_does_not_replace_the_first_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    load = cvtgs.io.load

    def load_and_take_the_name(path: Path, **options: object) -> cvtgs.GaussianScene:
        Path("report.json").write_text("of another run")
        if path.name == "b.ply":
            raise InputError("b.ply: damaged.")
        return load(path, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(cvtgs.io, "load", load_and_take_the_name)
    assert main([*RUN, "--report", "report.json", "--quiet"]) == 1
    damaged, report, last = capsys.readouterr().err.splitlines()
    assert damaged == "cvtgs: error: [2/3] b.ply: damaged."
    assert report.startswith("cvtgs: warning: report.json: the output must not exist yet")
    assert report.endswith("; 2 of 3 scenes in out were written, the report was not.")
    assert last == "cvtgs: error: 1 of 3 scenes failed; 2 are in out."


def test_a_folder_without_a_scene_does_not_stop_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("none").mkdir()
    words = ["simplify", "a.ply", "none", "c.ply", *RUN[2:]]
    assert main([*words, "--report", "report.json"]) == 1
    assert written() == ["a.ply", "c.ply"]
    error, last = capsys.readouterr().err.splitlines()
    assert error.startswith("cvtgs: error: [2/3] none: must be a file or the folder of a trained")
    assert last == "cvtgs: error: 1 of 3 scenes failed; 2 are in out."
    errors = [entry["error"] for entry in json.loads(Path("report.json").read_text())]
    assert [error is None for error in errors] == [True, False, True]


def test_errors_name_their_scene(capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.ply").rename("1")  # which is also in the number of the message
    words = ["simplify", "1", "b.ply", "-o", "out", "--count", "150", *RUN[6:], "--quiet"]
    assert main(words) == 1
    first = capsys.readouterr().err.splitlines()[0]
    assert first.startswith("cvtgs: error: [1/2] 1: count must be a whole number between 1 and")


@pytest.mark.slow
def test_a_scene_that_failed_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[weakref.ref[cvtgs.GaussianScene]] = []
    is_freed = []

    def run(
        self: cvtgs.Simplifier, scene: cvtgs.GaussianScene, *words: object, **options: object
    ) -> None:
        is_freed.extend(one() is None for one in seen[-1:])
        seen.append(weakref.ref(scene))
        error = OutOfMemoryError("it needs more memory than is available.")
        raise error  # its traceback has this call, which has the error

    monkeypatch.setattr(cvtgs.Simplifier, "run", run)
    assert main([*RUN, "--quiet"]) == 1
    assert is_freed == [True, True]


@pytest.mark.parametrize(
    ("suffix", "name"),
    [("splat", "a.splat"), (".small.ply", "a.small.ply"), ("_small.ply", "a_small.ply")],
)
def test_suffixes_may_continue_the_name(suffix: str, name: str) -> None:
    assert main(["convert", "a.ply", "-o", "out", "--suffix", suffix, "--quiet"]) == 0
    assert written() == [name]


def test_tiles_are_not_taken_for_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["levels", "c.ply", "-o", "tiles", "--rho", "1,0.1", "--stream", "3dtiles"]
    assert main([*words, "--preset", "draft", "--quiet"]) == 0
    for command in (["simplify", "tiles", *RUN[2:]], ["info", "tiles"]):
        assert main(command) == 1
        assert capsys.readouterr().err.startswith(
            "cvtgs: error: tiles: must be a scene or a folder of scenes, found 3D Tiles"
        )
