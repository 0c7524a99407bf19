"""Cameras beside a scene, and a disk cache of images of full scenes.

The cameras of ``NAME.ply`` are in ``NAME.cameras.json`` beside it: ``width`` and ``height`` in
pixels, the intrinsic matrix ``K``, and ``world_to_camera``, a list of 4 x 4 OpenCV matrices.
``python -m benchmarks.cameras SCENE.ply ...`` writes them for objects on nothing or on the ground:
two rings from which people would look. Look at their images before you use them. With
``--transforms``, also ``NAME.transforms.json``, which ``cvtgs train`` and ``--cameras`` read.
"""

import argparse
import hashlib
import io
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import cvtgs
import cvtgs.rendering
from benchmarks.measuring import write_file
from cvtgs.cameras import Cameras, join_cameras, look_at
from cvtgs.evaluation.scorer import ViewImages, render_views
from cvtgs.views.layout import find_layout

RINGS = ((8, 10, 14, 2.9), (4, 35, 32, 2.1))
"""Number of cameras, azimuth of the first one and elevation in degrees, and distance in radii."""

LIFT = 0.15
"""Height of the point that the rings look at, above the middle of the scene, in radii."""

LOWEST, HIGHEST, NEAREST = 3, 38, 2.0
"""Elevations of spread cameras in degrees, and their smallest distance in robust radii."""

GOLDEN_ANGLE = 180 * (3 - math.sqrt(5))  # degrees

SIDE, FIELD = 400, 50
"""Side of the images of the rings in pixels, and the field of view in degrees."""

CACHE = Path(tempfile.gettempdir()) / "cvtgs-full-images"


def cameras_file(scene: Path) -> Path:
    """Return the path of the cameras of a scene, which may not exist."""
    return scene.with_suffix(".cameras.json")


def cameras_beside(scene: Path, *, size: int | None = None) -> Cameras:
    """Read the cameras beside a scene; ``size`` is the longer side of the images, in pixels."""
    path = cameras_file(scene)
    if not path.is_file():
        raise SystemExit(f"{scene}: needs cameras beside it in {path.name}, found none.")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        width, height = found["width"], found["height"]
        viewmats = torch.tensor(found["world_to_camera"], dtype=torch.float64)
        intrinsics = torch.tensor(found["K"], dtype=torch.float64).expand(len(viewmats), 3, 3)
    except (KeyError, RuntimeError, TypeError, ValueError):
        wanted = "width, height, K and world_to_camera"
        raise SystemExit(f"{path}: must have {wanted}; found another format.") from None
    cameras = Cameras(viewmats=viewmats, Ks=intrinsics, width=width, height=height)
    return cameras if size is None else cameras.fitted(size)


def cameras_around(
    scene: cvtgs.GaussianScene,
    azimuths: Float[Tensor, "c"],
    *,
    elevation: float,
    distance: float,
    size: int = SIDE,
    lift: float = 0.0,
) -> Cameras:
    """Return cameras that look at the middle of a scene, all from one elevation and distance.

    Angles are in degrees; ``distance``, and ``lift`` of the middle along up, in robust radii.
    """
    layout = find_layout(scene)
    up, radius = layout.up.double(), float(layout.frame.radius)
    middle = layout.frame.center.double() + lift * radius * up
    least = torch.eye(3, dtype=up.dtype)[up.abs().argmin()]
    across = torch.nn.functional.normalize(torch.linalg.cross(up, least), dim=0)
    along = torch.linalg.cross(up, across)
    turns, rise = torch.deg2rad(azimuths.double())[:, None], math.radians(elevation)
    level = turns.cos() * across + turns.sin() * along
    eyes = middle + distance * radius * (math.cos(rise) * level + math.sin(rise) * up)
    return looking(eyes, middle.expand_as(eyes), up, size=(size, size))


def looking(
    eyes: Float[Tensor, "c 3"],
    targets: Float[Tensor, "c 3"],
    up: Float[Tensor, "3"],
    *,
    size: tuple[int, int],
    field: float = FIELD,
) -> Cameras:
    """Return cameras at some points that look at others, all float64.

    ``size`` is the width and height of images in pixels, ``field`` the horizontal field of view in
    degrees.
    """
    width, height = size
    focal = 0.5 * width / math.tan(math.radians(field / 2))
    rows = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Cameras(
        viewmats=look_at(eyes, targets, up),
        Ks=torch.tensor(rows, dtype=torch.float64).repeat(len(eyes), 1, 1),
        width=width,
        height=height,
    )


