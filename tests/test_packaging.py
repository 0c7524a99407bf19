"""The files for other build and test programs agree with pyproject.toml."""

import re
import tomllib
from pathlib import Path
from typing import Any

import cvtgs
from cvtgs.errors import how_to_install

ROOT = Path(__file__).parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
"""Packages that have another name on conda-forge."""


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def spaced(requirement: str) -> str:
    """Return a requirement as conda writes it."""
    name, version = re.fullmatch(r"([\w-]+)(>=.*)", requirement).groups()
    return f"{CONDA_NAMES.get(name, name)} {version}"


def test_all_files_state_the_same_version():
    assert PROJECT["version"] == cvtgs.__version__
    assert f"\nversion: {cvtgs.__version__}\n" in read("CITATION.cff")


def test_the_workflow_checks_every_supported_python_as_ci_does():
    workflow = read(".github/workflows/checks.yml")
    matrix = re.search(r"python: \[(.*)\]", workflow)[1]
    classifiers = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert re.findall(r"3\.\d+", matrix) == classifiers
    assert f">={classifiers[0]}" == PROJECT["requires-python"]
    assert "      - run: .ci/run\n" in workflow
    sessions = re.findall(r"nox -s (\w+)", workflow)
    assert sessions == ["quick", "oldest", "coverage", "docs", "wheel"]
    assert [name for name in sessions if f"\ndef {name}(" not in read("noxfile.py")] == []


def test_the_conda_recipe_has_the_dependencies_of_the_package():
    needs = re.search(r"  run:\n(.*?)  run_constrained:\n", read("conda/meta.yaml"), re.DOTALL)[1]
    listed = re.findall(r"    - (.*)\n", needs)
    assert listed[0] == f"python {PROJECT['requires-python']}"
    needed = [spaced(need.split(";")[0]) for need in PROJECT["dependencies"]]
    assert sorted(listed[1:]) == sorted(needed)


def test_the_docker_context_holds_the_copied_files():
    files = re.findall(r"^COPY (.*) \S+$", read("Dockerfile"), re.MULTILINE)
    copied = [name for line in files for name in line.split()]
    assert sorted(copied) == sorted(re.findall(r"^!(\S+)$", read(".dockerignore"), re.MULTILINE))
    assert [name for name in copied if not (ROOT / name).exists()] == []
    extras = re.search(r'"\.\[(.*)\]"', read("Dockerfile"))[1].split(",")
    assert set(extras) <= set(PROJECT["optional-dependencies"])


def test_messages_and_pages_say_in_the_same_words_how_to_install_an_extra():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    told = [line for page in pages for line in re.findall(r"`(.*pip .*\[.*?)`", page.read_text())]
    assert [text for text in told if not re.search(r'python -m pip install "cvtgs\[', text)] == []
    sources = "".join(path.read_text() for path in Path(cvtgs.__file__).parent.rglob("*.py"))
    extras = re.findall(r"how_to_install\('cvtgs\[(\w+)\]'", sources)
    assert set(extras) == {"dask", "gsplat", "lpips", "plots", "view"}
    assert set(extras) <= set(PROJECT["optional-dependencies"])
    assert how_to_install("cvtgs[view]", "torch==2") == (
        'install it with python -m pip install "cvtgs[view]" torch==2'
    )


def test_actions_are_pinned_by_their_commits():
    uses = re.findall(r"uses: (.*)", read(".github/workflows/checks.yml"))
    pinned = r"[\w-]+/[\w-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+"
    assert uses
    assert [line for line in uses if not re.fullmatch(pinned, line)] == []
    assert len(set(uses)) == len({line.split("@")[0] for line in uses})  # one version of each
