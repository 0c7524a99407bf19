"""Frames, voxels, areas by contributions, and parts of an analysis, by hand."""

import pytest
import torch

from cvtgs import SimplifyConfig
from cvtgs.analysis import analyze
from cvtgs.analysis.analyze import (
    HALF_GRID,
    add_depths,
    empty_depth_grid,
    frame_of,
    measure_contributions,
    measured_areas,
)
from cvtgs.math.frames import RobustFrame
from refine_cases import ring
from scenes import random_scene


def test_a_frame_is_that_of_the_gaussians_that_are_drawn():
    means = torch.tensor([[1.0, 0, 0], [3, 0, 0], [2, 0, 0], [9, 9, 9], [9, 9, 9], [9, 9, 9]])
    opacities = torch.tensor([0.5, 0.5, 0.5, 0.001, 0.001, 0.001])
    frame = frame_of(means, opacities)
    assert frame.center.tolist() == [2.0, 0.0, 0.0]
    assert frame.radius == 1.0
    assert frame_of(means, 0 * opacities).radius > 5.0  # no image shows any


def test_the_first_voxel_beyond_the_grid_is_none_of_it():
    """The distances 4.8 and 4.9 contract to 2.569 and 2.589, and the grid ends at 2.56."""
    frame = RobustFrame(center=torch.zeros(3).double(), radius=1.0)
    for axis in range(3):
        means = torch.zeros(2, 3)
        means[:, axis] = torch.tensor([4.8, 4.9])
        depths = empty_depth_grid(means.device)
        voxels = add_depths(depths, means, torch.ones(2).double(), frame)
        assert voxels.tolist() == [(2 * HALF_GRID) ** 3] * 2
        assert not depths[:-1].any()


def test_areas_are_blended_with_contributions_of_the_same_sum():
    found = measured_areas(
        torch.ones(2).double(),
        torch.tensor([0.5, 0.5]),
        torch.tensor([3.0, 1.0]).double(),
        share=0.25,
    )
    assert found.tolist() == pytest.approx([0.25 + 1.5 * 0.75, 0.25 + 0.5 * 0.75])


def test_a_part_of_an_analysis_has_the_contributions_of_its_rows():
    scene = random_scene(30, degree=0)
    values = {"preset": "matched", "visibility": {"size": 16, "stride": 1}}
    config = SimplifyConfig.from_mapping(values)
    whole = analyze(scene, config, with_visibility=True)
    whole = measure_contributions(scene, whole, config, cameras=ring(2))
    rows = torch.tensor([3, 17])
    part = whole.select(rows)
    assert part.observed is not None
    assert whole.observed is not None
    assert torch.equal(part.observed.contributions, whole.observed.contributions[rows])
    assert torch.equal(part.apparent_areas, whole.apparent_areas[rows])
    assert torch.equal(part.visibility, whole.visibility[rows])
