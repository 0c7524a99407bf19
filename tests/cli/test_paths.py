"""Paths on the command line that are no paths: empty ones, and - where a folder is written."""

import pytest

from cvtgs.cli.main import main


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["render", "in.ply", "-o", ""], "argument -o/--output: must be a path, found ''"),
        (["info", ""], "argument IN: must be a path, found ''"),
        (["convert", "in.ply", ""], "IN and OUT must be paths, found ''"),
        (["convert", "", "-o", "out"], "IN and OUT must be paths, found ''"),
        (["convert", "a.ply", "b.ply", "--merge="], "argument --merge: must be a path, found ''"),
        (
            ["simplify", "a.ply", "-o", "-", "--rho", "0.1"],
            "argument -o/--output: must be a folder, found '-'; simplify and convert take IN and - "
            "for standard output",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "0.1", "--report", "-"],
            "argument --report: must be a file, found '-'; ./- is a file of this name",
        ),
    ],
)
def test_words_that_are_no_paths_are_usage_errors(capsys, tmp_path, monkeypatch, words, text):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.endswith(f" error: {text}\n")
    assert list(tmp_path.iterdir()) == []
