"""The examples, run as their users run them, on files like those of the other tools."""

import os
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import torch

import cvtgs
from test_io_checkpoints import splatfacto
from test_io_folders import inria_model

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *words: str | Path) -> None:
    subprocess.run(
        [sys.executable, str(EXAMPLES / name), *map(str, words)],
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )


def test_gsplat_checkpoint(tmp_path: Path) -> None:
    source, small = tmp_path / "ckpt_29999_rank0.pt", tmp_path / "small.pt"
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=2, seed=0)
    torch.save({"step": 29999, "splats": OrderedDict(cvtgs.to_dict(scene))}, source)
    run("gsplat_checkpoint.py", source, small, "--rho", "0.1")
    splats = torch.load(small, weights_only=True)["splats"]
    assert list(splats) == ["means", "quats", "scales", "opacities", "sh0", "shN"]
    assert {tensor.shape[0] for tensor in splats.values()} == {40}
    assert len(cvtgs.load(small)) == 40


def test_nerfstudio_run(tmp_path: Path) -> None:
    (tmp_path / "run" / "nerfstudio_models").mkdir(parents=True)
    scene = cvtgs.synthetic.scene("object", 400, sh_degree=1, seed=0)
    torch.save(splatfacto(scene), tmp_path / "run" / "nerfstudio_models" / "step-000029999.ckpt")
    run("nerfstudio_run.py", tmp_path / "run", tmp_path / "small.spz", "--rho", "0.1")
    assert len(cvtgs.load(tmp_path / "small.spz")) == 40


def test_inria_model(tmp_path: Path) -> None:
    model, small = inria_model(tmp_path / "model"), tmp_path / "small"
    run("inria_model.py", model, small, "--rho", "0.5")
    assert len(cvtgs.load(small)) == 15
    assert len(cvtgs.load_cameras(small)) == 12
    assert (small / "cfg_args").is_file()
