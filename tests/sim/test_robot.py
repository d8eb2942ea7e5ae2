import math

import numpy as np
import pytest
import shapely
from sim_scenes import clear_point, lines_of, random_walls

from polyexplore_gym.sim.robot import (
    STANDOFF,
    bounded,
    first_contact,
    is_free,
    nearest_wall,
    profile_distance,
    profile_time,
    walls_near,
    way_length,
)

pytestmark = pytest.mark.bounds


def test_nearest_wall_agrees_with_shapely() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        walls = random_walls(rng, 20)
        walls[3, 2:] = walls[3, :2]  # one of no length
        x, y = rng.uniform(-8, 8, 2)
        distance, px, py = nearest_wall(walls, x, y)
        assert distance == pytest.approx(shapely.distance(lines_of(walls), shapely.points(x, y)), abs=1e-12)
        assert math.hypot(px - x, py - y) == pytest.approx(distance, abs=1e-12)
    assert nearest_wall(np.empty((0, 4)), 0.0, 0.0)[0] == np.inf


def test_first_contact_agrees_with_shapely() -> None:
    rng, radius, hits = np.random.default_rng(1), 0.25, 0
    for _ in range(1500):
        walls = random_walls(rng, int(rng.integers(1, 25)), side=8.0)
        start = clear_point(rng, walls, 5.0, radius * (1 + STANDOFF))
        way = rng.uniform(-5, 5, 2)
        lines = lines_of(walls)
        contact, stop = first_contact(walls, *start, *way, radius, STANDOFF * radius)
        if contact == np.inf:
            assert shapely.distance(lines, shapely.linestrings([start, start + way])) >= radius - 2e-9
            continue
        hits += 1
        assert 0.0 < stop <= contact <= 1.0
        assert shapely.distance(lines, shapely.points(start + contact * way)) == pytest.approx(radius, abs=1e-7)
        if contact > 1e-6:  # nothing touched before
            before = shapely.linestrings([start, start + (contact - 1e-7) * way])
            assert shapely.distance(lines, before) >= radius - 2e-9
        # standing off: clear of the wall that would have been hit
        clearance = [
            shapely.distance(shapely.linestrings(w.reshape(2, 2)), shapely.points(start + contact * way)) for w in walls
        ]
        hit = walls[int(np.argmin(clearance))].reshape(2, 2)
        gap = shapely.distance(shapely.linestrings(hit), shapely.points(start + stop * way)) - radius
        assert gap == pytest.approx(STANDOFF * radius, abs=1e-7)
    assert hits > 300


def test_a_disc_that_touches_a_wall_may_leave_it_but_not_enter() -> None:
    wall = np.array([[-1.0, 0.0, 1.0, 0.0]])
    for height in (0.25, 0.2499):
        assert first_contact(wall, 0.0, height, 0.3, -0.1, 0.25, 1e-3) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert first_contact(wall, 0.0, height, 0.3, 0.1, 0.25, 1e-3) == (np.inf, np.inf)
        assert first_contact(wall, 0.0, height, 0.3, 0.0, 0.25, 1e-3) == (np.inf, np.inf)
    assert first_contact(wall, -3.0, 0.25, 6.0, 0.0, 0.25, 1e-3)[0] == np.inf  # passes touching
    assert first_contact(wall, 0.0, 1.0, 0.0, 0.0, 0.25, 1e-3) == (np.inf, np.inf)


def test_a_disc_held_off_a_wall_is_held_again() -> None:
    """Standing off by the standoff, give or take rounding, it goes no nearer, however often it tries."""
    rng, radius, held = np.random.default_rng(3), 0.25, 0
    for _ in range(400):
        walls = random_walls(rng, int(rng.integers(1, 25)), side=8.0)
        start, way = clear_point(rng, walls, 5.0, radius * (1 + STANDOFF)), rng.uniform(-5, 5, 2)
        contact, stop = first_contact(walls, *start, *way, radius, STANDOFF * radius)
        if contact <= 1.0:
            held += 1
            start += stop * way
            contact, stop = first_contact(walls, *start, *(way * (1.0 - stop)), radius, STANDOFF * radius)
            assert contact <= 1.0
            assert stop * math.hypot(*way) < 1e-6
    assert held > 100


