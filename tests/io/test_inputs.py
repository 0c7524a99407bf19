"""Paths that cannot be opened as a scene, whatever they hold."""

import os
from pathlib import Path

import pytest

from cvtgs.errors import FileFormatError, InputError, InputNotFoundError
from cvtgs.io import load
from ply_files import gaussian_properties, gaussian_rows, ply_bytes

GOOD = ply_bytes(gaussian_properties(), gaussian_rows(gaussian_properties(), 3))


def test_file_not_found(tmp_path: Path) -> None:
    path = tmp_path / "none.ply"
    with pytest.raises(InputNotFoundError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: the file to read must exist, found none."
    assert isinstance(caught.value, FileNotFoundError)


@pytest.mark.parametrize("end", ["ply", "compressed.ply", "spz", "splat", "sog", "ckpt", "pt"])
def test_a_pointer_of_git_lfs_is_not_the_file(tmp_path: Path, end: str) -> None:
    path = tmp_path / f"scene.{end}"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be the file itself, found a pointer of Git LFS to it; get the file with: "
        f"git lfs pull."
    )


@pytest.mark.parametrize("name", ["folder", "folder.ply"])
def test_a_directory_is_no_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.mkdir()
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be a file or the folder of a trained model, found a directory without "
        f"point_cloud/iteration_*/point_cloud.ply, step-*.ckpt, point_cloud.ply or meta.json."
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_no_file(tmp_path: Path) -> None:
    path = tmp_path / "pipe.ply"
    os.mkfifo(path)
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: must be a regular file, found a device or a pipe."


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s.ply"
    path.write_bytes(GOOD)

    def refuse(*args: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: the file must be readable, found: permission denied."


@pytest.mark.parametrize(("name", "found"), [("s.xyz", "the suffix '.xyz'"), ("s", "no suffix")])
def test_unknown_suffix(tmp_path: Path, name: str, found: str) -> None:
    path = tmp_path / name
    path.write_bytes(GOOD)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: the file name must end in .compressed.ply, .ply, .spz, .splat, .sog, meta.json, "
        f".ckpt or .pt, found {found}."
    )


def test_suffixes_ignore_case(tmp_path: Path) -> None:
    path = tmp_path / "S.PLY"
    path.write_bytes(GOOD)
    assert len(load(path)) == 3
