"""Which way is up, where both usual directions are at right angles to the ground's."""

import pytest
import torch

from cvtgs.views.up import Voxels, find_up


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_ground_across_x_gives_a_unit_vector(sense):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(500, 3, generator=generator, dtype=torch.float64) - 0.5
    points[:, 0] = 0.01 * points[:, 0]
    normals = torch.tensor([[sense, 0.0, 0.0]], dtype=torch.float64).repeat(500, 1)
    up = find_up(Voxels(points=points, normals=normals, log_sizes=points[:, 0]), points[:0])
    assert up.tolist() == [1.0, 0.0, 0.0]
