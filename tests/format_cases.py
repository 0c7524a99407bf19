"""Common parts of format tests: scenes, comparisons with oracles and within error bounds."""

import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import oracles
from cvtgs import CvtgsError, GaussianScene, load, load_cameras
from cvtgs.errors import FileFormatError
from cvtgs.tags import ANTIALIASED
from format_oracles import Splat
from scenes import moved, random_scene

DATA = Path(__file__).parent / "data" / "formats"
WRITABLE = ".compressed.ply, .ply, .spz, .splat, .sog, .spz.glb, .glb, .gltf or .usda"


def storable_scene(count: int, *, seed: int = 0, degree: int = 3) -> GaussianScene:
    """Return a scene whose values no format clamps."""
    scene = random_scene(count, seed=seed, degree=degree)
    tensors = {"sh0": scene.sh0.clamp(-1.7, 1.7), "shN": scene.shN.clamp(-0.9, 0.9)}
    return replace(scene.with_tensors(tensors, {}), comments=(ANTIALIASED.text,))


def with_extension(content: bytes, kind: int, payload: bytes) -> bytes:
    """Insert an extension into an SPZ file of version 4, before the table of its blocks."""
    start = struct.unpack_from("<I", content, 16)[0]
    record = struct.pack("<II", kind, len(payload)) + payload
    flags, place = bytes([content[14] | 2]), struct.pack("<I", start + len(record))
    head = content[:14] + flags + content[15:16] + place + content[20:start]
    return head + record + content[start:]


def refusal(path: Path) -> str | None:
    """Load a scene; return the text of the error if this fails."""
    try:
        assert len(load(path)) > 0
    except CvtgsError as error:
        return str(error)
    return None


def camera_refusal(path: Path, error: type[CvtgsError] = FileFormatError, **arguments: Any) -> str:
    """Return the error message about damaged cameras."""
    with pytest.raises(error) as caught:
        load_cameras(path, **arguments)
    assert type(caught.value) is error
    return str(caught.value)


def nearest_rows(scene: GaussianScene, other: GaussianScene) -> GaussianScene:
    """Return the rows of another scene in the order of this one, by the nearest centres."""
    rows = torch.cdist(scene.means.double(), other.means.double()).argmin(dim=1)
    assert len(rows.unique()) == len(scene) == len(other)
    return other.select(rows)


def assert_as_oracle(scene: GaussianScene, splats: list[Splat], tolerance: float = 2e-6) -> None:
    """Compare every number with that of an oracle, in the order of the file."""
    assert len(scene) == len(splats)
    wanted = {
        "means": [splat.mean for splat in splats],
        "log_scales": [splat.log_scale for splat in splats],
        "sh0": [[splat.sh0] for splat in splats],
        "shN": [splat.rest for splat in splats],
    }
    for name, values in wanted.items():
        tensor = getattr(scene, name)
        oracle = torch.tensor(values, dtype=torch.float64).reshape(tensor.shape)
        torch.testing.assert_close(tensor.double(), oracle, rtol=tolerance, atol=tolerance)
    opacities = torch.tensor([splat.opacity for splat in splats], dtype=torch.float64)
    torch.testing.assert_close(
        scene.opacities.double(), opacities.clamp(1e-6, 1 - 1e-6), rtol=0, atol=2e-6
    )
    assert scene.logit_opacities.isfinite().all()
    quats = torch.tensor([splat.quat for splat in splats], dtype=torch.float64)
    assert angles(scene.quats, quats).max() < math.radians(0.05)


def angles(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the angle between rotations, radians."""
    large = (q.double() / q.double().abs().amax(dim=1, keepdim=True) for q in (first, second))
    ours, theirs = (torch.nn.functional.normalize(q, dim=1) for q in large)
    sign = torch.where((ours * theirs).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return 4 * torch.asin(((ours - sign * theirs).norm(dim=1) / 2).clamp(max=1))


def half_turn(scene: GaussianScene) -> GaussianScene:
    """Turn a scene by pi about x with an oracle; Gaussians keep the axes of Niantic."""
    turned = moved(scene, quat=(0, 1, 0, 0))
    quats = [oracles.quaternion_product(quat, (0, -1, 0, 0)) for quat in turned.quats.tolist()]
    return turned.with_tensors({"quats": torch.tensor(quats)}, {})


def assert_within(scene: GaussianScene, other: GaussianScene, bounds: dict[str, float]) -> None:
    """Compare scenes row by row; bounds are absolute, opacities activated, angles in radians."""
    for name, bound in bounds.items():
        if name == "angle":
            error = angles(scene.quats, other.quats)
        elif name == "first_band":
            error = scene.shN[:, :3] - other.shN[:, :3]
        elif name == "higher_bands":
            error = scene.shN[:, 3:] - other.shN[:, 3:]
        else:
            error = getattr(scene, name) - getattr(other, name)
        worst = float(error.abs().max()) if error.numel() else 0.0
        assert worst <= bound, f"{name}: {worst} > {bound}"
