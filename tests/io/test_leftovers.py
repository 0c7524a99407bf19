"""Leftovers of killed runs, loops of links, names on Windows, maps of replaced files."""

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path, PureWindowsPath
from typing import NoReturn

import numpy as np
import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import OutputError, OutputExistsError
from cvtgs.io import atomic, atomic_output, check_output, check_save


def write(path: Path, data: bytes = b"new", *, overwrite: bool = False) -> None:
    with atomic_output(path, overwrite=overwrite) as file:
        file.write(data)


posix = pytest.mark.skipif(os.name == "nt", reason="locks and links are those of POSIX")
HANGS = """
import sys, time
from cvtgs.io import atomic_output
with atomic_output(sys.argv[1], overwrite=True) as file:
    file.write(b"half")
    file.flush()
    print("writing", flush=True)
    time.sleep(60)
"""


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix == ".tmp")


@posix
def test_the_next_run_removes_the_files_of_killed_runs(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    command = [sys.executable, "-c", HANGS, str(path)]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(3)]
    for process in started:
        assert process.stdout is not None
        assert process.stdout.readline() == b"writing\n"
    names = [f".a.bin.{number}.tmp" for number in range(3)]
    assert leftovers(tmp_path) == names
    write(path)  # does not remove the files of running writers
    assert leftovers(tmp_path) == names
    for process in started:
        process.kill()
        process.communicate()
    assert leftovers(tmp_path) == names
    write(path, b"newer", overwrite=True)
    assert path.read_bytes() == b"newer"
    assert list(tmp_path.iterdir()) == [path]


def test_more_writers_than_names_can_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "_MOST_WRITERS", 1)
    path = tmp_path / "a.bin"
    with atomic_output(path, overwrite=True) as one, atomic_output(path, overwrite=True) as other:
        assert len(leftovers(tmp_path)) == 2
        one.write(b"1")
        other.write(b"2")
    assert path.read_bytes() == b"1"
    assert list(tmp_path.iterdir()) == [path]


@posix
def test_a_temporary_file_that_another_run_took_for_a_leftover_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may do so between the creation of the file and its lock."""
    lock, removed = vars(atomic)["_lock"], list[str]()

    def late(descriptor: int) -> bool:
        if not removed:
            removed.extend(leftovers(tmp_path))
            (tmp_path / removed[0]).unlink()
        return bool(lock(descriptor))

    monkeypatch.setattr(atomic, "_lock", late)
    write(tmp_path / "a.bin")
    assert removed == [".a.bin.0.tmp"]
    assert (tmp_path / "a.bin").read_bytes() == b"new"


@posix
def test_a_file_that_took_the_name_of_a_leftover_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other run may begin between the search for leftovers and their lock."""
    path = tmp_path / ".a.bin.0.tmp"
    path.write_bytes(b"left over")

    def replaced(descriptor: int, operation: int) -> None:
        path.unlink()
        path.write_bytes(b"of another run")

    monkeypatch.setattr("fcntl.flock", replaced)
    vars(atomic)["_remove_leftover"](path)
    assert path.read_bytes() == b"of another run"


@posix
def test_a_missing_folder_is_refused_even_if_the_path_leads_out_of_it(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="must be in an existing directory"):
        check_output(tmp_path / "missing" / ".." / "a.ply")


def test_without_locks_only_old_leftovers_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic, "fcntl", None)
    fresh, old = tmp_path / ".a.bin.0.tmp", tmp_path / ".b.bin.0.tmp"
    for path in (fresh, old):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    write(tmp_path / "a.bin")
    write(tmp_path / "b.bin")
    with pytest.raises(OutputExistsError):
        write(tmp_path / "b.bin")
    assert sorted(path.name for path in tmp_path.iterdir()) == [fresh.name, "a.bin", "b.bin"]


@posix
def test_a_loop_of_symbolic_links_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "a.ply").symlink_to(tmp_path / "b.ply")
    (tmp_path / "b.ply").symlink_to(tmp_path / "a.ply")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="found a loop of symbolic links"):
            check_save(tmp_path / "a.ply", overwrite=overwrite)


@pytest.mark.parametrize(
    ("path", "wanted"),
    [
        (r"C:\scenes\a.ply", None),
        (r"\\server\share\a b (1).ply", None),
        ("C:a.ply", None),
        ("console.ply", None),
        (r"C:\scenes\a.ply:hidden", "the characters :"),
        ("ab:c.ply", "the characters :"),
        ('a<b>"|?*.ply', 'the characters " * < > ? |'),
        ("nul", "a device"),
        (r"D:\CON.ply", "a device"),
        ("com1.tar.ply", "a device"),
        ("con .ply", "a device"),
        ("a.ply.", "a dot or space"),
        ("a.ply ", "a dot or space"),
    ],
)
def test_invalid_names_on_windows_are_recognised(path: str, wanted: str | None) -> None:
    found = atomic.windows_fault(PureWindowsPath(path))
    assert found is None if wanted is None else wanted in str(found)


