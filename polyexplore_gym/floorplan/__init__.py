"""Floor plans: the model and its validation, formats, generators and named suites."""

from polyexplore_gym.floorplan.formats import PLAN_SUFFIXES, load_plan, save_plan, to_geojson
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.suites import FAMILIES, Suite, generate, list_suites, suite

__all__ = [
    "FAMILIES",
    "PLAN_SUFFIXES",
    "FloorPlan",
    "Suite",
    "generate",
    "list_suites",
    "load_plan",
    "save_plan",
    "suite",
    "to_geojson",
]
