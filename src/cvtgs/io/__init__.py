"""Read and write scenes as files and dictionaries, and read cameras from files.

Names are imported on first use, and a format when a file of it is read or written.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cvtgs.io.atomic import atomic_output, check_output
    from cvtgs.io.axes import change_axes
    from cvtgs.io.cameras import load_cameras
    from cvtgs.io.dicts import from_dict, to_dict
    from cvtgs.io.files import scene_file, scene_size
    from cvtgs.io.formats import check_save, load, losses, save
    from cvtgs.io.limits import Losses

_HOME = {
    "Losses": "limits",
    "atomic_output": "atomic",
    "change_axes": "axes",
    "check_output": "atomic",
    "check_save": "formats",
    "from_dict": "dicts",
    "load": "formats",
    "load_cameras": "cameras",
    "losses": "formats",
    "save": "formats",
    "scene_file": "files",
    "scene_size": "files",
    "to_dict": "dicts",
}
__all__ = [
    "Losses",
    "atomic_output",
    "change_axes",
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


if not TYPE_CHECKING:  # or type checkers would accept any name

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'cvtgs.io' has no attribute {name!r}")
        value = getattr(import_module(f"cvtgs.io.{_HOME[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)
