"""The camera of a visitor of the page of ``cvtgs view``, by hand."""

import math
from unittest.mock import MagicMock

import torch

from cvtgs.synthetic import scene as make
from cvtgs.viewer import camera_of
from cvtgs.viewer.server import look_at


def test_a_turned_camera_sees_what_is_ahead_of_it_in_the_middle() -> None:
    """A quarter turn about y: forward, z of the camera, is x of the world, and right is -z."""
    camera = camera_of((0.5**0.5, 0, 0.5**0.5, 0), (1, 2, 3), fov=0.8, aspect=1.5)
    points = torch.tensor([[6.0, 2, 3, 1], [6.0, 2, 2, 1]], dtype=torch.float64)
    found = points @ camera.viewmats[0].T
    wanted = torch.tensor([[0.0, 0, 5, 1], [1.0, 0, 5, 1]], dtype=torch.float64)
    torch.testing.assert_close(found, wanted)
    torch.testing.assert_close(camera.centers, points.new_tensor([[1.0, 2, 3]]))


def test_the_first_view_ignores_invalid_rows() -> None:
    scene = make("object", 500, sh_degree=0, seed=0)
    means = scene.means.clone()
    means[7] = torch.nan
    server = MagicMock()
    place = look_at(server, scene.with_tensors(means=means))
    assert all(map(math.isfinite, [*place, *server.initial_camera.look_at]))
