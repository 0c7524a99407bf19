"""``cvtgs completion``: a script that lets a shell complete commands, options and their values."""

import argparse
import io
import sys
from collections.abc import Iterator, Mapping
from functools import partial

import cvtgs
from cvtgs.cli.display import say
from cvtgs.cli.options import AddParser

SHELLS = ("bash", "zsh", "fish")

_ZSH = """(( $+functions[compdef] )) || { autoload -U compinit && compinit }
autoload -U +X bashcompinit && bashcompinit
"""


def add_completion(add_parser: AddParser, commands: Mapping[str, argparse.ArgumentParser]) -> None:
    """Add the command and its options; ``commands`` are the parsers of all commands by name."""
    parser = add_parser(
        "completion",
        help="print a script for completion in a shell",
        description="Print a script that completes commands, options and their values. For bash: "
        'eval "$(cvtgs completion bash)" in ~/.bashrc; for zsh: the same with zsh in ~/.zshrc; for '
        "fish: cvtgs completion fish > ~/.config/fish/completions/cvtgs.fish.",
    )
    parser.set_defaults(run=partial(completion, commands))
    parser.add_argument("shell", choices=SHELLS, help="the shell: bash, zsh or fish")


def completion(
    commands: Mapping[str, argparse.ArgumentParser], options: argparse.Namespace
) -> None:
    """Run ``cvtgs completion``."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(newline="\n")  # no shell takes the line ends of Windows
    if options.shell == "fish":
        say("\n".join(fish_lines(commands)))
    else:
        say((_ZSH if options.shell == "zsh" else "") + bash_script(commands), end="")


def values_of(action: argparse.Action) -> list[str]:
    """Return the words to suggest as values of an option; an empty list if there are none."""
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    return {
        "preset": list(cvtgs.PRESETS),
        "presets": list(cvtgs.PRESETS),
        "ckpt": ["auto", *cvtgs.mergenet.SHIPPED, "none"],
        "device": ["auto", "cpu", "cuda"],
        "background": ["black", "gray", "white"],
    }.get(action.dest, [])


def bash_script(commands: Mapping[str, argparse.ArgumentParser]) -> str:
    """Return the script for bash."""
    from importlib.resources import files

    values, options = [], []
    for command, parser in commands.items():
        names = list[str]()
        for action in parser._actions:
            names += action.option_strings
            if words := " ".join(values_of(action)):
                cases = [f'"{command} {name}"' for name in action.option_strings or [command]]
                values.append(f'        {"|".join(cases)}) words="{words}" ;;')
        options.append(f'            {command}) words="{" ".join(names)}" ;;')
    script = (files("cvtgs.cli") / "completion.bash").read_text(encoding="utf-8")
    script = script.replace("@commands@", " ".join(commands))
    return script.replace("@values@", "\n".join(values)).replace("@options@", "\n".join(options))


def fish_lines(commands: Mapping[str, argparse.ArgumentParser]) -> Iterator[str]:
    """Return the script for fish, line by line."""
    for command, parser in commands.items():
        about = (parser.description or "").split(". ")[0]
        yield f"complete -c cvtgs -n __fish_use_subcommand -x -a {command} -d {_quoted(about)}"
        for action in parser._actions:
            names = [name for name in action.option_strings if name.startswith("--")]
            words = " ".join(values_of(action))
            line = f"complete -c cvtgs -n '__fish_seen_subcommand_from {command}'"
            alone = "-r" if action.dest == "ckpt" else "-x"  # -r also completes files
            takes = f" {alone} -a {_quoted(words)}" if words else " -r" * (action.nargs != 0)
            if names:
                about = (action.help or "").replace("%%", "%").split(";")[0]
                yield f"{line} -l {names[0][2:]}{takes} -d {_quoted(about)}"
            elif words:
                yield f"{line}{takes}"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
