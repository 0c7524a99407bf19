"""Random views: where they stand and look in a room."""

import pytest
import torch

from cvtgs.errors import InvalidArgumentError
from cvtgs.synthetic import scene
from cvtgs.views import find_view_positions, random_views


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_random_views_of_a_room_stand_all_over_it_and_half_of_them_look_about_level(
    seed: int,
) -> None:
    """Only a corner or two of it are farther than 1.1 radii from its middle."""
    positions = find_view_positions(scene("room", 20_000, sh_degree=0, seed=seed))
    layout = positions.layout
    assert layout.room is not None
    cameras = random_views(positions, 64, size=32, seed=0)
    places = (cameras.centers / (0.11 * layout.frame.radius)).round()
    assert len(torch.unique(places, dim=0)) > 40
    rises = (cameras.viewmats[:, 2, :3] @ layout.up).abs()
    assert float(rises[::2].amax()) < 0.5 < float(rises[1::2].amax())
    with pytest.raises(InvalidArgumentError, match="reach must be two ascending numbers"):
        random_views(positions, 2, size=32, seed=0, reach=(3.0, 1.0))
