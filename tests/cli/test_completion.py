"""Completion of commands, options, values and files in shells."""

import io
import shutil
import subprocess

import pytest

import cvtgs
from cvtgs.cli.main import build_parser, main


def completed(script: str, *words: str) -> list[str]:
    """Return the completions that bash offers for the last word."""
    given = " ".join(f"'{word}'" for word in words)
    line = f"{script}\nCOMP_WORDS=({given}); COMP_CWORD={len(words) - 1}; _cvtgs\n"
    line += 'printf "%s\\n" "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


@pytest.fixture
def bash(capsys: pytest.CaptureFixture[str]) -> str:
    if shutil.which("bash") is None:
        pytest.skip("needs bash")
    assert main(["completion", "bash"]) == 0
    return capsys.readouterr().out


def test_scripts_have_no_line_ends_of_windows(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, newline="\r\n"))
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
    assert written.getvalue().count(b"\n") > 50
    assert b"\r" not in written.getvalue()


def test_bash_completes_commands_options_values_and_files(bash, tmp_path, monkeypatch):
    for name in ("scan.ply", "my scan.ply"):
        (tmp_path / name).write_text("")
    monkeypatch.chdir(tmp_path)
    assert completed(bash, "cvtgs", "si") == ["simplify"]
    assert completed(bash, "cvtgs", "simplify", "in.ply", "--max") == ["--max-count"]
    assert completed(bash, "cvtgs", "simplify", "--preset", "") == list(cvtgs.PRESETS)
    assert completed(bash, "cvtgs", "simplify", "--preset", "=") == list(cvtgs.PRESETS)
    assert completed(bash, "cvtgs", "simplify", "--preset", "=", "st") == ["standard"]
    assert completed(bash, "cvtgs", "levels", "--backend", "n") == ["numba"]
    assert completed(bash, "cvtgs", "completion", "f") == ["fish"]
    assert completed(bash, "cvtgs", "simplify", "sc") == ["scan.ply"]
    assert completed(bash, "cvtgs", "simplify", "--report", "sc") == ["scan.ply"]
    assert completed(bash, "cvtgs", "info", "my") == ["my scan.ply"]
    assert completed(bash, "cvtgs", "simplify", "--ckpt", "s") == ["standard", "scan.ply"]
    assert completed(bash, "cvtgs", "tradeoff", "--presets", "dr") == ["draft"]


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
    assert "__fish_seen_subcommand_from simplify' -l preset -x -a 'draft " in script
    assert "__fish_seen_subcommand_from completion' -x -a 'bash zsh fish'" in script


def test_zsh_completion_calls_compinit_if_necessary(capsys):
    assert main(["completion", "zsh"]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "(( $+functions[compdef] )) || { autoload -U compinit && compinit }"
    assert "bashcompinit" in second  # bashcompinit calls compdef
