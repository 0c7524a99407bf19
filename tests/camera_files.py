"""A rig of ten cameras and its files in every format, written without cvtgs."""

import json
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIZE = (64, 48)
FX, FY, CX, CY = 55.0, 50.0, 32.0, 24.0
POINT = np.array([0.3, -0.2, 0.4])
NAMES = tuple(f"images/frame_{row:02}.jpg" for row in range(10))
MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4}
MODELS |= {"OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}


def _center(row: int) -> np.ndarray:
    return np.array([4 * np.cos(row), 4 * np.sin(row), row / 4 - 1])


CENTERS = np.array([_center(row) for row in range(len(NAMES))])


def pose(row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation from camera (right, down, forward) to world and the centre; z is up."""
    center = _center(row)
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1), center


def poses() -> list[tuple[np.ndarray, np.ndarray]]:
    return [pose(row) for row in range(len(NAMES))]


def expected_pixels() -> np.ndarray:
    """Return pixels by similar triangles: offsets right and down per unit of depth."""
    pixels = []
    for rotation, center in poses():
        right, down, forward = (axis @ (POINT - center) for axis in rotation.T)
        pixels.append([CX + FX * right / forward, CY + FY * down / forward])
    return np.array(pixels)


def write_json(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def transforms(rows: Iterable[int] = range(10)) -> dict[str, Any]:
    """Return the content of transforms.json, with OpenGL axes: right, up, backward."""
    frames = []
    for row in rows:
        rotation, center = pose(row)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]], axis=1)
        matrix[:3, 3] = center
        frames.append({"file_path": NAMES[row], "transform_matrix": matrix.tolist()})
    return {"w": 64, "h": 48, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "frames": frames}


def inria() -> list[dict[str, Any]]:
    return [
        {
            "id": row,
            "img_name": NAMES[row],
            "width": 64,
            "height": 48,
            "position": center.tolist(),
            "rotation": rotation.tolist(),
            "fx": FX,
            "fy": FY,
        }
        for row, (rotation, center) in enumerate(poses())
    ]


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """Return the eigenvector of Bar-Itzhack's matrix for the eigenvalue 1; w comes first."""
    m = matrix
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
        [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
        [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


def _world_to_camera(row: int) -> tuple[np.ndarray, np.ndarray]:
    rotation, center = pose(row)
    return _quaternion(rotation.T), -rotation.T @ center


def colmap_txt(
    folder: Path,
    *,
    rows: Sequence[int] = range(9, -1, -1),
    names: Sequence[str] | None = None,
    points: str = "",
    scale: float = 1.0,
    model: str = "PINHOLE",
    parameters: Sequence[float] = (FX, FY, CX, CY),
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    numbers = " ".join(map(str, parameters))
    cameras = f"# Camera list\n# Number of cameras: 1\n7 {model} 64 48 {numbers}\n"
    (folder / "cameras.txt").write_text(cameras)
    lines = ["# Image list", "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for at, row in enumerate(rows):
        quat, shift = _world_to_camera(row)
        name = names[at] if names else NAMES[row]
        values = " ".join(f"{value:.17g}" for value in [*(scale * quat), *shift])
        lines += [f"{row + 1} {values} 7 {name}", points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def colmap_bin(
    folder: Path,
    *,
    rows: Sequence[int] = range(9, -1, -1),
    names: Sequence[str] | None = None,
    points: int = 2,
    model: str = "PINHOLE",
    parameters: Sequence[float] = (FX, FY, CX, CY),
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    camera = struct.pack("<QiiQQ", 1, 7, MODELS[model], 64, 48)
    camera += struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(camera)
    data = struct.pack("<Q", len(rows))
    for at, row in enumerate(rows):
        quat, shift = _world_to_camera(row)
        name = names[at] if names else NAMES[row]
        data += struct.pack("<i7di", row + 1, *quat, *shift, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", points) + struct.pack("<ddq", 1.5, 2.5, -1) * points
    (folder / "images.bin").write_bytes(data)
