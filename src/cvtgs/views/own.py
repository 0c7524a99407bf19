"""The cameras of a capture, if they are in the folder of its model."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import CvtgsError, FileFormatError, check_path, warn
from cvtgs.scene import GaussianScene, SceneLike, as_scene

_LEAST_SEEN = 0.01  # share of the visible Gaussians in the image of a camera that looks at a scene
LEAST_FILLED = 0.01  # share of an image that a scene spans, from which on cameras are of its scale
MOST_TRIED = 500  # cameras that tell whether all are of a scene
FEW = 100  # a scene of fewer Gaussians may be small in all images
_MIDDLE = 0.1  # quantile from which to the opposite one a scene is measured
_NERFSTUDIO = re.compile("(?i)nerf?studio")  # its exporter misspells itself
_LEAST_LOOKING = 0.5
_MOST_POINTS = 2000
_VISIBLE = 0.1
_LEAST_TEST = 4  # a test split of fewer cameras is not used: their mean would tell little


class OwnCameras(NamedTuple):
    """Cameras of a capture, and the file or folder that holds them."""

    cameras: Cameras
    source: Path

    def test_cameras(self) -> Cameras | None:
        """Return the test split: every eighth by name, unless the files have their own.

        Returns:
            The cameras; None if the files have no test split, or one of fewer than four cameras.
        """
        from cvtgs.io import load_cameras  # noqa: PLC0415 (a scene in memory needs no formats)

        try:
            cameras = load_cameras(self.source, split="test")
        except CvtgsError:
            return None
        return cameras if _LEAST_TEST <= len(cameras) < len(self.cameras) else None


def find_own_cameras(scene: SceneLike, path: str | os.PathLike[str]) -> OwnCameras | None:
    """Read the cameras stored beside a scene, if they look at it.

    The folder of the model (in INRIA's layout the one above ``point_cloud``) and then the folder of
    the file are searched for formats that :func:`cvtgs.io.load_cameras` reads. Cameras of another
    world frame, as after a capture was moved or scaled, are rejected: in at least half of the
    images there must be a hundredth of the visible Gaussians, which span at least 1 % of the image.
    nerfstudio moves and scales the scenes that it exports, so cameras beside these are not used.
    A damaged file causes a warning.

    Args:
        scene: The scene, as it was read, or its path.
        path: The file or folder that it was read from.

    Returns:
        The cameras, at least two; None if there are none that fit.

    Raises:
        InvalidArgumentError: An argument has another type.

    Example:
        >>> import tempfile
        >>> from cvtgs.synthetic import scene as make
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(find_own_cameras(make("object", 100), Path(folder) / "scene.ply"))
        None
    """
    from cvtgs.io import load_cameras  # noqa: PLC0415 (a scene in memory needs no formats)

    scene = as_scene(scene)
    check_path(path)
    if any(map(_NERFSTUDIO.search, scene.comments)):
        return None
    place, faults = Path(path), set[str]()
    for source in _sources(place) if place.exists() else ():
        try:
            cameras = load_cameras(source)
        except FileFormatError as error:
            if str(error) not in faults:
                faults.add(str(error))
                warn(f"cameras are not used: {error}")
            continue
        except CvtgsError:  # there are none
            continue
        looking = float(_looking(cameras.spread(MOST_TRIED), scene).double().mean())
        if len(cameras) > 1 and looking >= _LEAST_LOOKING:
            return OwnCameras(cameras, source)
    return None


def _sources(path: Path) -> Iterator[Path]:
    """Yield possible sources of cameras: first INRIA's files, which share the scene's frame."""
    from cvtgs.io import scene_file  # noqa: PLC0415

    file = scene_file(path)
    folders = [path] if path.is_dir() else []
    if file.parent.parent.name == "point_cloud":
        folders.append(file.parent.parent.parent)
    folders.append(file.parent)
    for folder in dict.fromkeys(folders):
        if (folder / "cameras.json").is_file():
            yield folder / "cameras.json"
        yield folder


def _looking(cameras: Cameras, scene: GaussianScene) -> Bool[Tensor, "c"]:
    """Return which cameras have enough of the visible Gaussians in their images, not tiny."""
    inside, filled = in_images(cameras, scene)
    return (inside >= _LEAST_SEEN) & ((filled >= LEAST_FILLED) | (len(scene) < FEW))


def in_images(
    cameras: Cameras, scene: GaussianScene
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Return the shares of visible Gaussians in images, and of images that the middle ones span."""
    rows = (scene.opacities > _VISIBLE).nonzero()[:, 0]
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    points = scene.means[rows].double().cpu()
    points = points[torch.isfinite(points).all(dim=1)]
    if len(points) == 0:
        none = torch.zeros(len(cameras), dtype=torch.float64, device="cpu")
        return none, none
    viewmats, intrinsics = cameras.viewmats.double().cpu(), cameras.Ks.double().cpu()
    local = points @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
    x, y, z = (local @ intrinsics.transpose(1, 2)).unbind(2)
    inside = (z > 0) & (x > 0) & (x < cameras.width * z) & (y > 0) & (y < cameras.height * z)
    ends, filled = x.new_tensor([_MIDDLE, 1.0 - _MIDDLE]), x.new_ones(len(cameras))
    for axis, size in ((x, cameras.width), (y, cameras.height)):
        low, high = torch.where(inside, axis / z, torch.nan).nanquantile(ends, dim=1)
        filled *= ((high - low) / size).nan_to_num(0.0)
    return inside.double().mean(dim=1), filled
