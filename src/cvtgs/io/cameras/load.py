"""Read cameras, with the format detected from the files at the path."""

import os
from pathlib import Path

from cvtgs.cameras import Cameras
from cvtgs.errors import FileFormatError, InputNotFoundError, InvalidArgumentError
from cvtgs.io.cameras.views import SPLITS, Split, View, hold_out, to_cameras
from cvtgs.io.files import is_file, is_folder

_COLMAP_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_KNOWN_FILES = (
    "transforms.json, transforms_train.json, transforms_test.json, a COLMAP model (in sparse/0, "
    "sparse or the folder itself) or cameras.json"
)


def load_cameras(path: str | os.PathLike[str], *, split: Split | None = None) -> Cameras:
    """Read the cameras of a capture.

    In a folder, these are tried in this order:

    - ``transforms.json`` of NeRF, instant-ngp or nerfstudio; or ``transforms_train.json`` and
      ``transforms_test.json``. OpenGL axes become OpenCV axes. Intrinsics come from the frame,
      else from the file; the default principal point is the image centre; a missing image size is
      read from the PNG images. ``applied_transform`` is ignored: the cameras stay in the world of
      the file. Scenes exported by nerfstudio are moved and scaled relative to it, unless this was
      disabled in training.
    - a COLMAP model in ``sparse/0``, ``sparse`` or the folder itself, binary before text, of any
      pinhole model; the cameras are in the order of their names.
    - ``cameras.json`` of INRIA's 3DGS code.

    :class:`cvtgs.cameras.Cameras` have one image size. If sizes differ, the most frequent one (the
    first in a tie) is used, and the intrinsics of other cameras are scaled to it, separately for
    rows and columns; photographs must be resized in the same way. Distortion is left out with a
    warning.

    The split is that of the files (``transforms_test.json``, or ``test_filenames`` in the file).
    If there is none, every 8th camera in the order of names, from the first, is for testing.

    Args:
        path: A folder, or one of these files.
        split: ``"train"``, ``"test"``, or None for all cameras, training first.

    Returns:
        The cameras, float64 on the CPU; their names are the image names or paths in the file.

    Raises:
        InvalidArgumentError: The split does not exist, or the file is that of the other split.
        InputNotFoundError: The path does not exist, or the folder has none of these files.
        InputError: A file cannot be opened or read.
        FileFormatError: A file does not conform to its format, or has no camera of the split.

    Example:
        >>> import json, tempfile
        >>> frame = {"file_path": "a.png", "transform_matrix": [
        ...     [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}
        >>> document = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [frame]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "transforms.json").write_text(json.dumps(document))
        ...     cameras = load_cameras(folder)
        >>> cameras.names, cameras.centers[0, 2].item()
        (('a.png',), 4.0)
    """
    if split is not None and split not in SPLITS:
        raise InvalidArgumentError(f"split must be 'train', 'test' or None, found {split!r}.")
    source = Path(path)
    views = _folder_views(source, split) if is_folder(source) else _file_views(source, split)
    if not views:
        raise FileFormatError(
            f"{source}: must hold at least one {f'{split} ' if split else ''}camera, found none."
        )
    return to_cameras(views, str(source))


def _folder_views(folder: Path, split: Split | None) -> list[View]:
    if is_file(folder / "transforms.json"):
        return _file_views(folder / "transforms.json", split)
    parts = {name: folder / f"transforms_{name}.json" for name in SPLITS}
    there = [part for part in parts.values() if is_file(part)]
    if there:
        if split is not None and parts[split] not in there:
            raise InputNotFoundError(
                f"{folder}: must hold {parts[split].name} for the split {split!r}, found "
                f"{there[0].name} only; choose the other split, or none for all cameras."
            )
        chosen = there if split is None else [parts[split]]
        return [view for part in chosen for view in _file_views(part, split)]
    from cvtgs.io.cameras.colmap import colmap_views, is_colmap  # noqa: PLC0415 (when it is read)

    for model in (folder / "sparse" / "0", folder / "sparse", folder):
        if is_colmap(model):
            return hold_out(colmap_views(model), split)
    if is_file(folder / "cameras.json"):
        return _file_views(folder / "cameras.json", split)
    raise InputNotFoundError(f"{folder}: the folder must hold {_KNOWN_FILES}; found none of them.")


def _file_views(path: Path, split: Split | None) -> list[View]:
    if path.name in _COLMAP_FILES:
        from cvtgs.io.cameras.colmap import colmap_views  # noqa: PLC0415 (when it is read)

        return hold_out(colmap_views(path.parent), split)
    if path.suffix.lower() != ".json" and is_file(path):
        raise FileFormatError(
            f"{path}: a camera file must be JSON (.json) or part of a COLMAP model "
            f"({', '.join(_COLMAP_FILES)}), found neither."
        )
    from cvtgs.io.cameras.transforms import inria_views, transforms_views  # noqa: PLC0415
    from cvtgs.io.files import read_json  # noqa: PLC0415

    content = read_json(path)
    if isinstance(content, list):
        return hold_out(inria_views(content, path), split)
    if isinstance(content, dict) and "frames" in content:
        return transforms_views(content, path, split)
    raise FileFormatError(
        f"{path}: must be a list of cameras (INRIA's cameras.json) or an object with 'frames' "
        f"(transforms.json), found neither."
    )
