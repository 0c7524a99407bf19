"""Scripts for completion, run by the shells that are there."""

import shutil
import subprocess

import pytest

import cvtgs
from cvtgs.cli.main import build_parser, main


def completed(script: str, *words: str) -> list[str]:
    """Return what bash offers for the last of the words."""
    given = " ".join(f"'{word}'" for word in words)
    line = f"{script}\nCOMP_WORDS=({given}); COMP_CWORD={len(words) - 1}; _cvtgs\n"
    line += 'printf "%s\\n" "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


@pytest.fixture
def bash(capsys: pytest.CaptureFixture[str]) -> str:
    if shutil.which("bash") is None:
        pytest.skip("needs bash")
    assert main(["completion", "bash"]) == 0
    return capsys.readouterr().out


def test_bash_completes_commands_options_values_and_files(bash, tmp_path, monkeypatch):
    (tmp_path / "scan.ply").write_text("")
    monkeypatch.chdir(tmp_path)
    assert completed(bash, "cvtgs", "si") == ["simplify"]
    assert completed(bash, "cvtgs", "simplify", "in.ply", "--max") == ["--max-count"]
    assert completed(bash, "cvtgs", "simplify", "--preset", "") == list(cvtgs.PRESETS)
    assert completed(bash, "cvtgs", "levels", "--backend", "n") == ["numba"]
    assert completed(bash, "cvtgs", "completion", "f") == ["fish"]
    assert completed(bash, "cvtgs", "simplify", "sc") == ["scan.ply"]
    assert completed(bash, "cvtgs", "simplify", "--report", "sc") == ["scan.ply"]


def test_every_option_of_every_command_is_in_every_script(capsys):
    (group,) = (one for one in build_parser()._actions if one.nargs == "A...")
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
        script = capsys.readouterr().out
        for command, parser in group.choices.items():
            assert command in script
            for action in parser._actions:
                for name in action.option_strings[-1:]:
                    assert (f"-l {name[2:]} " if shell == "fish" else name) in script
    assert "__fish_seen_subcommand_from simplify' -l preset -x -a 'draft fast" in script
    assert "__fish_seen_subcommand_from completion' -x -a 'bash zsh fish'" in script


def test_zsh_completes_also_where_compinit_was_not_called(capsys):
    assert main(["completion", "zsh"]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "(( $+functions[compdef] )) || { autoload -U compinit && compinit }"
    assert "bashcompinit" in second  # which calls compdef
