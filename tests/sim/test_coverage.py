import math

import numpy as np
import pytest
import shapely
from sim_scenes import boxed, lines_of, random_walls

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim.coverage import Coverage, grid_points


def exactly_seen(walls: np.ndarray, points: np.ndarray, pose: np.ndarray, sensor: SensorConfig) -> np.ndarray:
    """Within range and field of view, and the sight line meets no wall: by shapely."""
    offset = points - pose[:2]
    bearing = np.remainder(np.arctan2(offset[:, 1], offset[:, 0]) - pose[2] + math.pi, 2 * math.pi) - math.pi
    inside = (np.hypot(*offset.T) <= sensor.max_range) & (np.abs(bearing) <= sensor.field_of_view / 2)
    sights = shapely.linestrings(np.stack([np.broadcast_to(pose[:2], points.shape), points], axis=1))
    return inside & ~shapely.intersects(sights, lines_of(walls))


@pytest.mark.parametrize("part", range(5))
def test_agrees_with_shapely_on_random_scenes(part: int) -> None:
    rng = np.random.default_rng(100 + part)
    for scene in range(30):
        walls = random_walls(rng, int(rng.integers(1, 60)))
        if scene % 2:
            walls = boxed(walls, 8.0)
        fov = (math.pi, 2 * math.pi, 0.4, 4.5)[scene % 4]
        sensor = SensorConfig(field_of_view=fov, max_range=rng.uniform(2, 9))
        points = rng.uniform(-9, 9, (400, 2))
        coverage, expected = Coverage(points), np.zeros(400, dtype=bool)
        for _ in range(4):
            pose = rng.uniform(-6, 6, 3)
            expected |= exactly_seen(walls, points, pose, sensor)
            before = coverage.share
            new = coverage.add(walls, pose, sensor)
            assert coverage.share == pytest.approx(before + new / 400)
            np.testing.assert_array_equal(coverage.seen, expected)
        assert coverage.share == pytest.approx(expected.mean())


def test_all_of_a_convex_room_and_nothing_behind_its_walls() -> None:
    room = boxed(np.empty((0, 4)), 3.0)
    inside = np.stack(np.meshgrid(np.arange(-2.9, 3, 0.2), np.arange(-2.9, 3, 0.2)), -1).reshape(-1, 2)
    outside = inside + np.array([6.1, 0.0])
    coverage = Coverage(np.vstack([inside, outside]))
    sensor = SensorConfig(field_of_view=2 * math.pi, max_range=20.0)
    assert coverage.add(room, np.array([0.3, -0.4, 1.0]), sensor) == len(inside)
    assert coverage.add(room, np.array([0.3, -0.4, 1.0]), sensor) == 0
    assert coverage.share == 0.5


def test_point_on_a_wall_counts_and_one_behind_its_end_does_not() -> None:
    wall = np.array([[2.0, -1.0, 2.0, 1.0]])
    points = np.array([[2.0, 0.3], [2.1, 0.3], [4.0, 0.0], [4.0, 2.0], [4.0, 2.001], [0.0, 0.0]])
    coverage = Coverage(points)
    coverage.add(wall, np.zeros(3), SensorConfig())
    np.testing.assert_array_equal(coverage.seen, [True, False, False, False, True, True])


def test_wall_seen_edge_on_hides_only_what_is_right_behind_it() -> None:
    coverage = Coverage(np.array([[1.0, 0.0], [4.0, 0.0], [4.0, 0.01], [-3.0, 0.0]]))
    coverage.add(np.array([[2.0, 0.0, 3.0, 0.0]]), np.zeros(3), SensorConfig(field_of_view=2 * math.pi))
    np.testing.assert_array_equal(coverage.seen, [True, False, True, True])


def test_bad_input_is_refused() -> None:
    for points in (np.empty((0, 2)), np.zeros((3, 3)), np.array([[0.0, np.nan]]), np.array([[0.0, 0.0], [1e9, 1e9]])):
        with pytest.raises(InvalidMotionError, match="sample points"):
            Coverage(points)
    with pytest.raises(InvalidMotionError, match="sensor pose"):
        Coverage(np.zeros((1, 2))).add(np.zeros((0, 4)), np.array([0, 0, np.nan]), SensorConfig())


def test_grid_points_fill_the_free_area() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        angle = np.sort(rng.uniform(0, 2 * math.pi, 12))
        ring = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(3, 6, (12, 1))
        hole = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
        polygon = shapely.Polygon(ring, [hole])
        if not polygon.is_valid:
            continue
        walls = np.concatenate([np.hstack([r, np.roll(r, -1, axis=0)]) for r in (ring, hole)])
        points = grid_points(walls, 0.21)
        assert shapely.contains_xy(polygon, points[:, 0], points[:, 1]).all()
        assert len(points) * 0.21**2 == pytest.approx(polygon.area, rel=0.1)
