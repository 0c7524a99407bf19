"""Where the world of a model lies in that of its cameras, and models of other scenes."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import cvtgs
from benchmarks.worlds import World, gsplat_worlds
from camera_files import poses
from cvtgs.cameras import Cameras
from cvtgs.edit import Motion, move
from dataset_files import (
    SCALE,
    SHIFT,
    TURN,
    ball,
    capture_of,
    colmap_dataset,
    inria_model,
    refusal,
    score_of,
)


def test_cameras_move_with_points():
    """A point falls on the same pixel before and after both were moved."""
    g = torch.Generator().manual_seed(0)
    points = torch.randn(5, 3, generator=g)
    cameras = Cameras(
        viewmats=torch.tensor(
            [[[0.6, 0, -0.8, 0.1], [0, 1, 0, 0.2], [0.8, 0, 0.6, 5], [0, 0, 0, 1.0]]]
        ),
        Ks=torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]),
        width=64,
        height=48,
    )
    moved = World(SCALE * TURN.double(), SCALE * SHIFT.double()).move_cameras(cameras)
    places = []
    for view, xyz in ((cameras, points), (moved, (points @ TURN.T + SHIFT) * SCALE)):
        local = xyz @ view.viewmats[0, :3, :3].T + view.viewmats[0, :3, 3]
        pixels = local @ view.Ks[0].T
        places.append(pixels[:, :2] / pixels[:, 2:])
    torch.testing.assert_close(*places, rtol=1e-4, atol=1e-3)


Poses = list[tuple[np.ndarray, np.ndarray]]
"""Rotations from camera (right, down, forward) to world, and positions."""


def gsplat_matrix(poses: Poses, points: np.ndarray, signs: tuple[int, int, int]) -> np.ndarray:
    """The matrix that gsplat's trainer applies to cameras and points, computed step by step."""
    up = sum(-rotation[:, 1] for rotation, _ in poses)
    up /= np.linalg.norm(up)
    axis = np.cross(up, [0, -1, 0])
    skew = np.cross(np.eye(3), axis)
    first = np.eye(4)
    first[:3, :3] += skew + skew @ skew / (1 + up @ [0, -1, 0])
    assert np.allclose(first[:3, :3] @ up, [0, -1, 0])
    nearest = []
    for rotation, center in poses:
        ahead, place = first[:3, :3] @ rotation[:, 2], first[:3, :3] @ center
        nearest.append(place - (place @ ahead) * ahead)
    first[:3, 3] = -np.median(nearest, axis=0)
    far = [np.linalg.norm(first[:3, :3] @ center + first[:3, 3]) for _, center in poses]
    first[:3] /= np.median(far)
    near = points @ first[:3, :3].T + first[:3, 3]
    variances, axes = np.linalg.eigh(np.cov(near.T))
    assert (np.diff(variances) > 0.1 * variances[1:]).all()  # no axis is left to rounding
    axes = axes[:, ::-1] * signs
    axes[:, 0] *= np.linalg.det(axes)
    second = np.eye(4)
    second[:3, :3], second[:3, 3] = axes.T, -axes.T @ np.median(near, axis=0)
    return second @ first


def write_points(points: np.ndarray, folder: Path, *, text: bool) -> None:
    """COLMAP's points, with tracks of 0, 1, 2, 0 ... images."""
    if text:
        lines = [
            f"{row} {x!r} {y!r} {z!r} 1 2 3 0.5 1 7"
            for row, (x, y, z) in enumerate(points.tolist())
        ]
        (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(lines) + "\n")
        return
    data = struct.pack("<Q", len(points))
    for row, xyz in enumerate(points.tolist()):
        data += struct.pack("<Q3d3Bd", row, *xyz, 1, 2, 3, 0.5)
        data += struct.pack("<Q", row % 3) + struct.pack("<ii", 1, 7) * (row % 3)
    (folder / "points3D.bin").write_bytes(data)


def lopsided_ball() -> cvtgs.GaussianScene:
    """A scene that changes when it is turned by 180 degrees about any axis."""
    means = ball().means * torch.tensor([1.4, 0.9, 0.5])
    return ball().with_tensors({"means": means + 0.3 * means[:, :1].square()}, {})


def normalized_dataset(root: Path, *, signs: tuple[int, int, int], text: bool = False) -> Path:
    """A scene, its points, and the checkpoint of a training in a normalized world."""
    lopsided = lopsided_ball()
    colmap_dataset(lopsided, root / "360_v2" / "room", "images_2")
    points = lopsided.means[::3].double().numpy()
    write_points(points, root / "360_v2" / "room" / "sparse" / "0", text=text)
    matrix = gsplat_matrix(poses(), points, signs)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3] / scale).as_quat()
    moved = move(
        lopsided, Motion(quat=(w, x, y, z), scale=float(scale), shift=tuple(matrix[:3, 3]))
    )
    path = root / "runs" / "room" / "ckpts" / "ckpt_29999_rank0.pt"
    path.parent.mkdir(parents=True)
    torch.save({"step": 29999, "splats": cvtgs.to_dict(moved)}, path)
    return path


