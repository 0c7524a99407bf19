"""Scenes in and out of files and dictionaries; cameras out of files."""

from cvtgs.io.atomic import atomic_output, check_output
from cvtgs.io.cameras import load_cameras
from cvtgs.io.dicts import from_dict, to_dict
from cvtgs.io.folders import scene_file, scene_size
from cvtgs.io.formats import check_save, load, losses, save
from cvtgs.io.limits import Losses

__all__ = [
    "Losses",
    "atomic_output",
    "check_output",
    "check_save",
    "from_dict",
    "load",
    "load_cameras",
    "losses",
    "save",
    "scene_file",
    "scene_size",
    "to_dict",
]
