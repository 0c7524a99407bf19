"""Modules that the io layer imports, checked in a fresh interpreter."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cvtgs import save
from ply_files import gaussian_properties, gaussian_rows, write_ply_file
from scenes import random_scene

SHARED = {"formats", "files", "limits", "atomic", "axes", "streams"}
"""Modules that every ``load`` imports, whatever the format."""

FORMATS = {
    ".ply": {"ply"},
    ".compressed.ply": {"ply", "compressed_ply", "arrays"},
    ".splat": {"splat", "arrays"},
    ".spz": {"spz", "arrays"},
    ".sog": {"sog", "arrays"},
}


def printed(program: str, *arguments: Path) -> list[str]:
    """Run a program in a new interpreter; return the lines that it prints."""
    result = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    return result.stdout.splitlines()


LOADED = (
    "names = {name.split('.')[2] for name in sys.modules if name.startswith('cvtgs.io.')}\n"
    "print(*sorted(names))\n"
)


@pytest.mark.long
def test_plyfile_is_imported_only_for_unusual_files(tmp_path: Path) -> None:
    properties = gaussian_properties()
    rows = gaussian_rows(properties, 1)
    common = write_ply_file(tmp_path / "a.ply", properties, rows)
    odd = write_ply_file(tmp_path / "b.ply", properties, rows, encoding="ascii")
    program = (
        "import sys\n"
        "import cvtgs.io\n"
        "heavy = {'plyfile', 'scipy', 'kornia', 'rich', 'matplotlib'}\n"
        "for path in sys.argv[1:]:\n"
        "    print(sorted(heavy & set(sys.modules)))\n"
        "    cvtgs.io.load(path)\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    assert printed(program, common, odd) == ["[]", "[]", "['plyfile']"]


@pytest.mark.long
def test_a_scene_in_memory_imports_no_format() -> None:
    program = (
        "import sys, cvtgs\n"
        "import cvtgs.io\n"
        f"{LOADED}"
        "cvtgs.Simplifier().simplify(cvtgs.synthetic.demo_scene(200, seed=0), rho=0.1)\n"
        f"{LOADED}"
    )
    assert printed(program) == ["", "atomic tensors"]  # of the merge network


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("end", FORMATS)
def test_a_format_is_imported_when_a_file_of_it_is_read(tmp_path: Path, end: str) -> None:
    path = tmp_path / f"scene{end}"
    save(random_scene(5), path)
    (names,) = printed(f"import sys, cvtgs\ncvtgs.load(sys.argv[1])\n{LOADED}", path)
    assert set(names.split()) == SHARED | FORMATS[end]
