"""An outline as a floor plan that can be saved, loaded and explored."""

from __future__ import annotations

from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.outline.tracing import Outline


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
