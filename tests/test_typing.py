"""The public types seen from outside: a program that embeds cvtgs passes mypy in strict mode."""

import subprocess
import sys
from pathlib import Path

import pytest

import typed_embedding

PROGRAM = Path(typed_embedding.__file__)


def check(path: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run mypy like another project would: strict, and without our configuration."""
    pytest.importorskip("mypy")
    words = ["--strict", "--config-file=", f"--cache-dir={folder / 'cache'}", str(path)]
    return subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("typing")


@pytest.mark.long
def test_an_embedding_program_passes_mypy(folder: Path) -> None:
    done = check(PROGRAM, folder)
    assert done.returncode == 0, done.stdout


@pytest.mark.long
def test_wrong_calls_are_found(folder: Path) -> None:
    """The check can fail: each mistake gives an error."""
    program = folder / "wrong.py"
    program.write_text(
        "import cvtgs\nfrom cvtgs.boxes import Box\n"
        "scene = cvtgs.load(3)\n"
        "cvtgs.Simplifier(device=None).simplify(scene, rho='much')\n"
        "Box(min=(0, 0, 0), max=(1, 1, 1), low=3)\n"
        "cvtgs.SimplifyConfig(sed=3)\n"
    )
    done = check(program, folder)
    assert done.stdout.count("[arg-type]") == 3, done.stdout
    assert done.stdout.count("[call-arg]") == 2, done.stdout


@pytest.mark.slow
def test_the_program_runs(tmp_path: Path) -> None:
    assert typed_embedding.main(tmp_path) > 30
