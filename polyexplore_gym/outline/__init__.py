"""From what scans saw, and the lines of the map, to a floor plan: `explored`, or `views_of`, `trace`, `floor_plan`."""

from polyexplore_gym.outline.plan import explored, floor_plan
from polyexplore_gym.outline.tracing import Outline, trace
from polyexplore_gym.outline.views import Views, views_of

__all__ = ["Outline", "Views", "explored", "floor_plan", "trace", "views_of"]
