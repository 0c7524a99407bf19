"""The tables of formats and of readers."""

import sys

import cvtgs
from benchmarks import formats
from benchmarks.measuring import Cost


def files_of(tmp_path) -> list[str]:
    files = [tmp_path / folder / "a.ply" for folder in ("one", "two")]
    for count, file in zip((100, 200), files, strict=True):
        file.parent.mkdir()
        cvtgs.save(cvtgs.synthetic.scene("object", count, sh_degree=0, seed=0), file)
    return [str(file) for file in files]


def test_scenes_of_one_name_have_a_table_each(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(formats, "measured", lambda *_: "")
    monkeypatch.setattr(sys, "argv", ["formats", *files_of(tmp_path)])
    formats.main()
    text = capsys.readouterr().out
    assert "one-a.ply: 100 Gaussians" in text
    assert "two-a.ply: 200 Gaussians" in text


def test_peaks_are_above_a_process_with_the_same_imports(tmp_path, monkeypatch, capsys):
    commands = []

    def run_python(*words: str) -> Cost:
        commands.append(words)
        return Cost(user_seconds=1.0, wall_seconds=1.0, peak_bytes=0, output="1.0")

    monkeypatch.setattr(formats, "run_python", run_python)
    monkeypatch.setattr(sys, "argv", ["formats", "--readers", "--runs", "1", *files_of(tmp_path)])
    formats.main()
    assert commands[0] == ("-c", "import benchmarks.formats, plyfile")
    assert commands[1][:2] == ("-m", "benchmarks.formats")
    assert "| one-a.ply | mapped | 1.00 " in capsys.readouterr().out
