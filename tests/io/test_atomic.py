"""Files appear complete or not at all, and an old one is replaced only on request."""

import errno
import os
import pickle
import re
import stat
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from cvtgs.errors import FileFormatError, InputNotFoundError, OutputError, OutputExistsError
from cvtgs.io import atomic, atomic_output, check_output, check_save, load
from format_cases import WRITABLE


def write(path: Path, data: bytes = b"new", *, overwrite: bool = False) -> None:
    with atomic_output(path, overwrite=overwrite) as file:
        file.write(data)


def write_while_another_does(path: Path) -> None:
    with atomic_output(path) as file:
        file.write(b"mine")
        path.write_bytes(b"theirs")


def write_half(path: Path, error: type[BaseException]) -> None:
    with atomic_output(path, overwrite=True) as file:
        file.write(b"half")
        raise error("stop")


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_new_file_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with atomic_output(path) as file:
        file.write(b"new")
        assert not path.exists()
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_old_file_is_kept_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with atomic_output(path, overwrite=True) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="permissions are those of POSIX")
def test_a_replaced_file_keeps_its_permissions(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_bytes(b"old")
    old.chmod(0o640)
    before = os.umask(0o027)
    try:
        write(old, overwrite=True)
        write(new)
    finally:
        os.umask(before)
    assert (mode_of(old), mode_of(new)) == (0o640, 0o640)
    old.chmod(0o604)
    write(old, overwrite=True)
    assert mode_of(old) == 0o604


def test_symbolic_links_are_followed_and_kept(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    target, link = tmp_path / "real" / "a.bin", tmp_path / "link.bin"
    link.symlink_to(target)
    write(link, b"one")
    write(link, b"two", overwrite=True)
    assert link.is_symlink()
    assert target.read_bytes() == b"two"
    assert list((tmp_path / "real").iterdir()) == [target]


def test_links_to_folders_that_do_not_exist_are_followed(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "link.bin").symlink_to("file")
    atomic.check_outputs(tmp_path / "link" / "inner", ["a.bin"])
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "inner").is_dir()
    for name in ("file", "link.bin"):
        with pytest.raises(OutputError, match=f"{name}: must be a folder or a new path"):
            atomic.check_outputs(tmp_path / name, ["a.bin"])


def refuse(*args: object) -> NoReturn:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.fixture(params=["rename", "claim"])
def last_resort(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fallbacks without hard links: a rename that never replaces, or not even that."""
    if request.param == "claim":
        monkeypatch.setattr(atomic, "_rename", refuse)


@pytest.mark.usefixtures("last_resort")
@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK])
def test_without_hard_links_the_result_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def fail(*args: object, **options: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", fail)
    path = tmp_path / "a.bin"
    write(path)
    assert path.read_bytes() == b"new"
    with pytest.raises(OutputExistsError):
        write_while_another_does(tmp_path / "b.bin")
    assert (tmp_path / "b.bin").read_bytes() == b"theirs"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bin", "b.bin"]


def test_a_failed_rename_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.setattr(atomic, "_rename", refuse)
    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(OutputError):
        write(tmp_path / "c.bin")
    assert list(tmp_path.iterdir()) == []


def test_a_too_long_file_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="file name too long"):
        check_output(tmp_path / ("n" * 300))


@pytest.mark.skipif(sys.platform != "linux", reason="the rename of Linux")
def test_without_hard_links_no_empty_file_is_created(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.setattr(atomic, "_claim", refuse)
    write(tmp_path / "a.bin")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"new"]


@pytest.mark.parametrize("error", [OSError(errno.EIO, "bad"), KeyboardInterrupt()])
@pytest.mark.parametrize("theirs", [None, b"theirs"])
def test_the_empty_file_is_removed_after_a_failure(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    theirs: bytes | None,
) -> None:
    """Unless another process has replaced it with its own file."""
    path = tmp_path / "a.bin"

    def fail(self: Path, target: Path) -> NoReturn:
        assert path.read_bytes() == b""
        if theirs is not None:
            path.unlink()
            path.write_bytes(theirs)
        raise error

    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.setattr(atomic, "_rename", refuse)
    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        write(path)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([theirs] if theirs else [])


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, OutputError])
@pytest.mark.parametrize("old", [None, b"old"])
def test_an_error_in_the_body_leaves_no_new_file(
    tmp_path: Path, error: type[BaseException], old: bytes | None
) -> None:
    path = tmp_path / "a.bin"
    if old:
        path.write_bytes(old)
    with pytest.raises(error):
        write_half(path, error)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([old] if old else [])


def test_a_file_created_during_the_write_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with pytest.raises(OutputExistsError) as caught:
        write_while_another_does(path)
    assert str(caught.value) == (
        f"{path}: the output must not exist yet, found a file; pass overwrite=True (--overwrite) "
        f"to replace it."
    )
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"theirs"]


def test_errors_about_other_files_are_not_changed(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught, atomic_output(tmp_path / "a.bin"):
        (tmp_path / "elsewhere" / "b.bin").open()
    assert type(caught.value) is FileNotFoundError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (errno.ENOSPC, "must be writable, found: no space left on device."),
        (errno.EIO, "must be writable, found: input/output error."),
    ],
)
def test_disk_errors_keep_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, text: str
) -> None:
    def fail(descriptor: int) -> NoReturn:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(OutputError) as caught:
        write(path, overwrite=True)
    assert str(caught.value) == f"{path}: the output {text}"
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


@pytest.mark.skipif(sys.platform != "linux", reason="limits the file size as Linux does")
def test_a_write_beyond_the_file_size_limit_is_an_output_error(tmp_path: Path) -> None:
    program = (
        "import resource, sys\n"
        "from cvtgs.errors import OutputError\n"
        "from cvtgs.io.atomic import atomic_output\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    with atomic_output(sys.argv[1]) as file:\n"
        "        for _ in range(9): file.write(bytes(50_000))\n"
        "except OutputError as error: print(error)\n"
    )
    path = tmp_path / "a.bin"
    result = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert result.stdout == f"{path}: the output must be writable, found: file too large.\n"
    assert list(tmp_path.iterdir()) == []


def test_impossible_outputs_are_refused_before_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, old = tmp_path / "folder.ply", tmp_path / "old.ply"
    folder.mkdir()
    old.write_bytes(b"old")
    missing = tmp_path / "no" / "a.ply"
    cases: list[tuple[Path, type[Exception], str]] = [
        (folder, OutputError, "the output must be a file, found a directory."),
        (
            old,
            OutputExistsError,
            "the output must not exist yet, found a file; pass overwrite=True (--overwrite) to "
            "replace it.",
        ),
        (
            missing,
            OutputError,
            f"the output must be in an existing directory, found no directory {missing.parent}.",
        ),
    ]
    for path, kind, text in cases:
        for check in (check_output, check_save, write):
            with pytest.raises(kind) as caught:
                check(path)
            assert str(caught.value) == f"{path}: {text}"
    check_save(old, overwrite=True)
    monkeypatch.setattr(os, "access", lambda *args: False)
    with pytest.raises(OutputError) as caught:
        check_output(old, overwrite=True)
    assert str(caught.value) == (
        f"{old}: the output must be in a writable directory, found no permission to write in "
        f"{tmp_path}."
    )


def test_an_unknown_suffix_is_refused_before_writing(tmp_path: Path) -> None:
    text = re.escape(f"must end in {WRITABLE}, found no suffix")
    with pytest.raises(FileFormatError, match=text):
        check_save(tmp_path / "scene")


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
@pytest.mark.parametrize("overwrite", [False, True])
def test_devices_and_pipes_are_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/full")):
        with pytest.raises(OutputError) as caught:
            write(path, overwrite=overwrite)
        assert str(caught.value) == (
            f"{path}: the output must be a regular file, found a device or a pipe."
        )


@pytest.mark.parametrize("name", ["_publish", "_is_own"])
def test_an_interrupt_at_the_end_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def interrupt(*_: object, **__: object) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic, name, interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.bin")
    assert [path.name for path in tmp_path.iterdir()] in ([], ["a.bin"])


def test_an_interrupt_while_it_is_created_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def create(path: Path, mode: str) -> NoReturn:
        path.write_bytes(b"")
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "open", create)
    monkeypatch.setattr(Path, "write_bytes", lambda path, data: os.close(os.open(path, os.O_CREAT)))
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.bin")
    assert list(tmp_path.iterdir()) == []


def test_errors_have_the_number_and_name_of_the_systems_error(tmp_path: Path) -> None:
    """They also survive the way out of another process."""
    (tmp_path / "a.bin").write_bytes(b"old")
    for path, number, kind in (
        (tmp_path / "a.bin", errno.EEXIST, OutputExistsError),
        (tmp_path / "none" / "a.bin", errno.ENOENT, OutputError),
        (tmp_path, errno.EISDIR, OutputError),
    ):
        with pytest.raises(kind) as caught:
            write(path)
        error = caught.value
        for one in (error, pickle.loads(pickle.dumps(error))):
            assert (type(one), one.errno, one.filename) == (kind, number, str(path))
            assert str(one) == str(error)
            assert str(one).startswith(f"{path}: the output must ")
    with pytest.raises(InputNotFoundError, match=r"c\.ply: the file to read must exist") as missing:
        load(tmp_path / "c.ply")
    assert (missing.value.errno, missing.value.filename) == (errno.ENOENT, str(tmp_path / "c.ply"))
    full = OSError(errno.ENOSPC, "No space left on device")
    assert atomic.write_error("b.bin", full).errno == errno.ENOSPC
