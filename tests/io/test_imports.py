"""What importing the io layer loads, proved in a fresh interpreter."""

import os
import subprocess
import sys
from pathlib import Path

from ply_files import gaussian_properties, gaussian_rows, write_ply_file


def test_plyfile_is_loaded_only_for_odd_files(tmp_path: Path) -> None:
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
    result = subprocess.run(
        [sys.executable, "-c", program, str(common), str(odd)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert result.stdout.splitlines() == ["[]", "[]", "['plyfile']"]
