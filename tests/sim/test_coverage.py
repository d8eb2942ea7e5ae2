import math
from fractions import Fraction

import numpy as np
import pytest
import shapely
import shapely.affinity
from sim_scenes import boxed, lines_of, random_walls

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.sim.coverage import MOST_POINTS, Coverage, grid_points, grid_spacing, side

pytestmark = pytest.mark.bounds


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
    for points in (np.empty((0, 2)), np.zeros((3, 3)), np.array([[0.0, np.nan]])):
        with pytest.raises(InvalidMotionError, match="sample points"):
            Coverage(points)
    with pytest.raises(InvalidMotionError, match="sensor pose"):
        Coverage(np.zeros((1, 2))).add(np.zeros((0, 4)), np.array([0, 0, np.nan]), SensorConfig())


def test_points_far_apart_and_in_a_line_need_no_more_memory_than_others() -> None:
    room = boxed(np.empty((0, 4)), 2e9)
    for points in (
        np.array([[0.0, 0.0], [1e9, 1e9]]),
        np.linspace([-1.0, 3.0], [1.0, 3.0], 1000),
        np.array([[1.0, 2.0]]),
        np.vstack([np.zeros((500, 2)), np.full((500, 2), 1e6)]),
    ):
        coverage = Coverage(points)
        assert len(coverage._starts) < len(points) / 8 + 3
        coverage.add(room, np.array([0.5, 0.25, 0.0]), SensorConfig(field_of_view=2 * math.pi, max_range=3.0))
        np.testing.assert_array_equal(coverage.seen, np.hypot(*(points - [0.5, 0.25]).T) <= 3.0)


# The grid ------------------------------------------------------------------------------------------


def lattice_plan(rng: np.random.Generator, unit: float) -> shapely.Polygon | None:
    """A polygon with holes whose vertices are whole multiples of `unit`: cells and triangles glued together."""
    nx, ny = rng.integers(2, 9, 2)
    x, y = rng.integers(0, 9, (2, 40, 3))
    shapes = [shapely.Polygon(np.stack([a, b], 1)) for a, b in zip(x, y, strict=True)]
    cells = [shapely.box(i, j, i + 1, j + 1) for i in range(nx) for j in range(ny) if rng.random() < 0.6]
    some = [s for s in shapes if s.area > 0][: int(rng.integers(0, 4))]
    found = shapely.set_precision(shapely.union_all([*cells, *some]), 1.0)
    parts = [p for p in shapely.get_parts(found) if p.area > 0] if found is not None else []
    if not parts:
        return None
    best = max(parts, key=lambda p: p.area)
    rings = [shapely.get_coordinates(r)[:-1] * unit for r in (best.exterior, *best.interiors)]
    polygon = shapely.Polygon(rings[0], rings[1:])
    return polygon if polygon.is_valid else None


def walls_of(polygon: shapely.Polygon) -> np.ndarray:
    rings = [shapely.get_coordinates(r)[:-1] for r in (polygon.exterior, *polygon.interiors)]
    return np.concatenate([np.hstack([r, np.roll(r, -1, axis=0)]) for r in rings])


def grid_over(polygon: shapely.Polygon, spacing: float) -> np.ndarray:
    """The grid over the polygon's bounds."""
    x0, y0, x1, y1 = polygon.bounds
    x = x0 + (np.arange(math.ceil((x1 - x0) / spacing)) + 0.5) * spacing
    y = y0 + (np.arange(math.ceil((y1 - y0) / spacing)) + 0.5) * spacing
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def grid_within(polygon: shapely.Polygon, spacing: float) -> np.ndarray:
    """Its points within by shapely, whose predicates are exact and which leaves the border out."""
    points = grid_over(polygon, spacing)
    return points[shapely.contains_xy(polygon, points)]