def test_invalid_windows_names_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_output(tmp_path / "a.ply_b")
    monkeypatch.setattr(atomic, "_WINDOWS", True)
    with pytest.raises(OutputError, match="the characters :, which Windows does not allow"):
        check_output(tmp_path / "a.ply:b")


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pretend that files behave as on Windows: read-only ones are not replaced or removed."""
    monkeypatch.setattr(atomic, "_WINDOWS", True)
    monkeypatch.setattr(atomic, "fcntl", None)
    monkeypatch.setattr(atomic, "_WAITS", (0.0, 0.0))
    monkeypatch.setattr(os, "access", lambda path, mode: bool(Path(path).stat().st_mode & 0o200))
    for name in ("replace", "unlink"):
        monkeypatch.setattr(os, name, checked(getattr(os, name)))


def checked(change: Callable[..., None]) -> Callable[..., None]:
    def act(*paths: Path, **options: int) -> None:
        if any(path.exists() and not path.stat().st_mode & 0o200 for path in paths):
            raise PermissionError(errno.EACCES, "Access is denied", str(paths[0]))
        change(*paths, **options)

    return act


@pytest.mark.usefixtures("windows")
def test_a_read_only_file_is_refused_on_windows_before_the_work(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write(path, b"old")
    path.chmod(0o444)
    for act in (check_output, write):
        with pytest.raises(OutputError, match="must be writable, found a read-only file"):
            act(path, overwrite=True)
    assert list(tmp_path.iterdir()) == [path]
    path.chmod(0o644)
    write(path, overwrite=True)
    assert path.read_bytes() == b"new"


@pytest.mark.usefixtures("windows")
@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_file_that_a_scanner_holds_for_a_moment_is_replaced_on_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    path, left, replace = tmp_path / "a.ply", [None] * times, os.replace
    write(path, b"old")

    def busy(source: Path, target: Path) -> None:
        if left:
            left.pop()
            raise PermissionError(errno.EACCES, "Access is denied", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", busy)
    if times > 2:
        with pytest.raises(OutputError, match="must be writable, found: access is denied"):
            write(path, overwrite=True)
    else:
        write(path, overwrite=True)
    assert path.read_bytes() == (b"old" if times > 2 else b"new")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("windows")
def test_a_temporary_file_that_cannot_be_removed_is_no_error_on_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> NoReturn:
        raise PermissionError(errno.EACCES, "Access is denied", str(path))

    monkeypatch.setattr(os, "unlink", refuse)
    write(tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == b"new"


@pytest.mark.skipif(sys.platform != "linux", reason="reads the maps of Linux")
def test_an_input_is_no_longer_mapped_when_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows does not allow the replacement of a mapped file."""
    path, seen = tmp_path / "a.ply", list[str]()
    cvtgs.save(cvtgs.synthetic.scene("object", 3000, sh_degree=1, seed=0), path)
    replace = Path.replace

    def look(self: Path, target: Path) -> Path:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8")
        seen.extend(line for line in maps.splitlines() if str(target) in line)
        seen.append("looked")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", look)
    words = ["simplify", str(path), str(path), "--rho", "0.1", "--overwrite", "--quiet"]
    assert main([*words, "--preset", "draft"]) == 0
    assert seen == ["looked"]
    with path.open("rb") as file:  # checks that the test can fail
        held = np.memmap(file, np.uint8, "r")
        look(path, path)
    assert len(held) > 0
    assert len(seen) > 2


def held_once(change: Callable[..., None]) -> Callable[..., None]:
    """Refuse the first call, as while a virus scanner reads a file."""
    calls: list[int] = []

    def act(*paths: Path, **options: int) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise PermissionError(errno.EACCES, "Access is denied", str(paths[0]))
        change(*paths, **options)

    return act


@pytest.mark.parametrize("links", ["refused", "and renames"])
def test_a_new_file_waits_for_a_scanner_on_disks_without_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(atomic, "_WINDOWS", True)
    monkeypatch.setattr(atomic, "_WAITS", (0.0, 0.0))
    monkeypatch.setattr(os, "link", refuse)
    calls = os.rename, os.replace
    renames = links == "refused"
    monkeypatch.setattr(os, "rename", held_once(calls[0]) if renames else refuse)
    monkeypatch.setattr(os, "replace", refuse if renames else held_once(calls[1]))
    with atomic.atomic_output(tmp_path / "a.txt") as file:
        file.write(b"whole")
    assert (tmp_path / "a.txt").read_bytes() == b"whole"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_waits_for_a_scanner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "_WINDOWS", True)
    monkeypatch.setattr(atomic, "_WAITS", (0.0, 0.0))
    monkeypatch.setattr(os, "replace", held_once(os.replace))
    (tmp_path / "hidden").mkdir()
    atomic.replace_file(tmp_path / "hidden", tmp_path / "shown")
    assert [path.name for path in tmp_path.iterdir()] == ["shown"]
