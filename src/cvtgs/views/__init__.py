"""Cameras for scenes without known cameras: automatic, random, and a mixture of both."""

from cvtgs.views.automatic import automatic_views
from cvtgs.views.mixed import mixed_views, random_views
from cvtgs.views.own import OwnCameras, find_own_cameras
from cvtgs.views.positions import CameraPositions, find_view_positions

__all__ = [
    "CameraPositions",
    "OwnCameras",
    "automatic_views",
    "find_own_cameras",
    "find_view_positions",
    "mixed_views",
    "random_views",
]
