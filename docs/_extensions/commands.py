"""The directive ``commands``: a section for every command of an argparse program, from its code."""

import argparse
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Commands(SphinxDirective):
    """``.. commands:: module:function``, where the function gives the parser."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Make the sections."""
        module, _, function = self.arguments[0].partition(":")
        parser = getattr(import_module(module), function)()
        groups = [action for action in parser._actions if action.nargs == argparse.PARSER]
        sections = [self.section(parser, f"{parser.prog}: all commands")]
        for name, command in groups[0].choices.items():
            sections.append(self.section(command, name))
        return sections

    def section(self, parser: argparse.ArgumentParser, title: str) -> nodes.section:
        """Make the section of one command."""
        section = nodes.section(ids=[nodes.make_id(parser.prog)], names=[title])
        section += nodes.title(title, title)
        source = StringList(list(lines_of(parser)), source=parser.prog)
        self.state.nested_parse(source, self.content_offset, section)
        return section


def lines_of(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Return the description, the usage, and what every argument means."""
    parser.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=88)
    yield from (escaped(parser.description or ""), "", ".. code-block:: text", "")
    yield from (f"   {line}" for line in parser.format_usage().removeprefix("usage: ").splitlines())
    yield from ("", f".. program:: {parser.prog}", "")
    for action in parser._actions:
        if action.nargs == argparse.PARSER:
            for choice in getattr(action, "_choices_actions"):  # noqa: B009 (typeshed lacks it)
                yield from (f"| ``{choice.dest}``: {escaped(choice.help or '')}",)
            yield ""
        elif action.help != argparse.SUPPRESS:
            yield from (
                f".. option:: {signature(action)}",
                "",
                f"   {escaped(action.help or '')}",
                "",
            )


def signature(action: argparse.Action) -> str:
    """Return an argument as it is typed: every spelling, and the word for its value."""
    if not action.option_strings:
        return str(action.metavar or action.dest)
    word = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
    if action.choices and not action.metavar:
        word = f" {{{','.join(map(str, action.choices))}}}"
    return ", ".join(f"{name}{word}" for name in action.option_strings)


def escaped(text: str) -> str:
    """Keep stars, bars and dashes as they are, and give percent signs as they are shown."""
    for mark in "\\*`|_":
        text = text.replace(mark, f"\\{mark}")
    return " ".join(text.replace("%%", "%").replace("--", "\\-\\-").split())


def setup(app: Sphinx) -> dict[str, Any]:
    """Offer the directive."""
    app.add_directive("commands", Commands)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
