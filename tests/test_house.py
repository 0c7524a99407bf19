"""The house rules, read from the source: who may import what, and how files look."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "cvtgs"
FILES = sorted(SOURCE.rglob("*.py"))
TEXTS = {path: path.read_text(encoding="utf-8") for path in FILES}

# A file imports only from lower levels, or from inside its own package: the ranks of the design,
# split where one module of a rank needs another. `math` raises the errors of `errors` and takes the
# chunks of `devices`, and `report` shows the effect plan of `analysis`, so each stands above the
# modules it needs; `devices` and `cameras` (data) stand as low as their imports allow.
LEVELS = [
    {"startup", "tags", "text"},
    {"errors", "progress"},
    {"devices", "checks", "counts"},
    {"math", "clock", "plots", "boxes"},
    {"config", "scene", "cameras", "processes"},
    {"validity", "edit"},
    {"io", "synthetic", "rendering", "losses"},
    {"views"},
    {"evaluation", "analysis"},
    {"filters", "cvt", "cells", "report"},
    {"mergenet", "grouping", "matching"},
    {"pipeline", "refinement"},
    {"prepared"},
    {"simplifier", "info"},
    {"budget", "levels", "notebooks", "outofcore", "tradeoff", "viewer"},
    {"streams"},
    {"train"},
    {"cli"},
    {"__main__"},
]
RANKS = {name: rank for rank, level in enumerate(LEVELS) for name in level}

# Packages that any file may import, and the only places that may import others.
EVERYWHERE = {"torch", "numpy", "jaxtyping", "pydantic"}
OWNERS = {
    "scipy": ("cvt/nearest.py", "budget/costs.py"),
    "plyfile": "io/ply/read.py",
    "tomli_w": "config/simplify.py",
    "rich": "cli/",
    "kornia": "losses.py",
    "numba": "rendering/compiled.py",
    "gsplat": "rendering/gsplat_backend.py",
    "PIL": ("evaluation/comparison_files.py", "evaluation/images.py", "io/sog/"),
    "jinja2": "evaluation/comparison_files.py",
    "zstandard": "io/spz.py",
    "safetensors": "io/tensors.py",
    "matplotlib": "plots.py",
    "distributed": "outofcore/distributed.py",
    "filelock": "io/locks.py",
    "psutil": "outofcore/memory.py",
    "viser": "viewer/connection.py",
}
HEAVY = ("scipy", "kornia", "plyfile", "rich", "PIL", "jinja2", "matplotlib", "zstandard")
HEAVY += ("distributed",)


def relative(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def package_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def imports_in(node: ast.AST) -> Iterator[str]:
    """Yield the dotted names of all run-time imports, wherever they are in the file."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        elif not is_for_types(child):
            yield from imports_in(child)


def broken_ranks(path: Path, text: str) -> list[str]:
    own, broken = package_of(path), []
    for name in imports_in(ast.parse(text)):
        parts = name.split(".")
        if parts[0] == "cvtgs" and len(parts) > 1 and parts[1] != own:
            known = own in RANKS and parts[1] in RANKS
            if not known or RANKS[parts[1]] >= RANKS[own]:
                broken.append(f"{relative(path)} imports {name}")
    return broken


def strangers_in(path: Path, text: str) -> list[str]:
    """Return the third-party packages that a file imports but does not own."""
    packages = {name.split(".")[0] for name in imports_in(ast.parse(text))}
    foreign = packages - set(sys.stdlib_module_names) - EVERYWHERE - {"cvtgs"}
    return sorted(
        package
        for package in foreign
        if package not in OWNERS or not relative(path).startswith(OWNERS[package])
    )