SIGNS = [(1, 1, 1), (1, -1, 1), (1, 1, -1), (1, -1, -1)]


@pytest.mark.parametrize("signs", SIGNS)
def test_normalization_is_one_of_four(signs):
    """Cameras and points that are tilted against all axes, so that no median is that of another."""
    tilt = Rotation.from_euler("xyz", [20, 35, -50], degrees=True).as_matrix()
    tilted = [(tilt @ rotation, tilt @ center + [3, -1, 2]) for rotation, center in poses()]
    viewmats = np.tile(np.eye(4), (len(tilted), 1, 1))
    for viewmat, (rotation, center) in zip(viewmats, tilted, strict=True):
        viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ center
    cameras = Cameras(
        viewmats=torch.from_numpy(viewmats),
        Ks=torch.eye(3, dtype=torch.float64).expand(len(tilted), 3, 3),
        width=64,
        height=48,
    )
    points = lopsided_ball().means.double().numpy() @ tilt.T + [3, -1, 2]
    matrix = gsplat_matrix(tilted, points, signs)
    gaps = [
        np.abs(matrix[:3] - np.column_stack([world.turn, world.shift])).max()
        for world in gsplat_worlds(cameras, points)
    ]
    assert sorted(gap < 1e-9 for gap in gaps) == [False, False, False, True]


@pytest.mark.parametrize(
    ("signs", "text"), [(signs, row % 2 == 1) for row, signs in enumerate(SIGNS)]
)
def test_a_world_normalized_by_gsplat_is_recognized(tmp_path, signs, text):
    normalized_dataset(tmp_path, signs=signs, text=text)
    assert score_of(capture_of(tmp_path, "room")) > 35


def test_a_world_left_unchanged_by_gsplat_is_recognized(tmp_path):
    """The checkpoint of a training with --no-normalize-world-space."""
    path = normalized_dataset(tmp_path, signs=(1, 1, 1))
    torch.save({"step": 29999, "splats": cvtgs.to_dict(lopsided_ball())}, path)
    assert score_of(capture_of(tmp_path, "room")) > 35


def test_a_normalized_model_of_another_scene_is_refused(tmp_path):
    """Any two such models overlap: both are centred and of about the same size."""
    path = normalized_dataset(tmp_path, signs=(1, 1, 1))
    other = cvtgs.load(path)
    rings = torch.nn.functional.normalize(other.means * torch.tensor([1.0, 1, 0])) + 0.2
    torch.save(
        {"step": 29999, "splats": cvtgs.to_dict(other.with_tensors({"means": rings}, {}))}, path
    )
    folder = tmp_path / "360_v2" / "room"
    text = refusal(capture_of(tmp_path, "room"))
    assert re.sub(r"0\.\d\d", "0.21", text, count=1) == (
        f"{path}: must be a model of {folder}, but the COLMAP points there are 0.21 of their "
        f"spread away from its Gaussians (at most 0.05); it is the model of another scene, or its "
        f"coordinates were transformed in an unknown way."
    )


@pytest.mark.parametrize("shift", [(40.0, 0.0, 0.0), (0.0, 0.0, 9.0)])
def test_a_model_of_another_scene_is_refused(tmp_path, shift):
    folder = colmap_dataset(ball(), tmp_path / "360_v2" / "garden")
    path = inria_model(move(ball(), Motion(shift=shift)), tmp_path / "models" / "garden")
    assert refusal(capture_of(tmp_path, "garden")) == (
        f"{path}: must be a model of {folder}, but its Gaussians are not where its cameras look; "
        f"it is the model of another scene, or of a world that was normalized for the training."
    )


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_truncated_points_are_refused(tmp_path, text):
    normalized_dataset(tmp_path, signs=(1, 1, 1), text=text)
    path = tmp_path / "360_v2" / "room" / "sparse" / "0" / f"points3D.{'txt' if text else 'bin'}"
    path.write_bytes(path.read_bytes()[:-40])
    assert refusal(capture_of(tmp_path, "room")) == (
        f"{path}: must be the points of a COLMAP model, found an invalid record."
    )


def test_a_model_without_visible_gaussians_is_refused(tmp_path):
    path = normalized_dataset(tmp_path, signs=(1, 1, 1))
    faint = lopsided_ball().with_tensors({"logit_opacities": torch.full((600,), -9.0)}, {})
    torch.save({"step": 29999, "splats": cvtgs.to_dict(faint)}, path)
    assert refusal(capture_of(tmp_path, "room")) == (
        f"{path}: must hold visible Gaussians, found none."
    )