def ring_cameras(scene: cvtgs.GaussianScene) -> Cameras:
    """Return eight cameras around a scene, and four nearer ones that look down more steeply."""
    rings = [
        cameras_around(
            scene,
            first + 360 / count * torch.arange(count),
            elevation=elevation,
            distance=distance,
            lift=LIFT,
        )
        for count, first, elevation, distance in RINGS
    ]
    return Cameras(
        viewmats=torch.cat([ring.viewmats for ring in rings]),
        Ks=torch.cat([ring.Ks for ring in rings]),
        width=SIDE,
        height=SIDE,
    )


def spread_cameras(scene: cvtgs.GaussianScene, count: int) -> Cameras:
    """Return cameras from where people would look, none of them those of the rings."""
    turns = torch.arange(count, dtype=torch.float64) * GOLDEN_ANGLE
    random = torch.Generator().manual_seed(5)
    found = []
    for turn in turns:
        height, distance = torch.rand(2, generator=random).tolist()
        found.append(
            cameras_around(
                scene,
                turn[None] % 360,
                elevation=LOWEST + (HIGHEST - LOWEST) * height,
                distance=NEAREST + distance,
                lift=LIFT,
            )
        )
    return join_cameras(found)


def beside_format(cameras: Cameras) -> dict[str, Any]:
    """Return the content of ``NAME.cameras.json``."""
    return {
        "width": cameras.width,
        "height": cameras.height,
        "K": cameras.Ks[0].tolist(),
        "world_to_camera": cameras.viewmats.tolist(),
    }


def nerf_format(cameras: Cameras) -> dict[str, Any]:
    """Return the content of ``transforms.json``: poses with OpenGL axes."""
    poses = torch.linalg.inv(cameras.viewmats)
    poses[:, :3, 1:3] *= -1
    (focal_x, _, center_x), (_, focal_y, center_y), _ = cameras.Ks[0].tolist()
    return {
        "w": cameras.width,
        "h": cameras.height,
        "fl_x": focal_x,
        "fl_y": focal_y,
        "cx": center_x,
        "cy": center_y,
        "frames": [
            {"file_path": f"{number:03d}", "transform_matrix": pose.tolist()}
            for number, pose in enumerate(poses)
        ],
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FullImages:
    """Images of a full scene from its cameras, rendered once and then read from a folder.

    Attributes:
        scene: The full scene.
        cameras: The cameras.
        folder: Cache folder. File names are hashes of scene, camera, size and the renderer's
            source.
    """

    scene: cvtgs.GaussianScene
    cameras: Cameras
    folder: Path = CACHE

    def images(self) -> Iterator[ViewImages]:
        """Yield the image of each camera, from disk if it is cached."""
        about_scene = _digest(self.scene)
        for camera in self.cameras.singles():
            key = hashlib.sha256(about_scene)
            key.update(_bytes_of(camera.viewmats))
            key.update(_bytes_of(camera.Ks))
            key.update(f"{camera.width} {camera.height} {any(camera.ignores_tag)}".encode())
            path = self.folder / f"{key.hexdigest()[:32]}.npy"
            if not path.is_file():
                found = render_views(self.scene, camera)
                pixels = torch.cat([found.rgb, found.alpha[..., None]], dim=3)
                write_file(path, _npy(pixels.numpy()))
            pixels = torch.from_numpy(np.load(path))
            yield ViewImages(cameras=camera, rgb=pixels[..., :3], alpha=pixels[..., 3])


def _digest(scene: cvtgs.GaussianScene) -> bytes:
    """Return a hash of the scene and of the renderer's source."""
    found = hashlib.sha256(str(scene.antialiased).encode())
    tensors = (
        scene.means, scene.log_scales, scene.quats, scene.logit_opacities, scene.sh0, scene.shN
    )  # fmt: skip
    for tensor in tensors:
        found.update(_bytes_of(tensor))
    for path in sorted(Path(cvtgs.rendering.__file__).parent.glob("*.py")):
        found.update(path.read_bytes())
    return found.digest()


def _bytes_of(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def main(args: Sequence[str] | None = None) -> None:
    """Write the rings of every scene beside it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path, help="scenes")
    parser.add_argument("--transforms", action="store_true", help="also NAME.transforms.json")
    options = parser.parse_args(args)
    for file in options.files:
        cameras = ring_cameras(cvtgs.load(file))
        contents = {cameras_file(file): beside_format(cameras)}
        if options.transforms:
            contents[file.with_suffix(".transforms.json")] = nerf_format(cameras)
        for path, content in contents.items():
            write_file(path, json.dumps(content).encode())
            print(path)


if __name__ == "__main__":
    main()
