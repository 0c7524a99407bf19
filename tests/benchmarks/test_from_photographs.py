"""A model from photographs: pictures are written as NeRF's, and training learns from them."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

import cvtgs
from benchmarks import from_photographs
from benchmarks.from_photographs import first_scene, fit, looked_at, read_split, take_pictures
from benchmarks.quality import PhotographJudge, Quality
from camera_files import NAMES, transforms
from cvtgs.evaluation.scorer import Metrics

SIZE = 48


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset")
    take_pictures(folder, views=16, size=SIZE, seed=0)
    return folder


@pytest.mark.long
def test_pictures_are_laid_out_as_nerf_s_with_an_eighth_for_testing(dataset):
    train, test = (read_split(dataset, split, SIZE) for split in ("train", "test"))
    assert (len(train[0]), len(test[0])) == (14, 2)
    assert tuple(test[1].shape) == (2, SIZE, SIZE, 3)
    told = json.loads((dataset / "transforms_test.json").read_text())
    assert sorted(told) == ["camera_angle_x", "frames"]
    with Image.open(dataset / "test" / "r_0.png") as picture:
        pixels = torch.from_numpy(np.asarray(picture, dtype=np.float32)) / 255
    over_white = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    torch.testing.assert_close(test[1][0], over_white, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_cameras_and_pictures_belong_together(dataset):
    """The generated scene, seen by the cameras of the files, matches its pictures."""
    cameras, photographs = read_split(dataset, "test", SIZE)
    scene = cvtgs.synthetic.scene("object", 60_000, sh_degree=1, seed=0)
    judge = PhotographJudge(cameras, photographs, (1.0, 1.0, 1.0), Metrics())
    assert judge.score(scene).psnr > 40


def test_the_region_that_cameras_look_at_by_hand(tmp_path):
    """Ten cameras about 4 from the origin that all look at it, 64 pixels wide at a focal 55."""
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(transforms()))
    cameras = cvtgs.load_cameras(path)
    assert len(cameras) == len(NAMES)
    middle, radius = looked_at(cameras)
    torch.testing.assert_close(middle, torch.zeros(3), rtol=0, atol=1e-5)
    distance = float(cameras.centers.norm(dim=1).median())
    assert radius == pytest.approx(0.4 * distance * 64 / 55, rel=1e-5)


def test_the_first_scene_has_touching_balls(dataset):
    cameras, _ = read_split(dataset, "train", SIZE)
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    scene = first_scene(cameras, 4, points=points, seed=0)
    row = int((scene.means.abs().sum(dim=1) == 0).nonzero()[0, 0])
    assert float(scene.scales[row, 0]) == pytest.approx(1.0, rel=1e-5)
    others = [math.sqrt((1 + 2 + 2) / 3)] * 3
    assert sorted(scene.scales[:, 1].tolist())[1:] == pytest.approx(others, rel=1e-5)
    drawn = first_scene(cameras, 50, points=None, seed=0)
    middle, radius = looked_at(cameras)
    assert float((drawn.means - middle).abs().amax()) <= radius
    assert len(drawn) == 50


@pytest.mark.long
def test_training_learns_what_test_pictures_show(dataset):
    train, test = (read_split(dataset, split, SIZE) for split in ("train", "test"))
    first = first_scene(train[0], 400, points=None, seed=0)
    heard = []
    scene = fit(first, *train, steps=200, seed=0, say=heard.append)
    judge = PhotographJudge(*test, (1.0, 1.0, 1.0), Metrics())
    assert judge.score(scene).psnr > judge.score(first).psnr + 4
    assert [line.split(":")[0] for line in heard] == ["step 200 of 200"]
    assert len(scene) == len(first)
    again = fit(first, *train, steps=3, seed=0)
    same = fit(first, *train, steps=3, seed=0)
    assert torch.equal(again.means, same.means)


def test_the_table_shows_the_loss_of_quality():
    rows = {"trained": Quality(psnr=25.0, ssim=0.9), "small": Quality(psnr=22.5, ssim=0.8)}
    lines = from_photographs.table(rows).splitlines()
    assert lines[2] == "| trained | 25.00 | 0.9000 | - | +0.00 |"
    assert lines[3] == "| small | 22.50 | 0.8000 | - | -2.50 |"


@pytest.mark.slow
def test_what_an_earlier_run_made_is_used_and_named(dataset, tmp_path, monkeypatch, capsys):
    """Rows of --points with NaN are left out of the first scene."""
    scene = cvtgs.synthetic.scene("object", 60, sh_degree=0, seed=0)
    scene.means[5] = math.nan
    cvtgs.save(scene, tmp_path / "points.ply")
    monkeypatch.setattr(from_photographs, "METHODS", ())
    shutil.copytree(dataset, tmp_path / "out" / "dataset")
    words = ["-o", str(tmp_path / "out"), "--steps", "1", "--points", str(tmp_path / "points.ply")]
    from_photographs.main(words)
    printed = capsys.readouterr()
    assert "| trained, 59 Gaussians |" in printed.out
    assert "dataset: is used as it is, whatever --views and --seed are." in printed.err
    assert "point_cloud.ply: is not trained again" not in printed.err
    from_photographs.main(words)
    assert "point_cloud.ply: is not trained again" in capsys.readouterr().err


def test_a_folder_without_a_split_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(SystemExit, match=r"must hold transforms_train\.json, found none\."):
        from_photographs.main([str(tmp_path), "-o", str(tmp_path / "out")])


@pytest.mark.slow
def test_end_to_end_with_a_single_training(dataset, tmp_path, monkeypatch, capsys):
    words = [str(dataset), "-o", str(tmp_path), "--count", "300", "--steps", "60", "--rho", "0.1"]
    from_photographs.main(words)
    text = capsys.readouterr().out
    assert (tmp_path / "from_photographs.md").read_text().strip() == text.strip()
    assert "2 held-out pictures of 48 x 48; 14 for training, 60 steps" in text
    names = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("|")]
    assert names[2:] == [
        "trained, 300 Gaussians",
        *(f"{name} at 0.1" for name in from_photographs.METHODS),
    ]
    monkeypatch.setattr(from_photographs, "fit", None)
    from_photographs.main(words)
    assert capsys.readouterr().out == text
