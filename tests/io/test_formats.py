"""What every format needs: limits, descriptions, documentation."""

import re
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.options import READABLE, WRITABLE
from cvtgs.cli.paths import FILE_SUFFIXES
from cvtgs.io.formats import READABLE_SUFFIXES, WRITABLE_SUFFIXES
from cvtgs.io.limits import FORMAT_LIMITS

FORMATS_PAGE = Path(__file__).parents[2] / "docs" / "formats.md"


def test_every_format_but_ply_has_limits():
    missing = {*WRITABLE_SUFFIXES} - {".ply"} - FORMAT_LIMITS.keys()
    assert not missing, "say in FORMAT_LIMITS of io/limits.py what files of the format lose"
    assert not FORMAT_LIMITS.keys() - {*WRITABLE_SUFFIXES}


def test_help_names_every_format():
    written, read = (set(re.findall(r"[\w-]*(?:\.\w+)+", text)) for text in (WRITABLE, READABLE))
    assert written == set(WRITABLE_SUFFIXES), "name the formats in WRITABLE of cli/options.py"
    known = {*READABLE_SUFFIXES, "meta.json", "lod-meta.json"}
    assert read == known, "name the formats in READABLE of cli/options.py"
    others = [name for name in written if not name.endswith(FILE_SUFFIXES)]
    assert not others, "a folder may not have such a name: add it to _SCENES in cli/paths.py"


@pytest.mark.parametrize(
    ("function", "suffixes"),
    [
        (cvtgs.load, {*READABLE_SUFFIXES} - {".compressed.ply"}),
        (cvtgs.save, {*WRITABLE_SUFFIXES}),
    ],
    ids=["load", "save"],
)
def test_docstrings_name_every_format(function, suffixes):
    named = re.findall(r"``(\.[.\w]+)``", function.__doc__ or "")
    assert not suffixes - {*named}, f"name these formats in the docstring of {function.__name__}"


def test_the_page_of_formats_has_every_format():
    rows = [line for line in FORMATS_PAGE.read_text().splitlines() if line.startswith("| `")]
    named = re.findall(r"`([.\w-]+)`", " ".join(row.split("|")[1] for row in rows))
    missing = {*READABLE_SUFFIXES, *WRITABLE_SUFFIXES} - {*named}
    assert not missing, "add a row for these formats in docs/formats.md"