def test_a_motion_is_free_where_shapely_finds_room() -> None:
    rng, radius, counts = np.random.default_rng(4), 0.25, [0, 0]
    for _ in range(800):
        walls = random_walls(rng, int(rng.integers(1, 12)), side=8.0)
        start, way = clear_point(rng, walls, 5.0, radius * (1 + 1e-6)), rng.uniform(-3, 3, 2)
        gap = shapely.distance(lines_of(walls), shapely.linestrings([start, start + way])) - radius
        free = is_free(walls, *start, *way, radius)
        assert free == (gap > 1e-7 * radius) or abs(gap) < 1e-6 * radius
        counts[free] += 1
    assert min(counts) > 100
    wall, at = np.array([[-1.0, 0.0, 1.0, 0.0]]), radius * (1 + 1.5e-7)  # touching
    assert is_free(wall, 0.0, at, 3.0, 0.0, radius)
    assert is_free(wall, 0.0, at, 3.0, 0.1, radius)
    assert not is_free(wall, 0.0, at, 3.0, -1e-6, radius)


@pytest.mark.parametrize("answer", [(3.0, -0.5), (3.0, 0.6), (math.nan, 0.0), (math.inf, 0.0), (-1.0, 0.0)])
def test_what_leads_into_a_wall_or_too_far_is_not_followed(answer: tuple[float, float]) -> None:
    wall, radius = np.array([[-9.0, 0.0, 9.0, 0.0], [5.0, 0.0, 5.0, 3.0]]), 0.25
    at = radius * (1 + 1e-7)
    assert bounded(wall, 0.0, at, 3.0, -0.5, *answer, 1.0, radius) == pytest.approx((3.0, 0.0, 1.0))
    assert bounded(wall, 0.0, at, 3.0, -0.5, 1.0, 0.0, 0.5, radius) == pytest.approx((0.5, 0.0, 0.5))  # it may be less
    assert bounded(wall, 0.0, at, 9.0, -0.5, 9.0, 0.0, 1.0, radius) == pytest.approx((4.75, 0.0, 4.75 / 9))
    assert bounded(wall, 4.75, at, 3.0, -0.5, *answer, 0.7, radius) == (0.0, 0.0, 0.7)  # held in the corner


@pytest.mark.parametrize(("distance", "speed", "acceleration"), [(4.0, 1.2, 0.6), (0.5, 1.2, 0.6), (2.4, 1.2, 0.6)])
def test_profile_is_the_integral_of_its_trapezoid(distance: float, speed: float, acceleration: float) -> None:
    total = profile_time(distance, speed, acceleration)
    times = np.linspace(0, total, 20001)
    peak = min(speed, math.sqrt(distance * acceleration))
    speeds = np.minimum(np.minimum(acceleration * times, acceleration * (total - times)), peak)
    way = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * np.diff(times))])
    got = [profile_distance(t, distance, speed, acceleration) for t in times[::1000]]
    np.testing.assert_allclose(got, way[::1000], atol=1e-6)
    assert way[-1] == pytest.approx(distance, abs=1e-6)


def test_walls_near_and_way_length() -> None:
    rng = np.random.default_rng(2)
    walls = random_walls(rng, 200)
    near = walls_near(walls, -2.0, -1.0, 1.0, 3.0)
    boxes = shapely.box(*np.minimum(walls[:, :2], walls[:, 2:]).T, *np.maximum(walls[:, :2], walls[:, 2:]).T)
    np.testing.assert_array_equal(near, np.flatnonzero(shapely.intersects(boxes, shapely.box(-2.0, -1.0, 1.0, 3.0))))
    way = rng.normal(size=(30, 3))
    assert way_length(way) == pytest.approx(shapely.LineString(way[:, :2]).length)
    assert way_length(way[:1]) == 0.0
