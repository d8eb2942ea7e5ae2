"""benchmarks/exact.py against shapely's sight lines on random places and points."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely

from polyexplore_gym.config import EnvConfig, SensorConfig
from polyexplore_gym.env import PolyExploreEnv
from polyexplore_gym.evaluation.policy import load_policy
from polyexplore_gym.floorplan import FloorPlan, generate

PATH = Path(__file__).resolve().parents[1] / "benchmarks" / "exact.py"
WIDE = SensorConfig(max_range=6.0, field_of_view=2.0 * math.pi, beams=360)
NARROW = SensorConfig(max_range=3.0, field_of_view=math.radians(120.0), beams=121)


@pytest.fixture(scope="module")
def exact():
    spec = importlib.util.spec_from_file_location("exact_check", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


def two_rooms() -> FloorPlan:
    """Two rooms of 4 x 4 m side by side, joined by a door of 1 m in a wall of 0.2 m."""
    polygon = shapely.union_all([shapely.box(0, 0, 4, 4), shapely.box(4.2, 0, 8.2, 4), shapely.box(4, 1.5, 4.2, 2.5)])
    return FloorPlan.create(np.array(polygon.exterior.coords), name="two rooms")


def seen_by(plan: FloorPlan, pose: np.ndarray, points: np.ndarray, sensor: SensorConfig) -> np.ndarray:
    """(k,) bool: sight lines within range and field of view, one by one."""
    sights = shapely.linestrings(np.stack((np.broadcast_to(pose[:2], points.shape), points), axis=1))
    bearing = np.arctan2(*(points - pose[:2]).T[::-1]) - (pose[2] if len(pose) > 2 else 0.0)
    off = np.abs(np.remainder(bearing + math.pi, 2 * math.pi) - math.pi)
    half = 0.5 * sensor.field_of_view if len(pose) > 2 else math.pi
    return shapely.covers(plan.polygon, sights) & (shapely.length(sights) <= sensor.max_range) & (off <= half)


@pytest.mark.parametrize("seed", range(6))
def test_a_view_holds_what_sight_lines_reach(exact, seed):
    rng = np.random.default_rng(seed)
    plan, sensor = generate(("home", "angled", "office")[seed % 3], seed), (WIDE, NARROW)[seed % 2]
    pose = plan.sample_start(rng, 0.2)
    x0, y0, x1, y1 = plan.bounds
    points = rng.uniform((x0, y0), (x1, y1), (1500, 2))
    expected = seen_by(plan, pose, points, sensor)
    for outer in (False, True):
        area = exact.view(plan.segments, pose, sensor.max_range, sensor.field_of_view, 0.005, outer=outer)
        found = shapely.contains_xy(area, points)
        close = shapely.distance(area.boundary, shapely.points(points)) < 0.006
        np.testing.assert_array_equal(found[~close], expected[~close])
        assert area.is_valid
        assert expected.any()


def test_the_room_behind_the_door_is_left(exact):
    plan = two_rooms()
    found = exact.left_over(plan, np.array([[0.5, 0.5, 0.0], [0.5, 3.5, 0.0]]), WIDE, 0.25)
    assert not found.complete
    assert found.place[0] > 3.5
    # From inside the other room all of it is seen, but for what the scans saw through the door.
    hidden = shapely.intersection(found.unseen, shapely.box(4.0, 0, 8.2, 4)).area
    assert 0.9 * hidden < found.area <= hidden + 1e-6
    assert found.area == pytest.approx(found.shown.area)
    assert found.drivable > 0.95 * found.area


def test_a_room_without_a_door_for_the_disc_is_not_left(exact):
    plan = two_rooms()
    polygon = shapely.union_all([plan.polygon, shapely.box(8.2, 1.9, 8.4, 2.1), shapely.box(8.4, 1, 9.4, 3)])
    plan = FloorPlan.create(np.array(polygon.exterior.coords), name="slit")
    scans = np.array([[2.0, 2.0, 0.0], [6.2, 2.0, 0.0], [7.7, 0.5, 0.0], [7.7, 3.5, 0.0], [4.6, 0.5, 0], [4.6, 3.5, 0]])
    found = exact.left_over(plan, scans, WIDE, 0.25)
    # Through the slit a little can be seen from the side; nobody can drive there.
    assert found.drivable < 0.05
    assert found.unseen.area > 0.5


def test_worst_place_against_many_places(exact):
    plan = generate("home", 3)
    env = PolyExploreEnv(plan=plan, config={"sensor": {"max_range": 4.0}, "drive": {"mode": "kinematic"}})
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    found, base = exact.check(env), env.unwrapped
    area = exact.reachable(plan, base.true_pose, 0.25)
    x0, y0, x1, y1 = area.bounds
    points = rng.uniform(plan.bounds[:2], plan.bounds[2:], (2000, 2))
    cell = (plan.bounds[2] - plan.bounds[0]) * (plan.bounds[3] - plan.bounds[1]) / len(points)
    left = shapely.contains_xy(found.unseen, points)
    seen = np.zeros(len(points), bool)
    for pose in base.snapshot().measured_at:
        seen |= seen_by(plan, pose, points, base.config.sensor)
    assert np.mean(left != (~seen & shapely.contains_xy(plan.polygon, points))) < 0.002
    most = 0.0
    for place in rng.uniform((x0, y0), (x1, y1), (400, 2)):
        if shapely.contains_xy(area, *place):
            most = max(most, cell * seen_by(plan, place, points[left], base.config.sensor).sum())
    assert not found.complete
    assert found.area > 0.9 * most


def test_an_explored_plan_is_complete_also_between_beams(exact):
    env = PolyExploreEnv(plan=two_rooms(), config=EnvConfig(sensor=SensorConfig(field_of_view=2 * math.pi)))
    outcome, decisions, _ = exact.play(env, load_policy("nearest"), 0)
    assert outcome == "ended"
    assert decisions > 0
    for sampled in (False, True):
        found = exact.check(env, sampled=sampled)
        assert found.complete
        assert found.share > 0.97


def test_between_beams_far_apart_nothing_is_seen(exact):
    sparse = SensorConfig(beams=16, field_of_view=2 * math.pi)
    scans = np.array([[2.0, 2.0, 0.0], [4.1, 2.0, 0.0], [6.2, 2.0, 0.0]])
    assert exact.reach_of(sparse, 0.25, sampled=True) == pytest.approx(0.5 / (math.pi / 8))
    assert exact.left_over(two_rooms(), scans, sparse, 0.25).complete
    found = exact.left_over(two_rooms(), scans, sparse, 0.25, sampled=True)
    assert not found.complete
    assert found.area > found.limit
    discs = shapely.union_all([shapely.Point(*p[:2]).buffer(0.5 / (math.pi / 8)) for p in scans])
    assert found.unseen.area >= shapely.difference(two_rooms().polygon, discs).area - 0.1
