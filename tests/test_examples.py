"""The examples, run as users run them, on files like those of other tools."""

import os
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

import cvtgs
from tests.io.test_checkpoints import splatfacto
from tests.io.test_files import inria_model

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *words: object) -> str:
    """Run an example in a separate process and return its output."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *map(str, words)],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    return done.stdout


def scene_file(path: Path, count: int = 400) -> Path:
    cvtgs.save(cvtgs.synthetic.scene("object", count, sh_degree=1, seed=0), path)
    return path


@pytest.mark.long
def test_gsplat_checkpoint(tmp_path: Path) -> None:
    source, small = tmp_path / "ckpt_29999_rank0.pt", tmp_path / "small.pt"
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=2, seed=0)
    torch.save({"step": 29999, "splats": OrderedDict(cvtgs.to_dict(scene))}, source)
    run("gsplat_checkpoint.py", source, small, "--rho", "0.1")
    splats = torch.load(small, weights_only=True)["splats"]
    assert list(splats) == ["means", "quats", "scales", "opacities", "sh0", "shN"]
    assert {tensor.shape[0] for tensor in splats.values()} == {40}
    assert len(cvtgs.load(small)) == 40


@pytest.mark.long
def test_nerfstudio_run(tmp_path: Path) -> None:
    (tmp_path / "run" / "nerfstudio_models").mkdir(parents=True)
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=1, seed=0)
    torch.save(splatfacto(scene), tmp_path / "run" / "nerfstudio_models" / "step-000029999.ckpt")
    run("nerfstudio_run.py", tmp_path / "run", tmp_path / "small.spz", "--rho", "0.1")
    assert len(cvtgs.load(tmp_path / "small.spz")) == 40


@pytest.mark.long
def test_inria_model(tmp_path: Path) -> None:
    model, small = inria_model(tmp_path / "model"), tmp_path / "small"
    run("inria_model.py", model, small, "--rho", "0.5")
    assert len(cvtgs.load(small)) == 15
    assert len(cvtgs.load_cameras(small)) == 12
    assert (small / "cfg_args").is_file()


def test_inria_model_needs_a_folder(tmp_path: Path) -> None:
    with pytest.raises(subprocess.CalledProcessError) as caught:
        run("inria_model.py", scene_file(tmp_path / "scene.ply", 20), tmp_path / "small")
    assert f"model must be a folder; found {tmp_path / 'scene.ply'}." in caught.value.stderr


@pytest.mark.slow
def test_simplify(tmp_path: Path) -> None:
    source, small = scene_file(tmp_path / "scene.ply"), tmp_path / "small.ply"
    printed = run("simplify.py", source, small, "--rho", 0.1, "--preset", "fast")
    assert len(cvtgs.load(small)) == 40
    assert "400 -> 40 Gaussians" in printed
    assert "tessellate is done" in printed


@pytest.mark.long
def test_compare(tmp_path: Path) -> None:
    source, page = scene_file(tmp_path / "scene.ply"), tmp_path / "page"
    words = ("--rho", 0.1, "--presets", "draft,fast", "--size", 64)
    printed = run("compare.py", source, page, *words)
    assert (page / "index.html").is_file()
    assert [line.split()[0] for line in printed.splitlines()] == ["draft", "fast"]


@pytest.mark.slow
def test_custom_cells_keeps_labels_apart(tmp_path: Path) -> None:
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=0, seed=0)
    label = (scene.means[:, 0] > scene.means[:, 0].median()).to(torch.int32)
    scene = scene.with_tensors({}, {"label": label, "share": label.to(torch.float32)})
    source, small = tmp_path / "scene.ply", tmp_path / "small.ply"
    cvtgs.save(scene, source)
    run("custom_cells.py", source, small, "--rho", 0.1)
    merged = cvtgs.load(small)
    assert len(merged) == 40
    assert set(merged.extras["label"].tolist()) == {0, 1}
    # Means of 0 and 1 within a cell would lie between them.
    assert merged.extras["share"].tolist() == pytest.approx(merged.extras["label"].tolist())


@pytest.mark.slow
def test_custom_cells_needs_a_column(tmp_path: Path) -> None:
    source = scene_file(tmp_path / "scene.ply")
    with pytest.raises(subprocess.CalledProcessError) as failed:
        run("custom_cells.py", source, tmp_path / "small.ply")
    assert "must have an extra column of labels, found none\n" in failed.value.stderr


@pytest.mark.long
def test_train_tiny(tmp_path: Path) -> None:
    checkpoint = tmp_path / "tiny.safetensors"
    printed = run("train_tiny.py", checkpoint, "--steps", 2, "--count", 300)
    assert checkpoint.is_file()
    assert "300 -> 30 Gaussians" in printed


@pytest.mark.long
def test_gsplat_loop() -> None:
    printed = run("gsplat_loop.py", "--count", 500, "--steps", 11, "--size", 48)
    losses = [float(line.split()[-1]) for line in printed.splitlines()]
    assert len(losses) == 2
    assert losses[-1] < losses[0]


@pytest.mark.slow
def test_levels(tmp_path: Path) -> None:
    source, folder = scene_file(tmp_path / "scene.ply"), tmp_path / "levels"
    run("levels.py", source, folder, "--rho", "0.25,0.05", "--suffix", ".spz")
    assert len(cvtgs.load(folder / "level0.spz")) == 100
    assert len(cvtgs.load(folder / "level1.spz")) == 20


@pytest.mark.long
def test_tradeoff(tmp_path: Path) -> None:
    source, page = scene_file(tmp_path / "scene.ply"), tmp_path / "page"
    words = ("--rho", 0.1, "--presets", "draft,fast", "--size", 64)
    printed = run("tradeoff.py", source, page, *words)
    assert (page / "index.html").is_file()
    assert [line.split()[0] for line in printed.splitlines()] == ["draft", "fast"]


@pytest.mark.slow
def test_every_example_is_tested_and_short() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f'run("{path.name}"' in text
        assert path.read_text(encoding="utf-8").count("\n") < 60
