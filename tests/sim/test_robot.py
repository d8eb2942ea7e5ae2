import math

import numpy as np
import pymunk
import pytest
import shapely
from sim_scenes import boxed, clear_point, lines_of, random_walls

from polyexplore_gym.sim.robot import (
    BENDS,
    STANDOFF,
    first_contact,
    nearest_wall,
    profile_distance,
    profile_time,
    slide,
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


def slid(walls: np.ndarray, start: np.ndarray, way: np.ndarray, radius: float) -> np.ndarray:
    bends = np.empty((BENDS, 2))
    return np.vstack([start, bends[: slide(walls, *start, *way, radius, bends)]])


def test_slides_as_pymunk_in_small_steps() -> None:
    """pymunk without friction, its velocity set anew in every small step, is the slow twin."""
    rng, radius, off, along = np.random.default_rng(4), 0.25, [], 0
    for _ in range(150):
        walls = boxed(random_walls(rng, 12, side=6.0), 3.0)
        start, way = clear_point(rng, walls, 2.5, radius), rng.uniform(-2, 2, 2)
        space = pymunk.Space()
        space.collision_slop, space.collision_bias = 1e-6, 0.0
        body = pymunk.Body(1.0, 1.0)
        body.position = tuple(start)
        shape = pymunk.Circle(body, radius)
        shape.friction = 0.0
        static = space.static_body
        space.add(body, shape, *(pymunk.Segment(static, w[:2], w[2:], 0.0) for w in walls.tolist()))
        for _ in range(2000):
            body.velocity = tuple(way)
            space.step(1 / 2000)
        got = slid(walls, start, way, radius)
        along += len(got) > 2
        off.append(math.dist(got[-1], body.position))
    assert along > 60
    assert np.median(off) < 0.002
    # on a wall's end that it meets head-on, rounding decides the side
    assert np.mean(np.array(off) < 0.01) > 0.97


@pytest.mark.parametrize("longest", [0.1, 3.0, 300.0, 30_000.0])
def test_slides_from_contact_to_contact_and_never_into_a_wall(longest: float) -> None:
    rng, bent, free = np.random.default_rng(5), 0, 0
    for _ in range(300):
        radius = 10.0 ** rng.uniform(-1.7, 0.3)
        walls, shift = boxed(random_walls(rng, 25, side=30.0), 16.0), rng.uniform(-100, 100, 2)
        start = radius * clear_point(rng, walls, 15.0, 1.0) + shift
        walls = radius * walls + np.tile(shift, 2)
        lines = lines_of(walls)
        for _ in range(4):  # on from where it was held
            angle = rng.uniform(-math.pi, math.pi)
            way = longest * radius * rng.uniform() * np.array([math.cos(angle), math.sin(angle)])
            got = slid(walls, start, way, radius)
            assert shapely.distance(lines, shapely.linestrings(got)) > radius * (1 - 1e-9)
            assert np.hypot(*np.diff(got, axis=0).T).sum() <= math.hypot(*way) * (1 + 1e-9)
            assert (np.diff(got, axis=0) @ way >= 0.0).all()
            if shapely.distance(lines, shapely.linestrings([start, start + way])) > radius * (1 + 1e-6):
                np.testing.assert_array_equal(got, [start, start + way])
                free += 1
            bent += len(got) > 2
            start = got[-1]
    assert bent > (5 if longest < 1.0 else 200)
    assert free > 500 or longest > 1.0


def test_a_wall_takes_what_leads_into_it_and_no_more() -> None:
    floor, side = np.array([[-5.0, 0.0, 1.0, 0.0]]), np.array([[0.9, 0.0, 0.9, 3.0]])
    got = slid(floor, np.array([0.0, 0.3]), np.array([0.5, -0.5]), 0.25)
    np.testing.assert_allclose(got[1:], [[0.05, 0.25], [0.5, 0.25]], atol=1e-7)
    got = slid(np.vstack([floor, side]), np.array([0.0, 0.25]), np.array([4.0, -0.5]), 0.25)
    np.testing.assert_allclose(got[-1], [0.65, 0.25], atol=1e-7)  # in the corner both hold it
    np.testing.assert_array_equal(slid(floor, np.array([0.0, 0.25]), np.array([0.0, -1.0]), 0.25)[-1], [0.0, 0.25])
    # round the end of the floor: on a circle about it, and then down
    got = slid(floor, np.array([0.9, 0.25]), np.array([1.0, -2.0]), 0.25)
    gaps = np.hypot(*(got - [1.0, 0.0]).T)
    assert gaps[1:-1].min() > 0.25
    assert gaps[1:-1].max() < 0.2505
    assert got[-1, 0] - got[-2, 0] == pytest.approx((got[-2, 1] - got[-1, 1]) / 2)
    np.testing.assert_array_equal(slid(np.empty((0, 4)), np.zeros(2), np.array([3.0, 4.0]), 0.25)[1:], [[3.0, 4.0]])


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
