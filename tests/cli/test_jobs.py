"""Many scenes in one command, standard streams, sizes and the last line of the output."""

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli import jobs
from cvtgs.cli.main import main
from cvtgs.text import size_text
from format_cases import DATA, WRITABLE

NAMES = ("a.ply", "b.compressed.ply", "c.spz")


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three scenes of 100, 200 and 300 Gaussians in the working directory."""
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(NAMES, start=1):
        cvtgs.save(cvtgs.synthetic.scene("object", 100 * number, sh_degree=0, seed=3), name)
    return tmp_path


SMALL = ("--preset", "draft")


def wrong_usage(*words: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(list(words))
    return int(str(stopped.value.code))


@pytest.mark.parametrize("given", [NAMES, ("*",), ("a.ply", "[bc].*")])
def test_each_of_many_scenes_gets_a_line(
    scenes: Path, capsys: pytest.CaptureFixture[str], given: tuple[str, ...]
) -> None:
    assert main(["simplify", *given, "--rho", "10%", "-o", "out", *SMALL]) == 0
    printed = capsys.readouterr()
    counts = {path.name: len(cvtgs.load(path)) for path in Path("out").iterdir()}
    assert counts == dict(zip(NAMES, (10, 20, 30), strict=True))
    *lines, last = printed.out.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        f"[{number}/3] {name}" for number, name in enumerate(NAMES, start=1)
    ]
    assert "200 -> 20 Gaussians, " in lines[1]
    assert last.startswith("3 scenes in out, ")
    assert max(map(len, (*lines, last))) <= 80
    assert printed.err == ""


def test_a_folder_is_expanded_to_the_scenes_in_it(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scenes / "notes.txt").write_text("not a scene")
    (scenes / "model").mkdir()  # the folder of a trained model is one scene
    cvtgs.save(cvtgs.load("a.ply"), "model/point_cloud.ply")
    (scenes / "model" / "other.ply").write_text("not read")
    (scenes / "none").mkdir()  # holds no scene
    assert main(["convert", ".", "-o", "out", "--suffix", ".splat", "--quiet"]) == 0
    assert {path.name for path in Path("out").iterdir()} == {
        *("a.splat", "b.splat", "c.splat", "model.splat")
    }
    assert main(["convert", "none", "-o", "out"]) == 1
    assert "none: must be a file or the folder of a trained model" in capsys.readouterr().err


def test_the_last_line_adds_the_sizes_of_all_scenes(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", *NAMES, "-o", "out", "--suffix", ".splat"]) == 0
    before = sum((scenes / name).stat().st_size for name in NAMES)
    after = sum(path.stat().st_size for path in Path("out").iterdir())
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"3 scenes in out, {size_text(before)} -> {size_text(after)}"


def test_the_name_of_a_folder_is_no_pattern(scenes: Path) -> None:
    (scenes / "scans [1]").mkdir()
    (scenes / "a.ply").rename(scenes / "scans [1]" / "a.ply")
    assert main(["convert", "scans [1]", "-o", "out", "--quiet"]) == 0
    assert [path.name for path in Path("out").iterdir()] == ["a.ply"]


@pytest.mark.parametrize("given", [".", "meta.json", "lod-meta.json"])
def test_a_folder_that_is_a_scene_names_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    (tmp_path / "room").mkdir()
    monkeypatch.chdir(tmp_path / "room")
    assert vars(jobs)["_output_name"](Path(given), None) == "room.ply"


def test_the_suffix_of_levels_needs_no_dot(scenes: Path) -> None:
    words = ["--rho", "0.1", "--suffix", "spz", "--no-scores", "--quiet"]
    assert main(["levels", "a.ply", "-o", "out", *words]) == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["levels.json", "rho_0.1.spz"]


def test_suffix_applies_to_all_scenes(scenes: Path) -> None:
    assert main(["convert", *NAMES, "-o", "deep/out", "--suffix", "splat", "--quiet"]) == 0
    names = {path.name for path in Path("deep/out").iterdir()}
    assert names == {"a.splat", "b.splat", "c.splat"}


def test_paths_may_stand_between_options(scenes: Path) -> None:
    words = ["simplify", "a.ply", "--rho", "10%", "c.spz", "-o", "out", "--quiet", "b.*", *SMALL]
    assert main(words) == 0
    assert len(list(Path("out").iterdir())) == 3
    assert main(["simplify", "--count", "0.01k", "a.ply", "--quiet", "z.ply", *SMALL]) == 0
    assert len(cvtgs.load("z.ply")) == 10


def test_max_count_leaves_smaller_scenes_unchanged(scenes: Path) -> None:
    assert main(["simplify", *NAMES, "-o", "out", "--max-count", "0.15k", "--quiet", *SMALL]) == 0
    assert [len(cvtgs.load(Path("out") / name)) for name in NAMES] == [100, 150, 150]
    assert Path("out/a.ply").read_bytes() == Path("a.ply").read_bytes()


def test_a_scene_that_fails_does_not_stop_the_others(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("b.compressed.ply").write_bytes(b"ply\nnonsense")
    assert main(["convert", "missing.ply", *NAMES, "-o", "out"]) == 1
    printed = capsys.readouterr()
    first, second, last = printed.err.splitlines()
    assert first.startswith("cvtgs: error: [1/4] missing.ply: ")
    assert second.startswith("cvtgs: error: [3/4] b.compressed.ply: ")
    assert last == "cvtgs: error: 2 of 4 scenes failed; 2 are in out."
    assert {path.name for path in Path("out").iterdir()} == {"a.ply", "c.spz"}
    assert [line[:5] for line in printed.out.splitlines()] == ["[2/4]", "[4/4]"]
    assert main(["convert", "missing.ply", "a.ply", "-o", "new"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "cvtgs: error: 1 of 2 scenes failed; 1 is in new."


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["a.ply", "other/a.ply", "-o", "out"], "two scenes must not have the same name in out"),
        (
            ["a.ply", "a.spz", "-o", ".", "--suffix", "spz"],
            "the same name in ., found a.ply and a.spz.",
        ),
        (["a.ply", "./a.ply", "-o", "out"], "every scene must be given once, found a.ply twice."),
        (["nothing*", "-o", "out"], "nothing*: the pattern must match a file, found none."),
        (["a.ply", "-o", "note"], "note: must be a folder or a new path, found: "),
        (["a.ply", "c.spz", "-o", "out", "--suffix", "xyz"], "--suffix must end in "),
        (
            ["c.spz", "a.ply", "-o", "other", "--merge", "other/a.ply"],
            "the output of a.ply must not replace another input, found other/a.ply.",
        ),
    ],
)
def test_invalid_jobs_are_refused_before_the_work(
    scenes: Path, capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    Path("a.spz").write_bytes(Path("c.spz").read_bytes())
    Path("note").touch()
    assert main(["convert", *words, "--overwrite"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert text in printed.err
    assert not list(Path().glob("out/*"))


@pytest.mark.parametrize(("system", "status"), [("linux", 0), ("darwin", 1), ("win32", 1)])
def test_names_that_differ_by_case_are_one_file_on_some_systems(
    scenes: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    system: str,
    status: int,
) -> None:
    Path("more").mkdir()
    Path("more/A.ply").write_bytes(Path("a.ply").read_bytes())
    if sys.platform in ("darwin", "win32") and status == 0:
        pytest.skip("names of this system ignore case")
    monkeypatch.setattr(sys, "platform", system)
    assert main(["convert", "a.ply", "more/A.ply", "-o", "out"]) == status
    printed = capsys.readouterr()
    assert ("two scenes must not have the same name in out" in printed.err) == bool(status)


def test_a_folder_with_an_impossible_name_is_one_sentence(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", "a.ply", "-o", "x" * 300]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_the_report_of_many_scenes_has_one_entry_for_each(scenes: Path) -> None:
    (scenes / "bad.ply").write_bytes(b"none")
    words = ["simplify", NAMES[0], "bad.ply", "missing.ply", "-o", "out", "--rho", "0.1", *SMALL]
    assert main([*words, "--report", "r.json"]) == 1
    good, bad, missing = json.loads((scenes / "r.json").read_text())
    assert (good["input"], good["output"]) == (NAMES[0], str(Path("out") / NAMES[0]))
    assert good["error"] is None
    assert len(cvtgs.load(good["output"])) == good["report"]["output_count"] > 0
    for entry, reason in ((bad, "bad.ply"), (missing, "missing.ply")):
        assert entry["report"] is None
        assert reason in entry["error"]
    assert main([*words[:2], *words[4:], "--overwrite", "--report", "r.json"]) == 0
    assert [entry["error"] for entry in json.loads((scenes / "r.json").read_text())] == [None]


@pytest.mark.parametrize(
    "words",
    [["a.ply"], ["a.ply", "b.ply", "c.ply"], ["-", "-o", "out"], ["a", "b.ply", "--suffix", "spz"]],
)
def test_invalid_combinations_of_paths_are_usage_errors(
    scenes: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert wrong_usage("convert", *words) == 2
    assert "usage: cvtgs convert IN OUT " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (NAMES, "any number of IN and -o DIR to write into a folder; found 3 paths (a.ply, "),
        (["a.ply", "folder"], "OUT must be a file; to write into a folder, use -o folder\n"),
        (["a.ply", "new/"], "OUT must be a file; to write into a folder, use -o new/\n"),
        (["a.ply", "new"], "such as new.ply; to write into a folder, use -o new\n"),
    ],
)
def test_a_forgotten_o_is_mentioned(
    scenes: Path, capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    Path("folder").mkdir()
    assert wrong_usage("convert", *words) == 2
    assert text in capsys.readouterr().err


def test_a_folder_of_scenes_is_not_one_scene(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = "cvtgs: error: .: must be one scene, found a folder of 3 scenes; "
    assert main(["info", "."]) == 1
    assert capsys.readouterr().err == f"{found}give one of them, for example ./a.ply.\n"
    assert main(["convert", ".", "out.ply"]) == 1
    assert capsys.readouterr().err == f"{found}to write into a folder, use -o DIR.\n"


def test_the_last_line_names_the_output(scenes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simplify", "a.ply", "z.ply", "--rho", "0.1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("z.ply: 100 -> 10 Gaussians, 7.3 kB -> ")
    assert max(map(len, lines)) <= 80
    long = f"{'long' * 20}.ply"
    assert main(["simplify", "a.ply", long, "--rho", "0.1"]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert last == long
    assert max(map(len, lines)) <= 80


def test_sizes_before_and_after_are_right_in_place(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path("a.ply").stat().st_size
    assert main(["simplify", "a.ply", "a.ply", "--rho", "0.1", "--overwrite", *SMALL]) == 0
    after = Path("a.ply").stat().st_size
    assert f", {size_text(before)} -> {size_text(after)}, " in capsys.readouterr().out
    assert main(["convert", "a.ply", "-o", ".", "--overwrite"]) == 0
    assert f", {size_text(after)} -> {size_text(after)}" in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_standard_input_and_output_hold_scenes(
    scenes: Path,
    capsysbinary: pytest.CaptureFixture[bytes],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    class Stream(io.TextIOWrapper):
        """Standard input with given bytes."""

    monkeypatch.setattr(sys, "stdin", Stream(io.BytesIO(Path(name).read_bytes())))
    assert main(["simplify", "-", "-", "--count", "7", "--suffix", "spz", *SMALL]) == 0
    printed = capsysbinary.readouterr()
    assert len(cvtgs.load(io.BytesIO(printed.out))) == 7
    assert printed.err.splitlines()[-1].startswith(b"standard output: ")
    assert main(["convert", name, "-", "--quiet"]) == 0
    assert capsysbinary.readouterr().out[:3] == b"ply"
    monkeypatch.setattr(sys, "stdin", Stream(io.BytesIO(Path(name).read_bytes())))
    assert main(["info", "-"]) == 0
    first, second = capsysbinary.readouterr().out.decode().splitlines()[:2]
    assert re.fullmatch(r"file +standard input, [\d.]+ k?B", first)
    assert second.split() == ["Gaussians", str(len(cvtgs.load(name)))]


def test_messages_name_standard_output(
    scenes: Path, capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    assert main(["convert", str(DATA / "source.ply"), "-", "--suffix", ".splat"]) == 0
    assert capsysbinary.readouterr().err.startswith(b"In .splat files:")
    words = ["simplify", str(DATA / "source.ply"), "-", "--count", "7", "--suffix", ".splat"]
    assert main([*words, *SMALL]) == 0
    said = capsysbinary.readouterr().err.decode()
    assert "warning: standard output: files of this format do not hold SH" in " ".join(said.split())


def test_an_unknown_suffix_for_standard_output_is_refused(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", "a.ply", "-", "--suffix", "foo"]) == 1
    said = capsys.readouterr().err
    assert said == f"cvtgs: error: --suffix must end in {WRITABLE}, found '.foo'.\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            b"what?",
            "standard input: the first bytes must be those of a .ply, .spz, .sog, .glb or .pt, "
            "found b'what'; save a scene in another format as a file, whose suffix gives the "
            "format.",
        ),
        (b"ply\nx", "standard input: the header must end with 'end_header', found none in 5 bytes"),
    ],
)
def test_standard_input_without_a_scene_is_refused(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    content: bytes,
    said: str,
) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
    assert main(["convert", "-", str(tmp_path / "a.ply")]) == 1
    assert capsys.readouterr().err.startswith(f"cvtgs: error: {said}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_two_commands_work_in_a_pipe(scenes: Path) -> None:
    program = f"{sys.executable} -m cvtgs"
    line = f"cat a.ply | {program} simplify - - --rho 10% | {program} convert - z.splat"
    done = subprocess.run(line, shell=True, capture_output=True, text=True, check=True)
    assert len(cvtgs.load("z.splat")) == 10
    assert done.stdout.splitlines()[-1].startswith("z.splat: 10 Gaussians of SH degree 0, ")


def test_a_full_folder_of_temporary_files_is_named(scenes: Path) -> None:
    """Standard output is written as a file first; its path is nobody's business."""
    line = f"ulimit -f 1; {sys.executable} -m cvtgs convert a.ply - | cat > b.ply"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    said = " ".join(done.stderr.split())
    assert "cvtgs: error: the folder of temporary files must be writable and have room" in said
    assert "found: file too large; TMPDIR sets another folder." in said