def check_grids(rng: np.random.Generator, number: int) -> None:
    checked = on_wall = 0
    while checked < number:
        spacing = (0.2, 0.25, 1 / 3, 1.0)[checked % 4]
        # Vertices on rows and columns of the grid, on all or on some of them.
        polygon = lattice_plan(rng, spacing * (0.5, 0.25, 1.5)[checked % 3])
        if polygon is None:
            continue
        if checked % 5 == 4:
            polygon = shapely.affinity.translate(polygon, *rng.uniform(-9, 9, 2))
        points = grid_points(walls_of(polygon), spacing)
        expected = grid_within(polygon, spacing)
        np.testing.assert_array_equal(points, expected, err_msg=polygon.wkt)
        on_wall += int(shapely.intersects_xy(polygon.boundary, grid_over(polygon, spacing)).sum())
        checked += 1
    assert on_wall > number, "hardly a point lies on a wall: nothing is tested"


def test_grid_of_plans_on_the_grid_is_that_of_shapely() -> None:
    check_grids(np.random.default_rng(7), 60)


@pytest.mark.slow
def test_grid_of_500_plans_on_the_grid_is_that_of_shapely() -> None:
    check_grids(np.random.default_rng(8), 500)


def test_grid_of_plans_with_a_vertex_on_a_row() -> None:
    # Found in use: the rest of a row was turned inside out behind such a vertex.
    outlines = (
        [[0, 1], [2, 1], [3, 1.1], [2, 1.9], [2, 3], [6, 3], [6, 5], [0, 5]],
        [[0, -10], [10, -10], [10, -9], [4, -9], [5, -8.7], [4, -6], [0, -6]],
    )
    for outline in outlines:
        plan = FloorPlan.create(outline)
        points = grid_points(plan.segments, grid_spacing(0.25, plan.area))
        assert shapely.contains_xy(plan.polygon, points).all()
        np.testing.assert_array_equal(points, grid_within(plan.polygon, 0.2))


def test_grid_fills_plans_of_any_shape() -> None:
    rng = np.random.default_rng(5)
    checked = 0
    while checked < 20:
        angle = np.sort(rng.uniform(0, 2 * math.pi, 12))
        ring = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(3, 6, (12, 1))
        hole = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
        polygon = shapely.Polygon(ring, [hole])
        if not polygon.is_valid:
            continue
        points = grid_points(walls_of(polygon), 0.21)
        np.testing.assert_array_equal(points, grid_within(polygon, 0.21))
        assert len(points) * 0.21**2 == pytest.approx(polygon.area, rel=0.1)
        checked += 1


def test_side_of_a_line_is_exact() -> None:
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(2000):
        a, d = rng.integers(-50, 50, 2) * 0.1, rng.integers(-50, 50, 2) * 0.1
        t = rng.integers(-3, 4)
        p = a + t * d + rng.integers(-1, 2, 2) * 2.0 ** rng.integers(-60, -40)
        (ax, ay), (bx, by), (px, py) = ([Fraction(float(v)) for v in q] for q in (a, a + d, p))
        exact = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
        sign = (exact > 0) - (exact < 0)
        assert side(*a, *(a + d), *p) == sign
        seen.add(sign)
    assert seen == {-1, 0, 1}


def test_spacing_follows_the_robot_and_is_bounded_by_the_area() -> None:
    assert grid_spacing(0.25, 100.0) == pytest.approx(0.2)
    assert grid_spacing(0.05, 100.0) == pytest.approx(0.04)
    square = shapely.box(0.0, 0.0, 2000.0, 2000.0)  # more than a plan may have
    points = grid_points(walls_of(square), grid_spacing(0.25, square.area))
    assert len(points) == pytest.approx(MOST_POINTS, rel=0.01)
    # A disc of the robot's size holds sample points wherever it stands.
    rng = np.random.default_rng(0)
    grid = grid_points(boxed(np.empty((0, 4)), 3.0), grid_spacing(0.25, 36.0))
    for centre in rng.uniform(-2.7, 2.7, (200, 2)):
        assert (np.hypot(*(grid - centre).T) < 0.25).sum() >= 2
