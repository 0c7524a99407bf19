"""Scenes in and out of files and dictionaries; cameras out of files."""

from cvtgs.io.atomic import atomic_output, check_output
from cvtgs.io.cameras import load_cameras
from cvtgs.io.dicts import from_dict, to_dict
from cvtgs.io.formats import check_save, load, save

__all__ = [
    "atomic_output",
    "check_output",
    "check_save",
    "from_dict",
    "load",
    "load_cameras",
    "save",
    "to_dict",
]
