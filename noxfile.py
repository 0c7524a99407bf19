"""Checks, each in an environment of its own: ``nox`` runs the default ones."""

import re
import shutil
import subprocess
from pathlib import Path

import nox

nox.options.sessions = ["lint", "tests", "readme"]
nox.options.error_on_missing_interpreters = True
CONSTRAINTS = ("-c", str(Path("constraints.txt").resolve()))
PARALLEL = ("-n", "auto", "--dist", "worksteal")
WHEEL_TESTS = (
    "tests/test_public_names.py",
    "tests/test_typing.py",
    "tests/test_examples.py",
    "tests/cli/test_*.py",
    "tests/io/test_*.py",
    "tests/simplify/test_*.py",
    "tests/mergenet/test_*.py",
    "tests/evaluation/test_compare.py",
)
"""What tells whether anything is missing in the wheel: data files, names, types, commands."""
VIEWERS = (
    "playcanvas@2.23.3",
    "cesium@1.140.0",
    "@sparkjsdev/spark@2.2.0",
    "@mkkellogg/gaussian-splats-3d@0.4.7",
    "three@0.187.0",
)


@nox.session
def lint(session: nox.Session) -> None:
    """Style and types."""
    session.install(*CONSTRAINTS, ".[lint]")
    session.run("ruff", "check")
    session.run("ruff", "format", "--check")
    others = []  # modules and functions that a system lacks; meanwhile, since each takes a minute
    for platform in ("win32", "darwin"):
        own = ("--platform", platform, "--cache-dir", f".mypy_cache/{platform}", "-p", "cvtgs")
        others.append(subprocess.Popen([Path(session.bin) / "mypy", *own]))
    session.run("mypy")
    if any(check.wait() for check in others):
        session.error("mypy found errors for Windows or macOS.")


@nox.session
def tests(session: nox.Session) -> None:
    """All tests except the longest, one process per core."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", *PARALLEL, "-m", "not long", *session.posargs)


@nox.session(python="3.11", venv_backend="uv")
def oldest(session: nox.Session) -> None:
    """Quick tests with the oldest versions that pyproject.toml allows; needs uv and Python 3.11.

    ``UV_TORCH_BACKEND=cpu`` spares the 3 GB of CUDA, where PyTorch's own index can be reached.
    """
    session.install("--resolution", "lowest-direct", "-e", ".[test]")
    session.run(
        "pytest", *PARALLEL, "-m", "not slow and not long", "-W", "default", *session.posargs
    )


@nox.session(venv_backend="uv")
def newest(session: nox.Session) -> None:
    """Quick tests with the newest versions of all dependencies; needs uv.

    ``nox -s newest --force-python 3.14`` uses another Python; for ``UV_TORCH_BACKEND`` see above.
    """
    session.install("-e", ".[test]")
    session.run(
        "pytest", *PARALLEL, "-m", "not slow and not long", "-W", "default", *session.posargs
    )


@nox.session
def coverage(session: nox.Session) -> None:
    """All tests with line and branch coverage, at least 95 %."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", *PARALLEL, "--cov=cvtgs", *session.posargs)


