"""Hidden files of outputs: their names."""

import os
from pathlib import Path

import pytest

from cvtgs.io.locks import hidden_path, output_lock


@pytest.mark.parametrize("letter", ["a", "\u6587"])
def test_names_near_the_limit_of_file_systems_have_a_lock(tmp_path: Path, letter: str) -> None:
    longest = 255 // len(letter.encode())
    names = [letter * longest, letter * (longest - 1) + "b"]
    hidden = {hidden_path(tmp_path / name, "lock") for name in names}
    assert len(hidden) == len(names)
    assert all(len(os.fsencode(path.name)) <= 255 for path in hidden)
    for name in names:
        with output_lock(tmp_path / name):
            assert len(list(tmp_path.iterdir())) == 1


def test_usual_names_stay_readable(tmp_path: Path) -> None:
    assert hidden_path(tmp_path / "small.ply", "lock").name == ".small.ply.lock"
