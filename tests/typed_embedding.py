"""A program that embeds cvtgs, as a type checker in strict mode sees it; test_typing.py checks it.

``assert_type`` pins the types that callers get. Only ``main`` is run, on a small scene.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import assert_type

import torch
from torch import Tensor

import cvtgs
from cvtgs.cvt import Tessellation
from cvtgs.evaluation import Evaluation, EvaluationSettings
from cvtgs.mergenet import MergeNet, PublishedMergeNet, load_checkpoint
from cvtgs.refinement import Refined
from cvtgs.report import Level


class Bar:
    """A listener with state."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def __call__(self, event: cvtgs.ProgressEvent) -> None:
        assert_type(event.done, int)
        self.stages.append(event.stage)


def make_small(scene: cvtgs.GaussianScene, listener: cvtgs.ProgressListener) -> cvtgs.Simplified:
    config = cvtgs.SimplifyConfig.from_mapping({"preset": "fast", "cvt": {"iterations": 2}})
    assert_type(config, cvtgs.SimplifyConfig)
    assert_type(config.cvt.iterations, int)
    simplifier = cvtgs.Simplifier(config=config, device="cpu", listener=listener)
    assert_type(simplifier.simplify(scene, count=10), cvtgs.GaussianScene)
    assert_type(simplifier.levels(scene, [0.5, 0.1]), tuple[Level, ...])
    return simplifier.run(scene, rho=0.1)


def look(scene: cvtgs.GaussianScene, small: cvtgs.GaussianScene) -> float:
    cameras = cvtgs.views.automatic_views(scene, 2, width=48, height=32)
    assert_type(cameras, cvtgs.Cameras)
    rendering = cvtgs.render(small, cameras, backend="torch", depth=True)
    assert_type(rendering, cvtgs.Rendering)
    assert_type(rendering.depth, Tensor | None)
    settings = EvaluationSettings(lpips="off", backend="torch")
    scores = cvtgs.evaluate(scene, {"small": small}, cameras, settings=settings)
    assert_type(scores, Evaluation)
    return scores.scenes[0].psnr.mean


def use_stages(scene: cvtgs.GaussianScene) -> cvtgs.GaussianScene:
    config = cvtgs.SimplifyConfig()
    cells = cvtgs.cvt.tessellate(scene.means, scene.masses, 10, config=config.cvt)
    assert_type(cells, Tessellation)
    partition = cvtgs.cells.Partition.from_labels(cells.labels, 10)
    return cvtgs.cells.merge_cells(scene, partition, config=config.merge)


def exchange_gsplat(splats: torch.nn.ParameterDict, path: Path) -> bytes:
    scene = cvtgs.from_dict(splats)
    assert_type(scene.with_tensors(sh0=scene.sh0 * 0.5), cvtgs.GaussianScene)
    stream = io.BytesIO()
    cvtgs.save(scene, stream, format=".ply")
    with path.open("wb") as file:
        scene.save(file)
    with path.open("rb") as file:
        assert_type(cvtgs.load(file), cvtgs.GaussianScene)
    assert_type(cvtgs.Simplifier(None).simplify(path, max_count=5), cvtgs.GaussianScene)
    return stream.getvalue()


def exchange(splats: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    scene = cvtgs.from_dict(splats)
    path = folder / "scene.ply"
    cvtgs.save(scene, path, overwrite=True)
    again = cvtgs.load(path)
    assert_type(again.extras, Mapping[str, Tensor])
    assert_type(again.sh_degree, int)
    assert_type(load_checkpoint("standard").net, MergeNet | PublishedMergeNet)
    return cvtgs.to_dict(again)


def polish(small: cvtgs.GaussianScene, full: cvtgs.GaussianScene) -> float:
    refined = cvtgs.refine(small, full, steps=1)
    assert_type(refined, Refined)
    return refined.report.gain


def main(folder: Path) -> int:
    """Run the calls that take no more than a second."""
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=1, seed=0)
    bar = Bar()
    small, report = make_small(scene, bar)
    assert_type(small, cvtgs.GaussianScene)
    assert_type(report, cvtgs.SimplifyReport)
    assert_type(report.energy, float)
    try:
        cvtgs.Simplifier(None).simplify(scene, 2.0)
    except cvtgs.errors.InvalidArgumentError as error:
        assert_type(str(error), str)
    look(scene, small)
    exchange(cvtgs.to_dict(use_stages(scene)), folder)
    parameters = {name: torch.nn.Parameter(one) for name, one in cvtgs.to_dict(scene).items()}
    exchange_gsplat(torch.nn.ParameterDict(parameters), folder / "splats.ply")
    with torch.no_grad():
        assert_type(small.opacities, Tensor)
    return len(small) + len(bar.stages)
