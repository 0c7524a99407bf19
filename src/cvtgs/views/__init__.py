"""From where to look at a scene of which nothing is known."""

from cvtgs.views.anywhere import views_from_anywhere
from cvtgs.views.automatic import automatic_views
from cvtgs.views.mixed import mixed_views

__all__ = ["automatic_views", "mixed_views", "views_from_anywhere"]
