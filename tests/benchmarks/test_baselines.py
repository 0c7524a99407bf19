"""Baselines against their papers' descriptions: all of them, and those that prune."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import cvtgs
from baseline_cases import gaussians
from benchmarks.baselines import BASELINES, baseline, light_gaussian, pup_3dgs
from benchmarks.baselines.__main__ import main
from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError
from cvtgs.validity import invalid_rows
from render_cases import one_camera
from scenes import random_scene

pytestmark = pytest.mark.slow

COVERED = "opacity pruning", "mass pruning", "GHAP", "NanoGS"  # the others need images


@pytest.fixture(autouse=True)
def _few_small_views(monkeypatch):
    for module in (light_gaussian, pup_3dgs):
        monkeypatch.setattr(module, "VIEWS", 3)
        monkeypatch.setattr(module, "SIZE", 32)


def kept_places(small: cvtgs.GaussianScene) -> list[float]:
    return sorted(small.means[:, 0].tolist())


# Every baseline


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("count", [1, 37, 300])
def test_the_count_is_exact_and_all_are_valid_standard_gaussians(name, count):
    scene = replace(
        cvtgs.synthetic.scene("object", 300, sh_degree=1, seed=2),
        extras={"label": torch.arange(300)},
        comments=("SplatRenderMode: mip",),
    )
    means, logits = scene.means.clone(), scene.logit_opacities.clone()
    small = baseline(name)(scene, count)
    assert len(small) == count
    assert not invalid_rows(small)
    assert torch.isfinite(small.logit_opacities).all()
    assert small.antialiased
    assert (small.sh_degree, small.dtype, small.extras) == (1, torch.float32, {})
    norms = torch.linalg.vector_norm(small.quats, dim=1)
    assert torch.allclose(norms, torch.ones(count), atol=1e-5)
    assert torch.equal(scene.means, means)
    assert torch.equal(scene.logit_opacities, logits)


@pytest.mark.parametrize("name", BASELINES)
def test_the_same_seed_gives_the_same_bits(name):
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=3)
    first, second = (baseline(name)(scene, 20, seed=5) for _ in range(2))
    for field, values in first.tensors().items():
        assert torch.equal(values, getattr(second, field)), field


@pytest.mark.parametrize("name", BASELINES)
def test_invalid_rows_are_never_kept_and_bad_counts_are_refused(name):
    scene = cvtgs.synthetic.scene("object", 60, sh_degree=0, seed=4)
    scene.means[:20] = math.nan
    scene.logit_opacities[20:25] = math.inf
    assert not invalid_rows(baseline(name)(scene, 40))
    with pytest.raises(
        InvalidArgumentError, match="between 1 and the 40 valid Gaussians, found 41"
    ):
        baseline(name)(scene, 41)
    with pytest.raises(InvalidArgumentError, match="found 0"):
        baseline(name)(scene, 0)


@pytest.mark.parametrize("name", COVERED)
def test_coincident_and_flat_gaussians_do_no_harm(name):
    scene = random_scene(80, degree=0)
    scene.means[:50] = 0.5
    scene.log_scales[:, 2] = -40.0
    small = baseline(name)(scene, 9)
    assert len(small) == 9
    assert not invalid_rows(small)


def test_the_command_line_writes_what_the_function_gives(tmp_path):
    scene = cvtgs.synthetic.scene("object", 200, sh_degree=1, seed=0)
    cvtgs.save(scene, tmp_path / "full.ply")
    main(["GHAP", str(tmp_path / "full.ply"), str(tmp_path / "small.ply"), "--count", "11"])
    wanted = baseline("GHAP")(cvtgs.load(tmp_path / "full.ply"), 11)
    assert torch.equal(cvtgs.load(tmp_path / "small.ply").means, wanted.means)


# Pruning


def test_pruning_by_hand():
    """Opacity and mass rank differently: mass is 0.9, 2.0, 0.1 times pi."""
    scene = gaussians(
        [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], opacities=[0.9, 0.5, 0.95], scales=[1.0, 2.0, 0.3]
    )
    assert kept_places(baseline("opacity pruning")(scene, 2)) == [0.0, 2.0]
    assert kept_places(baseline("mass pruning")(scene, 2)) == [0.0, 1.0]


# LightGaussian


def test_volume_factor_by_hand():
    """Ten volumes from 1 to 10: the 90 % quantile is the tenth; of eleven, the eleventh is cut."""
    volumes = torch.arange(1.0, 11.0, dtype=torch.float64)
    logs = (volumes.log() / 3)[:, None].expand(-1, 3)
    assert torch.allclose(light_gaussian.volume_factor(logs), (volumes / 10) ** 0.1)
    with_floater = torch.cat([logs, logs.new_full((1, 3), 80.0)])
    assert torch.allclose(
        light_gaussian.volume_factor(with_floater), torch.cat([(volumes / 10) ** 0.1, volumes[:1]])
    )


@pytest.mark.parametrize("name", ["LightGaussian", "PUP 3D-GS"])
def test_gaussians_inside_an_opaque_ball_are_not_kept(name):
    """Forty small Gaussians inside, as opaque as the shell, and cheaper to find by opacity."""
    if name == "PUP 3D-GS":
        pytest.xfail("a closed shell is taken for a room, and some views look from inside")
    turn = torch.arange(300) * math.pi * (3 - math.sqrt(5))
    height = 1 - 2 * (torch.arange(300) + 0.5) / 300
    around = (1 - height**2).sqrt()
    shell = torch.stack([around * turn.cos(), height, around * turn.sin()], dim=1)
    scene = gaussians(
        [*shell.tolist(), *(0.3 * shell[:40]).tolist()],
        opacities=[0.99] * 300 + [0.995] * 40,
        scales=[0.15] * 300 + [0.1] * 40,
        dtype=torch.float32,
    )
    distances = torch.linalg.vector_norm(baseline(name)(scene, 100).means, dim=1)
    assert float(distances.amin()) > 0.9


# PUP 3D-GS


def pixels_by_differences(scene: cvtgs.GaussianScene, cameras: Cameras) -> np.ndarray:
    """Sum the outer products of every pixel's gradient, by central differences."""
    fields = [("means", axis) for axis in range(3)] + [("log_scales", axis) for axis in range(3)]
    result = np.zeros((len(scene), 6, 6))
    for row in range(len(scene)):
        columns = []
        for field, axis in fields:
            step = 1e-6
            images = []
            for sign in (1, -1):
                values = getattr(scene, field).clone()
                if field == "means":
                    values[row, axis] += sign * step
                else:
                    values[row, axis] = torch.log(values[row, axis].exp() + sign * step)
                changed = scene.with_tensors({field: values}, {})
                images.append(cvtgs.render(changed, cameras, backend="torch").rgb.flatten())
            columns.append(((images[0] - images[1]) / (2 * step)).numpy())
        result[row] = np.array(columns) @ np.array(columns).T
    return result


