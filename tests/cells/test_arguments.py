"""Arguments that do not fit are errors of cvtgs."""

import pytest
import torch

from cvtgs import cells
from cvtgs.config import AllocationConfig
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import robust_frame
from scenes import random_scene

SCENE, ROWS, ONES, CONFIG = random_scene(6), torch.arange(6), torch.ones(6), AllocationConfig()
PARTITION = cells.Partition.from_labels(ROWS // 2, 3)
NEIGHBORS = torch.tensor([[1], [2], [0]])
MOMENTS = cells.gaussian_moments(
    SCENE, ROWS, robust_frame(SCENE.means), masses=ONES, apparent_masses=ONES
)


def described(**changes):
    given = {"cells": ROWS[:3], "neighbors": NEIGHBORS, "sizes": PARTITION.counts}
    given |= {"visibility": ONES, "pixel_size": 0.01}
    return cells.describe_cells(SCENE, SCENE[:3], PARTITION, **(given | changes))


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: cells.align_axes(SCENE, None, NEIGHBORS), "partition must be of type Partition, "
         "found NoneType."),
        (lambda: cells.inflate_cells(SCENE, PARTITION, ONES, everywhere=0.1, covered=0.4),
         "neighbors must be a tensor of signed integers of shape (m, k), found torch.float32 of "
         "shape (6,)."),
        (lambda: cells.gaussian_moments(SCENE, ROWS, None, masses=ONES, apparent_masses=ONES),
         "frame must be of type RobustFrame, found NoneType."),
        (lambda: cells.group_moments(MOMENTS, ONES, 6), "labels must be a tensor of signed "
         "integers of shape (n,), found torch.float32 of shape (6,)."),
        (lambda: cells.merge_pairs(None, NEIGHBORS, 2, CONFIG), "groups must be of type Moments, "
         "found NoneType."),
        (lambda: cells.merge_pairs(MOMENTS, ROWS[:, None], 0, CONFIG), "count must be a whole "
         "number between 1 and the 6 groups, found 0."),
        (lambda: cells.merge_pairs(MOMENTS, ROWS[:, None], 7, CONFIG), "6 groups, found 7."),
        (lambda: cells.reassign(MOMENTS, ROWS, MOMENTS, ROWS, CONFIG), "neighbors must be a tensor "
         "of signed integers of shape (m, k), found torch.int64 of shape (6,)."),
        (lambda: cells.view_components(SCENE, ROWS, ONES[:5]), "masses must be a tensor of floats "
         "of shape (6,), found torch.float32 of shape (5,)."),
        (lambda: described(neighbors=NEIGHBORS[:2]), "neighbors must be a tensor of signed "
         "integers of shape (3, k), found torch.int64 of shape (2, 1)."),
    ],
)  # fmt: skip
def test_wrong_arguments(call, text):
    assert len(described()) == 3
    with pytest.raises(InvalidArgumentError) as caught:
        call()
    assert str(caught.value).endswith(text)