def in_fresh_process(code: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    return done.stdout.split()


def test_the_rank_check_finds_violations():
    """A sideways import, an upward one, an unknown module and a downward one."""
    path = SOURCE / "cvt" / "new.py"
    text = """
from cvtgs import cells, math
from cvtgs.simplifier import Simplifier
def late():
    import cvtgs.elsewhere
from cvtgs.cvt.lloyd import lloyd
if TYPE_CHECKING:
    from cvtgs.train import anything
"""
    assert broken_ranks(path, text) == [
        "cvt/new.py imports cvtgs.cells",
        "cvt/new.py imports cvtgs.simplifier.Simplifier",
        "cvt/new.py imports cvtgs.elsewhere",
    ]


def test_imports_go_down_the_ranks():
    assert len(FILES) > 20
    broken = [
        problem
        for path, text in TEXTS.items()
        if path != SOURCE / "__init__.py"
        for problem in broken_ranks(path, text)
    ]
    assert broken == []


def test_the_front_page_imports_no_cvtgs_module():
    text = (SOURCE / "__init__.py").read_text(encoding="utf-8")
    assert not [name for name in imports_in(ast.parse(text)) if name.startswith("cvtgs")]


def test_the_owner_check_finds_violations():
    text = "import scipy.spatial\nimport attrs, torch, rich\nfrom cvtgs import math\nimport ast"
    assert strangers_in(SOURCE / "cvt" / "nearest.py", text) == ["attrs", "rich"]
    assert strangers_in(SOURCE / "cli" / "main.py", text) == ["attrs", "scipy"]


def test_packages_are_imported_only_where_they_belong():
    found = {relative(path): strangers_in(path, text) for path, text in TEXTS.items()}
    assert {name: strangers for name, strangers in found.items() if strangers} == {}


POSIX_MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
POSIX_NAMES = {
    "os.fork",
    "os.geteuid",
    "os.getuid",
    "os.killpg",
    "os.mkfifo",
    "os.sched_getaffinity",
}
POSIX_NAMES |= {"signal.SIGALRM", "signal.SIGKILL", "signal.SIGPROF", "signal.setitimer"}


def run_at_import(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what runs on import: not the bodies of functions, but their decorators and defaults.

    Code under an ``if`` or a ``try`` is skipped, since it may be for some systems only.
    """
    for child in ast.iter_child_nodes(node):
        yield child
        if isinstance(child, ast.FunctionDef):
            for part in (*child.decorator_list, *child.args.defaults):
                yield part
                yield from run_at_import(part)
        elif not isinstance(child, ast.Lambda | ast.If | ast.Try):
            yield from run_at_import(child)


def missing_on_windows(text: str) -> list[str]:
    found = []
    for node in run_at_import(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name in POSIX_MODULES]
        elif isinstance(node, ast.Attribute) and ast.unparse(node) in POSIX_NAMES:
            found.append(ast.unparse(node))
    return found


def test_every_file_can_be_imported_on_windows():
    """Test files too: one that cannot be imported stops the collection of all tests."""
    text = """
import os, resource
@mark.parametrize("sign", [signal.SIGKILL])
def test(sign, kill=os.fork):
    import fcntl
    signal.setitimer(0)
"""
    assert missing_on_windows(text) == ["resource", "signal.SIGKILL", "os.fork"]
    paths = [*FILES, *sorted((ROOT / "tests").rglob("*.py"))]
    found = {path: missing_on_windows(path.read_text(encoding="utf-8")) for path in paths}
    assert {path.relative_to(ROOT): names for path, names in found.items() if names} == {}


def test_files_are_short():
    paths = [*FILES, *sorted((ROOT / "tests").rglob("*.py"))]
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in paths}
    assert {path.relative_to(ROOT): count for path, count in lines.items() if count > 400} == {}


def test_no_print_outside_cli_and_no_assert():
    found = [
        f"{relative(path)}:{node.lineno}: {ast.unparse(node)}"
        for path, text in TEXTS.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assert)
        or (
            package_of(path) != "cli"
            and isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("print", "input")
        )
    ]
    assert found == []


def test_warnings_are_issued_in_one_way():
    found = [relative(path) for path in FILES if "warnings.warn(" in TEXTS[path]]
    assert found == ["errors.py"]  # its warn() finds the line of the caller


def test_private_names_stay_in_their_file():
    found = [
        f"{relative(path)} imports {name}"
        for path, text in TEXTS.items()
        for name in imports_in(ast.parse(text))
        if any(re.match(r"_(?!_)", part) for part in name.split(".")) and name.startswith("cvtgs")
    ]
    assert found == []


def test_no_two_classes_share_a_name():
    classes: dict[str, list[str]] = {}
    for path, text in TEXTS.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, []).append(relative(path))
    assert {name: paths for name, paths in classes.items() if len(paths) > 1} == {}


def test_no_file_has_a_vague_name():
    vague = {"utils", "util", "helpers", "common", "misc"}
    assert not [path for path in FILES if vague & set(path.with_suffix("").parts)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "statement",
    ["import cvtgs", "import cvtgs.simplifier", "import cvtgs; cvtgs.Simplifier; cvtgs.load"],
)
def test_imports_are_light(statement):
    heavy = f"print(*sorted({set(HEAVY)!r} & set(sys.modules)))"
    assert in_fresh_process(f"import sys; {statement}; {heavy}") == []


def test_the_front_page_does_not_load_torch():
    assert in_fresh_process("import sys, cvtgs; print('torch' in sys.modules)") == ["False"]


def test_the_package_is_marked_as_typed():
    assert (SOURCE / "py.typed").is_file()


def test_fractions_in_the_docs_have_braces():
    r"""The converter to MathML reads ``\frac12`` as a fraction of 12 and what follows."""
    pages = sorted((ROOT / "docs").rglob("*.md"))
    assert any(r"\frac{" in page.read_text(encoding="utf-8") for page in pages)
    wrong = [page.name for page in pages if re.search(r"frac\d", page.read_text(encoding="utf-8"))]
    assert wrong == []
