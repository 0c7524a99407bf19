"""Commands that write several files: one run at a time, and no lock is left."""

import os

import pytest

import cvtgs
from cvtgs.cli.main import WRITE_SEVERAL, build_parser, main
from cvtgs.errors import OutputBusyError
from cvtgs.io.locks import folder_lock, lock_path

COMMANDS = {
    "levels": "levels {}/in.ply -o {}/out --rho 0.1 --no-scores --quiet",
    "stream": "levels {}/in.ply -o {}/out --rho 0.5,0.1 --stream sog --quiet",
    "render": "render {}/in.ply -o {}/out --views 1 --size 16 --quiet",
    "compare": "compare {}/in.ply {}/in.ply -o {}/out --quiet",
    "tradeoff": "tradeoff {}/in.ply -o {}/out --presets draft --quiet",
    "train": "train {}/tiny.toml -o {}/out.safetensors --quiet",
}


@pytest.fixture
def scene(tmp_path):
    cvtgs.save(cvtgs.synthetic.scene("object", 300, sh_degree=0), tmp_path / "in.ply")
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_run_is_refused_before_it_writes(scene, capsys, name):
    words = COMMANDS[name].replace("{}", str(scene)).split()
    output = scene / ("out.safetensors" if name == "train" else "out")
    with folder_lock(output):
        assert main(words) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"cvtgs: error: {output}: one run at a time may work on it, found ")
    assert error.count("\n") == 1
    assert sorted(path.name for path in scene.iterdir()) == ["in.ply"]


@pytest.mark.parametrize("name", ["levels", "stream", "render"])
def test_no_lock_is_left(scene, name):
    assert main(COMMANDS[name].replace("{}", str(scene)).split()) == 0
    assert sorted(path.name for path in scene.iterdir()) == ["in.ply", "out"]
    assert not list((scene / "out").rglob(".*"))


def test_every_command_with_a_lock_has_an_output():
    for command in WRITE_SEVERAL:
        assert "-o" in build_parser()._subparsers._group_actions[0].choices[command].format_help()


def test_a_folder_in_one_that_cannot_be_written_is_locked_inside(tmp_path, monkeypatch):
    home = tmp_path / "home"
    (home / "out").mkdir(parents=True)
    allowed = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: str(path) != str(home) and allowed(path, mode)
    )
    with folder_lock(home / "out"):
        assert [path.name for path in (home / "out").iterdir()] == [".lock"]
        with pytest.raises(OutputBusyError), folder_lock(home / "out"):
            pass
    assert list((home / "out").iterdir()) == []


def test_where_nothing_can_be_written_the_command_says_so(tmp_path):
    with folder_lock(tmp_path / "missing" / "out"):
        assert list(tmp_path.iterdir()) == []
    assert lock_path(tmp_path / "out") == tmp_path / ".out.lock"
