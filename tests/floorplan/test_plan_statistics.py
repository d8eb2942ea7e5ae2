"""The statistics of the plan comparison, on plans whose rooms and doors are known."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import shapely

from polyexplore_gym.floorplan import FloorPlan, generate

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "plan_statistics.py"


@pytest.fixture(scope="module")
def statistics():
    spec = importlib.util.spec_from_file_location("plan_statistics", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def plan_of(*boxes, name="plan"):
    polygon = shapely.union_all([shapely.box(*b) for b in boxes])
    return FloorPlan.create(
        np.array(polygon.exterior.coords), [np.array(r.coords) for r in polygon.interiors], name=name
    )


def test_one_room(statistics):
    result = statistics.measure(plan_of((0, 0, 5, 4)))
    assert result["area, m2"] == pytest.approx(20)
    assert (result["rooms"], result["doors"], result["loops of the room graph"]) == (1, 0, 0)
    assert result["walls per area, m/m2"] == pytest.approx(18 / 20)
    assert result["right angles, share"] == 1.0


@pytest.mark.parametrize("width", [0.8, 0.9, 1.2, 1.6])
def test_two_rooms_and_their_door(statistics, width):
    plan = plan_of((0, 0, 5, 4), (5.2, 0, 9, 4), (5, 1, 5.2, 1 + width))
    result = statistics.measure(plan)
    assert (result["rooms"], result["doors"]) == (2, 1)
    assert result["door width, m"] == pytest.approx(width, abs=0.11)
    assert result["dead ends per room"] == 1.0


def test_a_ring_of_four_rooms(statistics):
    rooms = [(0, 0, 4, 4), (4.2, 0, 8.2, 4), (0, 4.2, 4, 8.2), (4.2, 4.2, 8.2, 8.2)]
    doors = [(4, 1, 4.2, 2), (4, 6, 4.2, 7), (1, 4, 2, 4.2), (6, 4, 7, 4.2)]
    result = statistics.measure(plan_of(*rooms, *doors))
    assert (result["rooms"], result["doors"], result["loops of the room graph"]) == (4, 4, 1)
    assert result["dead ends per room"] == 0.0
    assert result["holes"] == 1


def test_a_corridor_with_rooms_is_no_chain(statistics):
    """A corridor counts as one room, however long, and each room behind its door as a dead end."""
    rooms = [(4.2 * k, 2.2, 4.2 * k + 4, 6) for k in range(4)]
    doors = [(4.2 * k + 1, 2, 4.2 * k + 1.9, 2.2) for k in range(4)]
    result = statistics.measure(plan_of((0, 0, 16.6, 2), *rooms, *doors))
    assert (result["rooms"], result["doors"]) == (5, 4)
    assert result["dead ends per room"] == pytest.approx(4 / 5)


def test_raster_has_the_plan_s_area(statistics):
    for family in ("home", "angled"):
        plan = generate(family, 1)
        free = statistics.raster(plan).sum() * statistics.RESOLUTION**2
        assert free == pytest.approx(plan.area, abs=1.0 * statistics.RESOLUTION * plan.polygon.length)


def test_table_has_a_row_for_each_statistic(statistics):
    row = statistics.measure(generate("home", 1))
    lines = statistics.table({"a": [row, row], "b": [row]}).splitlines()
    assert len(lines) == len(row) + 2
    assert all(line.count("|") == 4 for line in lines)
    assert "a (2)" in lines[0]
