"""The table of CONTRIBUTING.md names files and functions that exist."""

import re
from pathlib import Path
from pkgutil import resolve_name

from cvtgs import SimplifyConfig

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "cvtgs"
TEXTS = [path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")]
NOT_CODE = {"kind", "loss", "recipes", "standard", "add_NAME", ".json", "--time-budget"}


def names_in_table() -> list[str]:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.split("## Where to change a step")[1].split("\n\n")[1]
    assert table.startswith("| step | rule |")
    return sorted({*re.findall(r"`([^`]+)`", table)} - NOT_CODE)


def exists(name: str) -> bool:
    """Return whether a name is a file, a setting, in a module, or defined in some file."""
    if (SOURCE / name).exists() or (ROOT / name).exists():
        return True
    if "." in name and name[0].islower():
        section, _, key = name.partition(".")
        if hasattr(getattr(SimplifyConfig(), section, None), key):
            return True
        return is_in_module(f"cvtgs.{name}") or is_in_module(f"cvtgs.outofcore.{name}")
    patterns = [rf"^ *((def|class) )?{part}\b *(\(|:|=|\[)" for part in name.split(".")]
    return any(all(re.search(one, text, re.MULTILINE) for one in patterns) for text in TEXTS)


def is_in_module(name: str) -> bool:
    try:
        resolve_name(name)
    except (ImportError, AttributeError, ValueError):
        return False
    return True


def test_the_table_of_steps_names_what_exists():
    missing = [name for name in names_in_table() if not exists(name)]
    assert not missing, "correct these names in the table of CONTRIBUTING.md"