def test_a_scene_is_not_written_to_a_terminal(
    scenes: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert main(["convert", "a.ply", "-"]) == 1
    assert capsys.readouterr().err == (
        "cvtgs: error: standard output must be a pipe or a file, found a terminal.\n"
    )


def test_a_scene_is_not_read_from_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = io.TextIOWrapper(io.BytesIO())
    monkeypatch.setattr(typed, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", typed)
    assert main(["info", "-"]) == 1
    assert capsys.readouterr().err == (
        "cvtgs: error: standard input must be a pipe or a file, found a terminal.\n"
    )


def test_a_plain_run_makes_no_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed process would leave it in the system's temporary folder for ever."""
    cvtgs.save(cvtgs.synthetic.scene("object", 100, sh_degree=0), tmp_path / "in.ply")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert main(["convert", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--quiet"]) == 0
    assert (tmp_path / "out.ply").exists()


def test_an_output_may_not_replace_another_input(
    scenes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cvtgs.save(cvtgs.load("c.spz"), "a.small.ply")
    before = Path("a.small.ply").read_bytes()
    words = ["a.ply", "a.small.ply", "-o", str(scenes), "--suffix", ".small.ply", "--overwrite"]
    assert main(["convert", *words]) == 1
    assert "the output of a.ply must not replace another input, found" in capsys.readouterr().err
    assert Path("a.small.ply").read_bytes() == before
