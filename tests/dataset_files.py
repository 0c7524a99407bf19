"""Small datasets of posed photographs and their models, in the layout of each trainer."""

import math
from pathlib import Path

import pytest
import torch
from PIL import Image

import cvtgs
from benchmarks.datasets import Capture, find_captures, read_test_views
from benchmarks.quality import PhotographJudge
from benchmarks.worlds import place_cameras
from camera_files import NAMES, colmap_txt, transforms, write_json
from cvtgs.cameras import Cameras
from cvtgs.errors import CvtgsError
from cvtgs.evaluation.scorer import Metrics

HALF = (32, 24)
"""Size of the photographs in pixels; the cameras have twice this size."""


def ball() -> cvtgs.GaussianScene:
    """Return Gaussians around the point that the cameras look at."""
    g = torch.Generator().manual_seed(0)
    made = cvtgs.synthetic.scene("object", 600, sh_degree=0, seed=0)
    return made.with_tensors(
        {
            "means": 0.5 * torch.randn(600, 3, generator=g),
            "log_scales": torch.full((600, 3), math.log(0.08)),
        },
        {},
    )


def shoot(scene: cvtgs.GaussianScene, cameras: Cameras, folder: Path, *, alpha: bool = False):
    """Write a photograph for every camera, named by the last part of the camera name."""
    cameras = cameras.resized(*HALF)
    images = cvtgs.render(scene, cameras)
    folder.mkdir(parents=True, exist_ok=True)
    for name, rgb, opacity in zip(cameras.names, images.rgb, images.alpha, strict=True):
        colors = rgb / opacity.clamp_min(1e-3)[..., None] if alpha else rgb
        pixels = torch.cat([colors, opacity[..., None]], dim=2) if alpha else colors
        values = (pixels.clamp(0, 1) * 255).round().byte().numpy()
        path = folder / Path(name).with_suffix(".png").name
        Image.fromarray(values).save(path)


def colmap_dataset(scene: cvtgs.GaussianScene, folder: Path, images: str = "images_4") -> Path:
    colmap_txt(folder / "sparse" / "0", names=[Path(NAMES[row]).name for row in range(9, -1, -1)])
    shoot(scene, cvtgs.load_cameras(folder), folder / images)
    return folder


def nerf_dataset(scene: cvtgs.GaussianScene, folder: Path) -> Path:
    """Write transparent photographs and the split of NeRF-Synthetic."""
    for split, rows in (("train", range(2, 10)), ("test", range(2))):
        told = transforms(rows)
        for row, frame in zip(rows, told["frames"], strict=True):
            frame["file_path"] = f"./{split}/r_{row}"
        write_json(folder / f"transforms_{split}.json", told)
        cameras = cvtgs.load_cameras(folder / f"transforms_{split}.json")
        shoot(scene, cameras, folder / split, alpha=True)
    return folder


def inria_model(scene: cvtgs.GaussianScene, folder: Path) -> Path:
    for step in (7000, 30000):
        path = folder / "point_cloud" / f"iteration_{step}" / "point_cloud.ply"
        path.parent.mkdir(parents=True)
        cvtgs.save(scene, path)
    return path


def gsplat_model(scene: cvtgs.GaussianScene, folder: Path) -> Path:
    path = folder / "ply" / "point_cloud_29999.ply"
    path.parent.mkdir(parents=True)
    cvtgs.save(scene, path)
    return path


TURN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SHIFT, SCALE = torch.tensor([0.5, -0.25, 1.0]), 0.4


def nerfstudio_model(scene: cvtgs.GaussianScene, folder: Path) -> Path:
    """Write a turned, moved and scaled scene, and the file with the transform."""
    moved = scene.with_tensors(
        {
            "means": (scene.means @ TURN.T + SHIFT) * SCALE,
            "log_scales": scene.log_scales + math.log(SCALE),
        },
        {},
    )
    folder.mkdir(parents=True)
    cvtgs.save(moved, folder / "splat.ply")
    transform = torch.cat([TURN, SHIFT[:, None]], dim=1).tolist()
    write_json(folder / "dataparser_transforms.json", {"transform": transform, "scale": SCALE})
    return folder / "splat.ply"


def capture_of(root: Path, name: str) -> Capture:
    return next(one for one in find_captures(root).captures if one.name == name)


def score_of(capture: Capture) -> float:
    full = cvtgs.load(capture.model.path)
    views = read_test_views(capture)
    cameras = place_cameras(capture, full, views.cameras)
    judge = PhotographJudge(cameras, views.photographs, capture.dataset.background, Metrics())
    return judge.score(full).psnr


def refusal(capture: Capture) -> str:
    with pytest.raises((SystemExit, CvtgsError)) as caught:
        score_of(capture)
    text = str(caught.value)
    assert "\n" not in text
    return text
