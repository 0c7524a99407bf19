"""Types of paths for argparse: files to read, and files and folders to write."""

import argparse
import os
from pathlib import Path


def any_path(text: str) -> Path:
    """Read a path; an empty one, such as a shell variable without a value, is an error."""
    if not text:
        raise argparse.ArgumentTypeError("must be a path, found ''")
    return Path(text)


def new_file(text: str) -> Path:
    """Read the path of a file to write, which standard output cannot replace."""
    if text.endswith(("/", os.sep)):
        raise argparse.ArgumentTypeError(f"must be a file, found the folder {text!r}")
    if text == "-":
        raise argparse.ArgumentTypeError("must be a file, found '-'; ./- is a file of this name")
    return any_path(text)


def new_folder(text: str) -> Path:
    """Read the path of a folder to write to."""
    if text == "-":
        raise argparse.ArgumentTypeError(
            "must be a folder, found '-'; simplify and convert take IN and - for standard output"
        )
    return any_path(text)
