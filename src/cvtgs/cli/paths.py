"""Paths of commands: types for argparse, and checks that outputs replace no input."""

import argparse
import os
from contextlib import suppress
from pathlib import Path

import cvtgs
from cvtgs.errors import InputError, InvalidArgumentError

# Suffixes of files that commands read or write; a new folder of such a name is a mistake.
_SCENES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf", ".usda")
FILE_SUFFIXES = (*_SCENES, ".html", ".json", ".csv", ".png", ".jpg")


def any_path(text: str) -> Path:
    """Read a path; an empty one, such as a shell variable without a value, is an error."""
    if not text:
        raise argparse.ArgumentTypeError("must be a path, found ''")
    return Path(text)


def new_file(text: str, kind: str) -> Path:
    """Read the path of a file of a kind to write, which standard output cannot replace."""
    if text.endswith(("/", os.sep)):
        raise argparse.ArgumentTypeError(f"must be a file, found the folder {text!r}")
    if text == "-":
        raise argparse.ArgumentTypeError("must be a file, found '-'; ./- is a file of this name")
    if text.lower().endswith(FILE_SUFFIXES) and not text.lower().endswith(kind):
        raise argparse.ArgumentTypeError(f"must be a {kind} file, found {text!r}")
    return any_path(text)


def new_folder(text: str) -> Path:
    """Read the path of a folder to write to, which has no name like that of a file."""
    folder = folder_or_file(text)
    if names_file(folder):
        raise argparse.ArgumentTypeError(f"must be a folder, found the file name {text!r}")
    return folder


def folder_or_file(text: str) -> Path:
    """Read the path of a folder or file to write to, which standard output cannot replace."""
    if text == "-":
        raise argparse.ArgumentTypeError(
            "must be a folder, found '-'; simplify and convert take IN and - for standard output"
        )
    return any_path(text)


def names_file(path: Path) -> bool:
    """Return whether a path is no folder and ends like a file that commands read or write."""
    is_folder = os.path.isdir(path)  # noqa: PTH112 (false for impossible names)
    return path.name.lower().endswith(FILE_SUFFIXES) and not is_folder


def check_written_files(options: argparse.Namespace) -> None:
    """Raise if OUT or the report would overwrite each other or an input, but for OUT and IN."""
    taken = {
        f"--{name}": Path(value)
        for name in ("config", "cameras", "keep", "ckpt")
        if (value := getattr(options, name)) not in (None, "auto", "none")
    }
    for name, path in (("OUT", options.output), ("--report", options.report)):
        for other, file in taken.items():
            if path is not None and is_same_file(path, file):
                raise InvalidArgumentError(
                    f"{name} and {other} must be different files, found {path} for both."
                )
        taken["OUT"] = options.output  # which may replace IN, since that is read before
        with suppress(InputError):  # an error later
            taken["IN"] = cvtgs.io.scene_file(options.input)


def is_same_file(path: Path, other: Path) -> bool:
    """Return whether two paths lead to one file."""
    if os.path.realpath(path) == os.path.realpath(other):
        return True
    try:
        return path.samefile(other)  # a link, or another spelling on a case-insensitive file system
    except (OSError, ValueError):
        return False
