"""An outline as a floor plan that can be saved, loaded and explored."""

from __future__ import annotations

from collections.abc import Sequence

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.mapping import Beams, LineMap, walls_of
from polyexplore_gym.outline.tracing import Outline, trace
from polyexplore_gym.outline.views import views_of


def floor_plan(outline: Outline, name: str) -> FloorPlan:
    """The floor plan of an outline; `meta` says what of its walls is unknown, and how much was left out.

    Raises:
        InvalidFloorPlanError: there are too many vertices, or the plan is too large.
    """
    meta = {
        "unknown": outline.unknown.round(4).tolist(),
        "unknown_length": round(outline.unknown_length, 4),
        "unknown_share": round(outline.unknown_share, 6),
        "left_out": round(outline.left_out, 4),
    }
    return FloorPlan.create(outline.exterior, outline.holes, name=name, meta=meta)


def explored(beams: Sequence[Beams], lines: LineMap, sensor: SensorConfig, name: str) -> FloorPlan:
    """The floor plan of an exploration, of its scans (`Explorer.beams`) and its line map.

    Raises:
        InvalidFloorPlanError: what was seen is no floor.
    """
    views = views_of(beams, sensor.max_range)
    return floor_plan(trace(views, walls_of(lines, beams, sensor), sensor, door=lines.door), name)
