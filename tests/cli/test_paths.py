"""Paths on the command line that are no paths: empty ones, and - where a folder is written."""

from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.main import main
from scenes import random_scene


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
            ["render", "in.ply", "-o", "image.png"],
            "argument -o/--output: must be a folder, found the file name 'image.png'",
        ),
        (
            ["levels", "in.ply", "-o", "new/Small.PLY"],
            "argument -o/--output: must be a folder, found the file name 'new/Small.PLY'",
        ),
        (
            ["convert", "a.ply", "b.ply", "-o", "c.spz"],
            "-o must be a folder for 2 scenes, found 'c.spz'",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "0.1", "--report", "-"],
            "argument --report: must be a file, found '-'; ./- is a file of this name",
        ),
        (
            ["view", "a.ply", "--page", "page.JSON"],
            "argument --page: must be a .html file, found 'page.JSON'",
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


def test_paths_may_have_the_name_of_an_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("h").mkdir()
    cvtgs.save(random_scene(20), "h/a.ply")
    assert main(["convert", "h", "-o", "o"]) == 0
    assert main(["simplify", "--rho", "0.5", "o", "-o", "small"]) == 0
    assert len(cvtgs.load("small/a.ply")) == 10


def test_o_may_name_the_file_of_one_scene(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cvtgs.save(random_scene(20), "a.ply")
    assert main(["convert", "a.ply", "-o", "b.spz"]) == 0
    assert main(["simplify", "-o", "c.ply", "--rho", "0.5", "a.ply"]) == 0
    assert Path("b.spz").is_file()
    assert len(cvtgs.load("c.ply")) == 10
    Path("d.ply").mkdir()
    assert main(["convert", "a.ply", "-o", "d.ply"]) == 0
    assert Path("d.ply/a.ply").is_file()
