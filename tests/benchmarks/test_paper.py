"""The evaluation against photographs, on small generated datasets in every layout."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import cvtgs
from benchmarks import paper
from benchmarks.datasets import DATASETS, find_captures, read_test_views
from benchmarks.measuring import digest_of
from benchmarks.quality import Quality
from dataset_files import (
    HALF,
    ball,
    capture_of,
    colmap_dataset,
    gsplat_model,
    inria_model,
    nerf_dataset,
    nerfstudio_model,
    refusal,
    score_of,
)


@pytest.fixture(scope="module")
def scene() -> cvtgs.GaussianScene:
    return ball()


@pytest.fixture
def root(tmp_path, scene) -> Path:
    """One scene of each dataset, each with a model of another layout."""
    root = tmp_path / "datasets"
    nerf_dataset(scene, root / "nerf_synthetic" / "lego")
    colmap_dataset(scene, root / "360_v2" / "garden")
    colmap_dataset(scene, root / "tandt" / "truck", "images")
    colmap_dataset(scene, root / "db" / "playroom", "images")
    nerfstudio_model(scene, root / "exports" / "lego")
    inria_model(scene, root / "models" / "garden")
    gsplat_model(scene, root / "results" / "truck")
    inria_model(scene, root / "db" / "playroom" / "output")
    return root


def test_every_layout_is_found_and_matches_its_photographs(root):
    found = find_captures(root)
    assert [(one.dataset.name, one.name, one.model.layout) for one in found.captures] == [
        ("NeRF-Synthetic", "lego", "nerfstudio"),
        ("Mip-NeRF 360", "garden", "INRIA"),
        ("Tanks and Temples", "truck", "gsplat"),
        ("Deep Blending", "playroom", "INRIA"),
    ]
    assert "iteration_30000" in str(found.captures[1].model.path)
    for capture in found.captures:
        assert score_of(capture) > 35, capture.name


def test_the_split_is_the_published_one(root):
    assert read_test_views(capture_of(root, "garden")).cameras.names == (
        "frame_00.jpg",
        "frame_08.jpg",
    )
    views = read_test_views(capture_of(root, "lego"))
    assert [Path(name).name for name in views.cameras.names] == ["r_0", "r_1"]


def test_the_published_folder_of_photographs_sets_the_size(root):
    garden = capture_of(root, "garden")
    views = read_test_views(garden)
    assert views.folder.name == "images_4"
    assert (views.cameras.width, views.cameras.height) == HALF
    assert tuple(views.photographs.shape) == (2, 24, 32, 3)
    (garden.folder / "images_4").rename(garden.folder / "images_8")
    assert read_test_views(garden).folder.name == "images_8"


def test_pictures_of_nerf_have_a_white_background(root):
    photographs = read_test_views(capture_of(root, "lego")).photographs
    assert photographs[:, 0, 0].tolist() == [[1.0] * 3] * 2


def test_each_missing_part_is_noted_in_one_sentence(root):
    for path in (root / "db" / "playroom" / "output", root / "tandt"):
        path.rename(path.with_name("gone"))
    (root / "gone" / "truck").rename(root / "gone" / "lorry")
    notes = find_captures(root).notes
    playroom = root / "db" / "playroom"
    inside = playroom / "gone"
    inside.rename(root / "elsewhere")
    notes = find_captures(root).notes
    source = DATASETS[2].source
    assert (
        f"Tanks and Temples: none of its scenes were found in {root}; get it from {source}."
        in notes
    )
    assert (
        f"playroom: {playroom} has cameras, but no trained model of INRIA's code, nerfstudio or "
        f"gsplat is in it or in another folder named playroom." in notes
    )
    assert f"chair: this scene of NeRF-Synthetic was not found in {root}." in notes
    assert all("\n" not in note and note.endswith(".") for note in notes)


def test_a_dataset_without_a_test_split_is_refused(root):
    lego = capture_of(root, "lego")
    (lego.folder / "transforms_test.json").unlink()
    assert refusal(lego) == (
        f"{lego.folder / 'transforms_test.json'}: the file to read must exist, found none."
    )


def test_a_camera_without_a_photograph_is_refused(root):
    garden = capture_of(root, "garden")
    photograph = garden.folder / "images_4" / "frame_08.png"
    photograph.rename(photograph.with_name("another.png"))
    assert refusal(garden) == (
        f"{garden.folder / 'images_4'}: must hold a photograph of every camera; "
        f"1 of 2 cameras have none, the first is 'frame_08.jpg'."
    )


def test_photographs_of_another_shape_are_refused(root):
    garden = capture_of(root, "garden")
    for path in (garden.folder / "images_4").iterdir():
        Image.fromarray(np.zeros((24, 40, 3), np.uint8)).save(path)
    assert refusal(garden) == (
        f"{garden.folder / 'images_4' / 'frame_00.png'}: photographs must have the aspect ratio "
        f"of the cameras' images, 64 x 48, found 40 x 24."
    )


def test_a_missing_and_an_empty_folder_are_refused(tmp_path):
    with pytest.raises(SystemExit, match="must be a folder of datasets, found none"):
        find_captures(tmp_path / "none")
    with pytest.raises(SystemExit, match="no scene with a trained model was found in it"):
        paper.main([str(tmp_path), "-o", str(tmp_path / "out")])


def test_gains_are_shown_beside_the_published_ones():
    def result(psnr: float):
        found = Quality(psnr=psnr, ssim=0.5)
        return paper.Result(quality=found, wall_seconds=1, cpu_seconds=1, count=1, wanted=1)

    table = {
        "a": {"paper": {0.1: result(25.0)}, "paper, no network": {0.1: result(23.0)}},
        "b": {"paper": {0.1: result(27.0)}, "paper, no network": {0.1: result(26.0)}},
        "c": {"paper": {0.1: result(27.0)}, "paper, no network": {0.1: None}},
    }
    lines = paper.gains_table(table, [0.1, 0.05]).splitlines()
    assert lines[2] == "| network over merged Gaussians | 0.1 | +1.50 | 2 | +1.90 |"
    assert lines[3] == "| network over merged Gaussians | 0.05 | - | 0 | - |"
    assert lines[4] == "| CVT-GS over NanoGS | 0.1 | - | 0 | +1.57 |"
    assert lines[-1].startswith("Published: B. Li et al. 2026, CVT-GS")


def test_results_of_two_networks_of_lpips_are_not_mixed(tmp_path):
    paper.keep_network(tmp_path / "lpips.txt", "vgg")
    paper.keep_network(tmp_path / "lpips.txt", "vgg")
    with pytest.raises(SystemExit) as caught:
        paper.keep_network(tmp_path / "lpips.txt", "alex")
    assert str(caught.value) == (
        f"{tmp_path}: its results were scored with LPIPS vgg, but this run would use alex; "
        f"choose the network with --lpips, or use another folder."
    )


def test_results_of_a_replaced_model_are_dropped(root):
    capture = capture_of(root, "garden")
    found = Quality(psnr=20.0, ssim=0.5)
    common = {"quality": found, "wall_seconds": 1, "cpu_seconds": 1, "count": 1, "wanted": 1}
    known = paper.Result(**common, source=digest_of(capture.model.path))
    table = {"Mip-NeRF 360: garden": {"paper": {0.1: known}}, "elsewhere": {"paper": {0.1: known}}}
    assert paper.of_present_models(table, [capture]) == table
    cvtgs.save(ball()[:100], capture.model.path, overwrite=True)
    without = table | {"Mip-NeRF 360: garden": {"paper": {}}}
    assert paper.of_present_models(table, [capture]) == without


@pytest.mark.long
def test_end_to_end_with_an_interruption(root, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    colmap_dataset(cvtgs.load(capture_of(root, "garden").model.path), root / "360_v2" / "room")
    arguments = [str(root), "-o", str(out), "--rho", "0.1", "--lpips", "off"]
    arguments += ["--methods", "paper, no network", "mass pruning"]
    runs, attempt = [], paper.attempt

    def counted(command, task, *, keep):
        if len(runs) == 5:
            raise KeyboardInterrupt
        runs.append(task.output.name)
        return attempt(command, task, keep=keep)

    monkeypatch.setattr(paper, "attempt", counted)
    with pytest.raises(KeyboardInterrupt):
        paper.main(arguments)
    first, runs[:] = list(runs), []
    paper.main(arguments)
    assert len(first) == 5
    assert len(runs) == 3
    assert not set(first) & set(runs)
    runs.clear()
    paper.main(arguments)
    assert runs == []
    page = (out / "paper.md").read_text()
    assert capsys.readouterr().out.strip().endswith(page.strip())
    assert "## NeRF-Synthetic: 1 of 8 scenes" in page
    assert "- room: " in page
    records = json.loads((out / "results.json").read_text())
    psnrs = {(one["scene"], one["method"]): one["result"]["quality"]["psnr"] for one in records}
    assert len(psnrs) == 4 * 3
    for name in ("Mip-NeRF 360: garden", "Deep Blending: playroom"):
        full = psnrs[name, "full scene"]
        assert full > 35
        assert all(15 < psnrs[name, one] < full for one in ("paper, no network", "mass pruning"))