@nox.session
def long(session: nox.Session) -> None:
    """The longest tests: kills, full disks, clusters, memory, whole trainings and evaluations."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", *PARALLEL, "-m", "long", *session.posargs)


@nox.session(reuse_venv=True)
def quick(session: nox.Session) -> None:
    """All tests except the slow ones."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", *PARALLEL, "-m", "not slow and not long", *session.posargs)


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
def docs(session: nox.Session) -> None:
    """Build the documentation; warnings are errors, and nothing is fetched while it builds."""
    session.install(*CONSTRAINTS, ".[docs]")
    words = session.posargs or ["docs/_build/html"]
    settings = {"OMP_WAIT_POLICY": "PASSIVE", "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
    for drawing in ("cells", "reference", "inflation"):
        image = Path(session.create_tmp()) / f"{drawing}.png"
        session.run("python", "-m", f"docs.drawings.{drawing}", str(image), env=settings)
    session.run("sphinx-build", "-n", "-W", "--keep-going", "-E", "docs", *words, env=settings)


@nox.session
def wheel(session: nox.Session) -> None:
    """Build sdist and wheel, and test what the wheel installs, in a folder without src.

    Give ``tests`` to run all of them.
    """
    session.install(*CONSTRAINTS, "hatchling")
    folder = Path(session.create_tmp()).resolve()
    shutil.rmtree(folder / "dist", ignore_errors=True)
    session.run("hatchling", "build", "-t", "sdist", "-d", str(folder / "dist"))
    (sdist,) = (folder / "dist").glob("*.tar.gz")
    shutil.unpack_archive(sdist, folder / "dist", filter="data")
    clone = folder / "dist" / sdist.name.removesuffix(".tar.gz")
    with session.chdir(clone):
        session.run("hatchling", "build", "-t", "wheel", "-d", str(folder / "dist"))
    (built,) = (folder / "dist").glob("*.whl")
    session.install(*CONSTRAINTS, "--force-reinstall", "--no-deps", str(built))
    session.install(*CONSTRAINTS, f"cvtgs[test] @ {built.as_uri()}")
    shutil.rmtree(clone / "src")
    with session.chdir(clone):
        session.run("cvtgs", "doctor", "--device", "cpu")
        patterns = session.posargs or WHEEL_TESTS
        words = [str(path) for pattern in patterns for path in sorted(Path().glob(pattern))]
        session.run("pytest", *PARALLEL, *words, "--ignore=tests/test_house.py")


@nox.session
def speed(session: nox.Session) -> None:
    """Time and memory of whole runs; takes minutes, wants a quiet machine."""
    session.install(*CONSTRAINTS, ".")
    session.run("python", "-m", "benchmarks.speed", *session.posargs)


@nox.session
def viewers(session: nox.Session) -> None:
    """Show scenes in viser and in five viewers from npm, in headless Chromium."""
    session.install(*CONSTRAINTS, "-e", ".[test,view]")
    folder = session.create_tmp()
    session.run("npm", "install", "--prefix", folder, *VIEWERS, "--ignore-scripts", external=True)
    settings = {"CVTGS_NODE_MODULES": str(Path(folder).resolve() / "node_modules")}
    files = ("io/test_file_viewers.py", "streams/test_stream_viewers.py", "test_viewer_browser.py")
    words = [f"tests/{file}" for file in files]
    session.run("pytest", *words, *session.posargs, env=settings)


@nox.session
def gpu(session: nox.Session) -> None:
    """Test and measure on a CUDA device, with torch and gsplat of PyPI; writes docs/gpu.md."""
    session.install("-e", ".[test,gsplat]")
    session.run("cvtgs", "doctor", "--device", "cuda")
    session.run("pytest", "-m", "cuda")
    session.run("python", "-m", "benchmarks.gpu", *session.posargs)


@nox.session
def fuzz(session: nox.Session) -> None:
    """Read damaged scenes, checkpoints, cameras and configurations; needs Linux, takes hours.

    Each of 21 kinds gets 100,000 inputs; ``-- --count 21000`` is a quick look.
    """
    session.install(*CONSTRAINTS, "-e", ".[test]")
    words = session.posargs or ["--count", "2100000"]
    session.run("python", "tests/fuzz_files.py", *words, env={"OMP_NUM_THREADS": "1"})


@nox.session
def faults(session: nox.Session) -> None:
    """Kill commands, run two at once, fill the disk, take memory away; needs Linux, takes hours.

    ``-- --seconds 600`` ends after ten minutes, ``-- --commands plain train`` takes only these.
    """
    session.install(*CONSTRAINTS, "-e", ".[test]")
    settings = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    session.run("python", "tests/faults.py", *session.posargs, env=settings)


@nox.session
def sbom(session: nox.Session) -> None:
    """Write a list of all packages that this version is tested with, in CycloneDX."""
    session.install(*CONSTRAINTS, ".")
    python = str(Path(session.bin) / "python")
    tool = Path(session.create_tmp()) / "tool"
    session.run("python", "-m", "venv", str(tool))
    session.run(str(tool / "bin" / "pip"), "install", "cyclonedx-bom>=7", external=True)
    words = ["environment", "--pyproject", "pyproject.toml", "--output-reproducible"]
    words += ["-o", *(session.posargs or ["sbom.json"]), python]
    session.run(str(tool / "bin" / "cyclonedx-py"), *words, external=True)


@nox.session
def browser(session: nox.Session) -> None:
    """Load the comparison page in a real headless browser (Debian package chromium)."""
    session.install(*CONSTRAINTS, "-e", ".[test]")
    session.run("pytest", "tests/evaluation/test_page_browser.py", *session.posargs)
