"""The cut of Spark's tree, where node and the package are installed (``NODE_PATH``)."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

import cvtgs
from benchmarks import baselines

FOLDERS = os.environ.get("NODE_PATH", "").split(os.pathsep)
PACKAGE = any((Path(folder) / "@sparkjsdev" / "spark").is_dir() for folder in FOLDERS if folder)
SCRIPT = Path(baselines.__file__).parent / "spark_lod.mjs"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (PACKAGE and shutil.which("node")),
        reason="needs node, and @sparkjsdev/spark in a folder of NODE_PATH",
    ),
]


@pytest.mark.parametrize("mode", ["bhatt", "tiny"])
@pytest.mark.parametrize("degree", [0, 3])
def test_a_full_cut_equals_the_scene_and_a_small_one_resembles_it(tmp_path, mode, degree):
    scene = cvtgs.synthetic.scene("object", 800, sh_degree=degree, seed=0)
    cvtgs.save(scene, tmp_path / "full.ply")

    def cut(count: int) -> cvtgs.GaussianScene:
        out = tmp_path / f"{count}.ply"
        command = ["node", SCRIPT, mode, tmp_path / "full.ply", out, str(count)]
        subprocess.run(command, check=True, capture_output=True)
        return cvtgs.load(out)

    whole, tenth = cut(len(scene)), cut(80)
    assert len(whole) == len(scene)
    order, wanted = whole.means[:, 0].argsort(), scene.means[:, 0].argsort()
    torch.testing.assert_close(whole.means[order], scene.means[wanted])
    torch.testing.assert_close(whole.sh0[order], scene.sh0[wanted], atol=0.01, rtol=0.01)
    torch.testing.assert_close(
        whole.log_scales[order], scene.log_scales[wanted], atol=0.01, rtol=0.01
    )
    assert 70 <= len(tenth) <= 80
    cameras = cvtgs.views.automatic_views(scene, 2, width=48, height=36)
    found = cvtgs.evaluate(scene, {"whole": whole, "tenth": tenth}, cameras)
    assert found.scenes[0].psnr.mean > 35
    assert 15 < found.scenes[1].psnr.mean < found.scenes[0].psnr.mean