@pytest.fixture(scope="module")
def smooth() -> cvtgs.GaussianScene:
    """Wide Gaussians: their edges, where alpha is cut off, are outside of the image."""
    return gaussians(
        [[0.1, 0, 0], [-0.2, 0.2, 0.5]],
        opacities=[0.6, 0.7],
        scales=[[1.0, 1.2, 0.8], [0.9, 1.4, 1.1]],
        colors=[[0.3, -0.2, 0.5], [-0.4, 0.6, 0.1]],
    )


def test_one_probe_per_pixel_gives_the_exact_fisher_sum(smooth):
    cameras = one_camera(6, 4)
    probes = (torch.eye(72) * math.sqrt(72)).reshape(72, 4, 6, 3)
    found = pup_3dgs.projected_fisher(smooth, cameras, probes, backend="torch")
    wanted = pixels_by_differences(smooth, cameras)
    assert np.allclose(found.numpy(), wanted, rtol=1e-4, atol=1e-6 * np.abs(wanted).max())


def test_random_signs_estimate_the_sum_without_bias(smooth):
    """The mean of 600 probes is as close as their spread implies: about 6 %."""
    cameras = one_camera(6, 4)
    exact = pup_3dgs.projected_fisher(
        smooth,
        cameras,
        (torch.eye(72) * math.sqrt(72)).reshape(72, 4, 6, 3),
        backend="torch",
    )
    signs = pup_3dgs.random_signs((600, 4, 6, 3), torch.Generator().manual_seed(0))
    assert set(signs.unique().tolist()) == {-1.0, 1.0}
    found = pup_3dgs.projected_fisher(smooth, cameras, signs, backend="torch")
    for row in range(2):
        gap = torch.linalg.matrix_norm(found[row] - exact[row])
        assert float(gap / torch.linalg.matrix_norm(exact[row])) < 0.2


def test_sensitivity_is_the_log_determinant():
    g = torch.Generator().manual_seed(0)
    roots = torch.randn(4, 6, 9, generator=g, dtype=torch.float64)
    fisher = roots @ roots.transpose(1, 2)
    wanted = [math.log(np.linalg.det(matrix)) for matrix in fisher.numpy()]
    assert pup_3dgs.sensitivity(fisher).tolist() == pytest.approx(wanted)
    tiny = pup_3dgs.sensitivity(fisher * 1e-60)
    assert tiny.tolist() == pytest.approx([value - 360 * math.log(10) for value in wanted])
    assert pup_3dgs.sensitivity(torch.zeros(1, 6, 6, dtype=torch.float64)).tolist() == [-math.inf]


def test_torch_starts_after_its_settings():
    code = "import benchmarks.baselines.__main__, sys; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
