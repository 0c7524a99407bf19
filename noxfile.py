"""Checks, each in an environment of its own: ``nox`` runs the default ones."""

import re
import shutil
import subprocess
from pathlib import Path

import nox

nox.options.sessions = ["lint", "tests", "readme"]
nox.options.error_on_missing_interpreters = True
CONSTRAINTS = ("-c", "constraints.txt")


@nox.session
def lint(session: nox.Session) -> None:
    """Style and types."""
    session.install(*CONSTRAINTS, ".[lint]")
    session.run("ruff", "check")
    session.run("ruff", "format", "--check")
    session.run("mypy")


@nox.session
def tests(session: nox.Session) -> None:
    """Unit, property and documentation tests, with coverage."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("coverage", "run", "-m", "pytest", *session.posargs)
    session.run("coverage", "combine")
    session.run("coverage", "report")


@nox.session
def readme(session: nox.Session) -> None:
    """Run the commands of the README as a newcomer would: a clean copy, a fresh environment."""
    folder = Path(session.create_tmp()) / "clone"
    shutil.rmtree(folder, ignore_errors=True)
    files = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], check=True, capture_output=True
    ).stdout.decode()
    for name in filter(None, files.split("\0")):
        if Path(name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(name, folder / name)
    commands = re.findall(r"^\$ (.*)$", Path("README.md").read_text(encoding="utf-8"), re.MULTILINE)
    if not any("cvtgs demo" in command for command in commands):
        session.error("README.md shows no command that runs the demo.")
    with session.chdir(folder):
        for command in commands:
            if "nox" not in command:
                session.run("bash", "-euc", command, external=True)


@nox.session
def speed(session: nox.Session) -> None:
    """Time and memory of whole runs; takes minutes, wants a quiet machine."""
    session.install(*CONSTRAINTS, ".")
    session.run("python", "-m", "benchmarks.speed", *session.posargs)


@nox.session
def fuzz(session: nox.Session) -> None:
    """Read damaged scenes, checkpoints and configurations; takes minutes, needs Linux."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    words = session.posargs or ["--count", "100000"]
    session.run("python", "tests/fuzz_files.py", *words, env={"OMP_NUM_THREADS": "1"})


@nox.session
def browser(session: nox.Session) -> None:
    """Load the comparison page in a real headless browser (Debian package chromium)."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", "tests/test_page_browser.py", *session.posargs)
