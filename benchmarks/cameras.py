"""Hand-picked cameras of a scene, and a disk cache of images of full scenes.

The cameras of ``NAME.ply`` are in ``NAME.cameras.json`` beside it: ``width`` and ``height`` in
pixels, the intrinsic matrix ``K``, and ``world_to_camera``, a list of 4 x 4 OpenCV matrices.
"""

import hashlib
import io
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import cvtgs
import cvtgs.rendering
from benchmarks.measuring import write_file
from cvtgs.cameras import Cameras
from cvtgs.evaluation.scorer import ViewImage, render_view

CACHE = Path(tempfile.gettempdir()) / "cvtgs-full-images"


def cameras_file(scene: Path) -> Path:
    """Return the path of the cameras of a scene, which may not exist."""
    return scene.with_suffix(".cameras.json")


def cameras_beside(scene: Path, *, size: int | None = None) -> Cameras:
    """Read the cameras beside a scene; ``size`` is the longer side of the images, in pixels."""
    path = cameras_file(scene)
    if not path.is_file():
        raise SystemExit(f"{scene}: needs cameras beside it in {path.name}, found none.")
    found = json.loads(path.read_text(encoding="utf-8"))
    viewmats = torch.tensor(found["world_to_camera"], dtype=torch.float64)
    intrinsics = torch.tensor(found["K"], dtype=torch.float64).expand(len(viewmats), 3, 3)
    cameras = Cameras(
        viewmats=viewmats, Ks=intrinsics, width=found["width"], height=found["height"]
    )
    return cameras if size is None else cameras.fitted(size)


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

    def images(self) -> Iterator[ViewImage]:
        """Yield the image of each camera, from disk if it is cached."""
        about_scene = _digest(self.scene)
        for camera in self.cameras.singles():
            key = hashlib.sha256(about_scene)
            key.update(_bytes_of(camera.viewmats))
            key.update(_bytes_of(camera.Ks))
            key.update(f"{camera.width} {camera.height}".encode())
            path = self.folder / f"{key.hexdigest()[:32]}.npy"
            if not path.is_file():
                found = render_view(self.scene, camera)
                pixels = torch.cat([found.rgb, found.alpha[..., None]], dim=3)
                write_file(path, _npy(pixels.numpy()))
            pixels = torch.from_numpy(np.load(path))
            yield ViewImage(
                camera=camera, rgb=pixels[..., :3], alpha=pixels[..., 3], backend="kept"
            )


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
