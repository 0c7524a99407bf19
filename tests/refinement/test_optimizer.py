"""The units and results of the optimizer of a scene, by hand."""

import math

import pytest
import torch

from cvtgs.config import Rates
from cvtgs.refinement import optimize
from scenes import random_scene, same_bits


def test_a_gaussian_that_left_its_range_stays_as_it_was() -> None:
    scene = random_scene(4, degree=0)
    optimizer = optimize.SceneOptimizer(scene, Rates(), learning_rate_scale=torch.ones(4))
    vars(optimizer)["_changes"].data[0] = math.inf
    vars(optimizer)["_moved"][:] = True
    assert same_bits(optimizer.result()[:1], scene[:1])


def test_a_thin_axis_counts_as_a_tenth_of_the_mean_one() -> None:
    scales = torch.tensor([[1.0, 1.0, 0.001], [1.0, 1.0, 0.1]])
    scene = random_scene(2, degree=0).with_tensors({"log_scales": scales.log()}, {})
    units = vars(optimize)["_units"](scene, torch.ones(2))["means"]
    assert units[:, 2].tolist() == pytest.approx([0.0667, 0.1], rel=1e-3)
