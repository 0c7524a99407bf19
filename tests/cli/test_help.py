"""What help texts and pages list must be complete."""

from pathlib import Path

from cvtgs.cli.main import WRITE_SEVERAL, build_parser
from cvtgs.cli.options import CommandParser
from cvtgs.config import EffectsConfig

EFFECTS_PAGE = Path(__file__).parents[2] / "docs" / "effects.md"


def commands() -> dict[str, CommandParser]:
    (group,) = (action for action in build_parser()._actions if action.dest == "command")
    return dict(group.choices)


def test_help_and_page_name_every_effect():
    (option,) = (one for one in commands()["simplify"]._actions if one.dest == "effects")
    page = EFFECTS_PAGE.read_text(encoding="utf-8")
    names = [name for name in EffectsConfig.model_fields if name not in option.help]
    assert not names, "name these effects in --effects of cli/options.py"
    names = [name for name in EffectsConfig.model_fields if f"`{name}`" not in page]
    assert not names, "describe these effects in docs/effects.md"


def test_every_command_that_writes_to_a_folder_locks_it():
    found = {
        name
        for name, parser in commands().items()
        if any(one.dest == "output" and one.option_strings for one in parser._actions)
    }
    assert found == {*WRITE_SEVERAL}, "list these commands in WRITE_SEVERAL of cli/main.py"
