"""Find the transform from the cameras' world space to that of a trained model.

INRIA's code applies none. nerfstudio records its transform. gsplat's trainer does not record it; by
default (``normalize_world_space``) it

1. rotates the mean up axis of all cameras to the camera's up axis, -y,
2. moves the focus to the origin: the coordinate-wise median of the points on the cameras' optical
   axes that are nearest to it,
3. scales the median distance of the cameras to 1,
4. moves the median of the COLMAP points to the origin and rotates their principal axes to x, y, z,
   the largest variance first.

The signs of these axes depend on gsplat's version and on the linear algebra library. This leaves
four candidate worlds, besides the untransformed one. The world of a model is the candidate in which
the COLMAP points, from which the model was trained, are nearest to its Gaussians.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

import cvtgs
from benchmarks.datasets import Capture, sparse_folder
from cvtgs.cameras import Cameras

TRANSFORM = "dataparser_transforms.json"
FARTHEST = 0.05
"""Limit of the median distance of points to the nearest Gaussian, relative to the median distance
of the points to their centre. It is at most 0.016 between two halves of each of thirteen captures,
and 0.02 to 0.5 between two different captures that were normalized."""
FEWEST = 20
"""Smallest number of points from which a world is found."""

Points = Float[np.ndarray, "p 3"]


class World(NamedTuple):
    """The map ``turn @ x + shift`` of points from the cameras' world to that of a model.

    Attributes:
        turn: A rotation times a scale.
        shift: A translation.
    """

    turn: Float[Tensor, "3 3"] = torch.eye(3, dtype=torch.float64)
    shift: Float[Tensor, "3"] = torch.zeros(3, dtype=torch.float64)

    def move_points(self, points: Points) -> Points:
        """Transform points from the cameras' world to the model's."""
        moved: Points = points @ self.turn.numpy().T + self.shift.numpy()
        return moved

    def move_cameras(self, cameras: Cameras) -> Cameras:
        """Transform cameras from their own world to the model's."""
        viewmats = cameras.viewmats.double().clone()
        rotations = viewmats[:, :3, :3] @ (self.turn / torch.det(self.turn) ** (1 / 3)).T
        centers = cameras.centers.double() @ self.turn.T + self.shift
        viewmats[:, :3, :3] = rotations
        viewmats[:, :3, 3] = -(rotations @ centers[:, :, None])[:, :, 0]
        return replace(cameras, viewmats=viewmats.to(cameras.viewmats.dtype))


def place_cameras(capture: Capture, scene: cvtgs.GaussianScene, cameras: Cameras) -> Cameras:
    """Transform cameras of a dataset to the world of its model; exit if the scenes differ."""
    means = scene.means[scene.opacities > 0.1].double()
    means = means[torch.isfinite(means).all(dim=1)]
    if not len(means):
        raise SystemExit(f"{capture.model.path}: must hold visible Gaussians, found none.")
    worlds = [World()]
    if capture.model.layout == "nerfstudio":
        worlds = [nerfstudio_world(capture.model.path)]
    folder = sparse_folder(capture.folder)
    points = read_points(folder) if folder else np.empty((0, 3))
    if len(points) >= FEWEST:
        if capture.model.layout == "gsplat":
            worlds += gsplat_worlds(cvtgs.load_cameras(folder or capture.folder), points)
        worlds = [_nearest_world(capture, worlds, points, means)]
    moved = worlds[0].move_cameras(cameras)
    _check_looks(capture, means, moved)
    return moved


def nerfstudio_world(path: Path) -> World:
    """Read nerfstudio's transform beside or above a model; the identity if there is none."""
    places = [parent / TRANSFORM for parent in path.parents[:3]]
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        return World()
    stored = json.loads(place.read_text(encoding="utf-8"))
    transform = torch.tensor(stored["transform"], dtype=torch.float64) * float(stored["scale"])
    return World(transform[:, :3], transform[:, 3])


