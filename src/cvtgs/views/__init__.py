"""Cameras for scenes of which no cameras are known: automatic, random, and a mixture of both."""

from cvtgs.views.automatic import automatic_views
from cvtgs.views.mixed import mixed_views, random_views

__all__ = ["automatic_views", "mixed_views", "random_views"]
