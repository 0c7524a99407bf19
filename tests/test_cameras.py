"""Cameras: what cannot be a camera is refused."""

import pytest
import torch

from cvtgs.cameras import Cameras
from cvtgs.errors import InvalidArgumentError

GOOD = {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 4, "height": 3}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"viewmats": torch.eye(3)[None]},
            "viewmats must be floats of shape (1, 4, 4), found torch.float32 of shape (1, 3, 3).",
        ),
        (
            {"Ks": torch.ones(1, 3, 3, dtype=torch.int64)},
            "Ks must be floats of shape (1, 3, 3), found torch.int64 of shape (1, 3, 3).",
        ),
        (
            {"Ks": torch.eye(3).double()[None]},
            "viewmats and Ks must share device and dtype, found torch.float32 on cpu and "
            "torch.float64 on cpu.",
        ),
        ({"width": 0}, "width and height must be at least 1 pixel, found 0 x 3."),
        ({"names": ("a", "b")}, "names must hold one name per camera, 1; found 2."),
    ],
)
def test_what_is_no_camera(changes, text):
    with pytest.raises(InvalidArgumentError) as caught:
        Cameras(**GOOD | changes)
    assert str(caught.value) == text