def gsplat_worlds(cameras: Cameras, points: Points) -> Iterator[World]:
    """Yield the four worlds to which gsplat may have normalized cameras and points."""
    axes = cameras.viewmats[:, :3, :3].double().numpy()  # rows: right, down, forward
    centers = cameras.centers.double().numpy()
    up = -axes[:, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    turn = Rotation.from_quat([up[2], 0.0, -up[0], 1 - up[1]]).as_matrix()  # up x -y, 1 + up . -y
    ahead, places = axes[:, 2] @ turn.T, centers @ turn.T
    focus = np.median(places - (places * ahead).sum(axis=1, keepdims=True) * ahead, axis=0)
    scale = 1 / np.median(np.linalg.norm(places - focus, axis=1))
    near = scale * (points @ turn.T - focus)
    middle = np.median(near, axis=0)
    principal = np.linalg.eigh(np.cov(near, rowvar=False))[1][:, ::-1].T
    principal[0] *= np.linalg.det(principal)
    for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        last = np.array(signs)[:, None] * principal
        yield World(
            torch.from_numpy(scale * last @ turn),
            torch.from_numpy(last @ (-scale * focus - middle)),
        )


def read_points(folder: Path) -> Points:
    """Read the points of a sparse COLMAP model; return none if there is no points file."""
    for name, read in (("points3D.bin", _binary_points), ("points3D.txt", _text_points)):
        path = folder / name
        if path.is_file():
            try:
                return np.array(list(read(path.read_bytes())), dtype=float).reshape(-1, 3)
            except (struct.error, ValueError):
                raise SystemExit(
                    f"{path}: must be the points of a COLMAP model, found an invalid record."
                ) from None
    return np.empty((0, 3))


def _binary_points(data: bytes) -> Iterator[Sequence[float]]:
    """Yield positions; a record has id, position, colour, error and a track of varying length."""
    record, at = struct.Struct("<Q3d3BdQ"), struct.calcsize("<Q")
    for _ in range(struct.unpack_from("<Q", data)[0]):
        found = record.unpack_from(data, at)
        at += record.size + struct.calcsize("<ii") * found[-1]
        yield found[1:4]


def _text_points(data: bytes) -> Iterator[Sequence[str]]:
    for line in data.decode().splitlines():
        if line.strip() and not line.startswith("#"):
            yield line.split()[1:4]


def _nearest_world(
    capture: Capture, worlds: list[World], points: Points, means: Float[Tensor, "n 3"]
) -> World:
    """Return the world in which points are nearest to Gaussians; exit if none is near."""
    points = points[:: max(1, len(points) // 2000)]
    tree = KDTree(means.numpy())
    distances = []
    for world in worlds:
        moved = world.move_points(points)
        spread = np.median(np.linalg.norm(moved - np.median(moved, axis=0), axis=1))
        distances.append(float(np.median(tree.query(moved)[0]) / spread))
    if not min(distances) <= FARTHEST:
        raise SystemExit(
            f"{capture.model.path}: must be a model of {capture.folder}, but the COLMAP points "
            f"there are {min(distances):.2f} of their spread away from its Gaussians (at most "
            f"{FARTHEST:g}); it is the model of another scene, or its coordinates were "
            f"transformed in an unknown way."
        )
    return worlds[distances.index(min(distances))]


def _check_looks(capture: Capture, means: Float[Tensor, "n 3"], cameras: Cameras) -> None:
    """Exit if a model is not where its cameras look.

    At least half of the cameras must have more than 1 % of the Gaussians ``means`` in their image.
    A stricter rule would reject captures whose cameras are all on one side.
    """
    means = means[:: max(1, len(means) // 4096)]
    local = means @ cameras.viewmats[:, :3, :3].double().mT + cameras.viewmats[:, None, :3, 3]
    x, y, z = (local @ cameras.Ks.double().mT).unbind(2)
    inside = (z > 0) & (x > 0) & (x < cameras.width * z) & (y > 0) & (y < cameras.height * z)
    looking = float((inside.double().mean(dim=1) > 0.01).double().mean())
    if looking < 0.5:
        raise SystemExit(
            f"{capture.model.path}: must be a model of {capture.folder}, but its Gaussians are not "
            f"where its cameras look; it is the model of another scene, or of a world that was "
            f"normalized for the training."
        )
