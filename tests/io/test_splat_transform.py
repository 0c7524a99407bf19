"""Files that cvtgs writes, read by PlayCanvas' splat-transform, and the other way around."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cvtgs import GaussianScene, Simplifier, load, save
from cvtgs.math.parameters import build_covariances, normalize_quats
from cvtgs.streams import plan_stream, write_sog_stream
from format_cases import storable_scene

COMMAND = shutil.which("splat-transform")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        COMMAND is None,
        reason="needs splat-transform 3 on the PATH: npm install -g @playcanvas/splat-transform",
    ),
]
THEY_READ = (".ply", ".compressed.ply", ".spz", ".splat", ".sog")
THEY_WRITE = (".ply", ".compressed.ply", ".spz", ".sog", ".glb")
NAMES = ("means", "turns", "scales", "opacities", "sh0", "shN")
STEPS = {
    ".ply": (0.0, 1e-5, 0.0, 0.0, 0.0, 0.0),
    ".glb": (0.0, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6),
    ".compressed.ply": (5e-3, 0.1, 0.02, 4e-3, 0.02, 0.04),
    ".spz": (3e-4, 0.1, 0.04, 4e-3, 0.014, 0.13),
    ".sog": (1e-3, 0.15, 0.1, 4e-3, 0.03, 1.0),
}
"""Largest differences to the scene that was encoded; scales as a share. The palette of a SOG has
few entries for few Gaussians, and those of the test are random."""


def convert(source: Path, target: Path, *options: str) -> Path:
    words = [str(COMMAND), "-q", "-w", "-g", "cpu", str(source), *options, str(target)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


def differences(found: GaussianScene, wanted: GaussianScene) -> dict[str, float]:
    """Return the largest differences of Gaussians; each is compared with the nearest one."""
    assert (len(found), found.sh_degree) == (len(wanted), wanted.sh_degree)
    rows = torch.cdist(wanted.means.double(), found.means.double()).argmin(dim=1)
    assert len(set(rows.tolist())) == len(wanted)
    same = found.select(rows)
    pairs = {
        "means": (same.means, wanted.means),
        "scales": (same.log_scales, wanted.log_scales),
        "opacities": (same.opacities, wanted.opacities),
        "sh0": (same.sh0, wanted.sh0),
        "shN": (same.shN, wanted.shN),
    }
    found_differences = {
        name: float((a - b).abs().max()) if a.numel() else 0.0 for name, (a, b) in pairs.items()
    }
    return {
        **found_differences,
        "turns": float((ellipsoids(same) - ellipsoids(wanted)).abs().max()),
    }


def ellipsoids(scene: GaussianScene) -> torch.Tensor:
    """Return what quaternions turn to: half a turn about an own axis is no difference."""
    axes = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).expand(len(scene), 3)
    return build_covariances(axes, normalize_quats(scene.quats.double()))


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", THEY_READ)
def test_splat_transform_reads_our_files(suffix: str, degree: int, tmp_path: Path) -> None:
    scene = storable_scene(300, degree=degree)
    if suffix == ".splat":
        scene = replace(scene.with_sh_degree(0), comments=())
    save(scene, tmp_path / f"a{suffix}")
    theirs = load(convert(tmp_path / f"a{suffix}", tmp_path / "b.ply"))
    worst = differences(theirs, load(tmp_path / f"a{suffix}"))
    rotations = worst.pop("turns")
    assert max(worst.values()) < 2e-5
    assert rotations < (0.15 if suffix == ".splat" else 1e-4)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", THEY_WRITE)
def test_our_readers_read_files_of_splat_transform(
    suffix: str, degree: int, tmp_path: Path
) -> None:
    scene = storable_scene(300, degree=degree)
    save(scene, tmp_path / "a.ply")
    path = convert(tmp_path / "a.ply", tmp_path / f"b{suffix}")
    ours = load(path)
    worst = differences(ours, scene)
    steps = dict(zip(NAMES, STEPS[suffix], strict=True))
    assert {name: value for name, value in worst.items() if value > steps[name]} == {}
    if suffix != ".glb":  # which they do not read
        worst = differences(ours, load(convert(path, tmp_path / "c.ply")))
        assert max(worst.values()) < 2e-5


def test_splat_transform_reads_the_finest_level_of_our_streams(tmp_path: Path) -> None:
    levels = Simplifier(preset="draft", device="cpu").levels(
        storable_scene(600, degree=1), [1.0, 0.25, 0.05]
    )
    write_sog_stream(plan_stream(levels, chunk_gaussians=100), tmp_path / "out")
    theirs = load(convert(tmp_path / "out" / "lod-meta.json", tmp_path / "b.ply"))
    worst = differences(theirs, load(tmp_path / "out"))
    assert max(worst.values()) < 1e-4
