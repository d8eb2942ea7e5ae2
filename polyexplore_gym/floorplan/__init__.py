"""Floor plans: the model and its validation, formats, generators and named suites."""

from polyexplore_gym.floorplan.formats import load_plan, save_plan, to_geojson
from polyexplore_gym.floorplan.model import FloorPlan

__all__ = ["FloorPlan", "load_plan", "save_plan", "to_geojson"]
