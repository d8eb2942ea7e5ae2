import math

import numpy as np
import pytest
import shapely
import shapely.ops
from sim_scenes import clear_point, lines_of, random_walls

from polyexplore_gym.disc import contact_along, first_contact
from polyexplore_gym.sim.robot import (
    ARRIVED,
    CUT,
    STANDOFF,
    TIME,
    advance,
    apart,
    bounded,
    glide,
    is_free,
    nearest_wall,
    profile_distance,
    profile_moment,
    profile_time,
    walls_around,
    walls_near,
    way_length,
    wrap_headings,
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


def test_contact_along_a_path_agrees_with_shapely() -> None:
    rng, radius, hits = np.random.default_rng(2), 0.25, 0
    for _ in range(300):
        walls = random_walls(rng, int(rng.integers(1, 25)), side=8.0)
        start = clear_point(rng, walls, 5.0, radius)
        path = np.vstack([start, start + np.cumsum(rng.uniform(-1.5, 1.5, (4, 2)), axis=0)])
        path[2] = path[1]  # one leg of no length
        line, lines = shapely.linestrings(path), lines_of(walls)
        way = contact_along(walls, path, radius)
        if way == np.inf:
            assert shapely.distance(line, lines) >= radius - 2e-9
            continue
        hits += 1
        assert shapely.distance(shapely.line_interpolate_point(line, way), lines) == pytest.approx(radius, abs=1e-7)
        if way > 1e-6:
            assert shapely.distance(shapely.ops.substring(line, 0.0, way - 1e-7), lines) >= radius - 2e-9
    assert 50 < hits < 290
    touched = np.array([[0.0, 1.0, 4.0, 1.0]])
    assert contact_along(touched, np.array([[1.0, 0.8], [2.0, 0.8], [2.0, 0.9]]), 0.25) == pytest.approx(1.0)
    assert contact_along(touched, np.array([[1.0, 0.8], [1.0, 0.0]]), 0.25) == np.inf


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


@pytest.mark.parametrize("distance", [4.0, 2.4, 0.5, 0.01])
def test_profile_moment_is_when_so_much_is_covered(distance: float) -> None:
    for share in np.linspace(0.0, 1.0, 101):
        time, speed = profile_moment(share * distance, distance, 1.2, 0.6)
        assert profile_distance(time, distance, 1.2, 0.6) == pytest.approx(share * distance, abs=1e-12)
        ahead = profile_distance(time + 1e-6, distance, 1.2, 0.6) - profile_distance(time - 1e-6, distance, 1.2, 0.6)
        if 0.001 < share < 0.999:
            assert speed == pytest.approx(ahead / 2e-6, abs=2e-6)
    assert profile_moment(distance, distance, 1.2, 0.6) == (profile_time(distance, 1.2, 0.6), 0.0)


def driven(distance: float, initial: float, allowed: float, time: float) -> tuple[float, float, float]:
    """(covered, time, speed) by small steps: full throttle, until it must brake; then what is left of the braking."""
    step, at, speed, spent = 1e-4, 0.0, initial, 0.0
    while at < min(distance, allowed) and spent < time and (speed > 0.0 or at == 0.0):
        brake = speed * speed / 1.2 >= distance - at
        after = max(speed - 0.6 * step, 0.0) if brake else min(speed + 0.6 * step, 1.2)
        at, speed, spent = at + 0.5 * (speed + after) * step, after, spent + step
    if at >= distance - 1e-6 and allowed >= distance:
        spent, speed = min(spent + speed / 0.6, time), 0.0
    return min(at, distance), spent, speed


def test_advance_is_driving_by_small_steps() -> None:
    rng, counts = np.random.default_rng(5), {ARRIVED: 0, CUT: 0, TIME: 0}
    for _ in range(60):
        distance, initial = rng.uniform(0.01, 3.0), rng.choice([0.0, rng.uniform(0.0, 1.2)])
        allowed = rng.choice([np.inf, distance * rng.uniform(0.01, 1.2)])
        limit = rng.choice([1e3, rng.uniform(0.1, 3.0)])
        covered, time, speed, ended = advance(distance, initial, allowed, limit, 1.2, 0.6)
        counts[ended] += 1
        twin = driven(distance, initial, allowed, limit)
        assert covered == pytest.approx(twin[0], abs=5e-4)
        assert time == pytest.approx(twin[1], abs=5e-3 if covered < 0.99 * distance else 3e-2)
        if ended == CUT:
            assert speed == pytest.approx(twin[2], abs=1e-2)
            assert covered == allowed
        else:
            assert speed == 0.0
        assert (ended == TIME) == (time == limit and (covered < distance or initial**2 / 1.2 > distance))
    assert min(counts.values()) > 8


def glided(
    speed: float, rate: float, *points: tuple[float, float], heading: float | None = None
) -> tuple[float, float]:
    """(duration, distance) of a glide without walls from the origin, along x."""
    path, final = np.array([(0.0, 0.0), *points]), heading is not None
    limits, left = (1.2, 3.0, 0.6, 5.0), (np.inf, np.inf)
    result = glide(np.empty((0, 4)), np.zeros(3), (speed, rate), path, heading or 0.0, final, 0.25, limits, 1e3, left)
    assert result[3] == ARRIVED
    assert result[5:] == (0.0, 0.0)
    return result[2], result[1]


def test_a_glide_goes_on_at_speed_only_where_its_path_does() -> None:
    rest = glided(0.0, 0.0, (3.0, 0.0))[0]
    on = glided(0.6, 0.0, (3.0, 0.0))[0]
    assert on == pytest.approx(profile_time(3.3, 1.2, 0.6) - 1.0)  # 0.3 m and 1 s to reach 0.6 m/s lie behind it
    assert glided(0.6, 0.0, (3.0 * math.cos(0.015), 3.0 * math.sin(0.015)))[0] == pytest.approx(on)
    turn = profile_time(1.0, 3.0, 5.0)
    assert glided(0.6, 0.0, (3.0 * math.cos(1.0), 3.0 * math.sin(1.0)))[0] == pytest.approx(1.0 + turn + rest)
    assert glided(0.6, 0.0) == (1.0, 0.0)
    assert glided(0.6, 0.0, (0.1, 0.0)) == (pytest.approx(1.0), pytest.approx(0.1))  # too short to brake on
    # turning: 0.1 rad and 0.2 s to reach 1 rad/s lie behind it
    assert glided(0.0, 1.0, heading=1.0)[0] == pytest.approx(profile_time(1.1, 3.0, 5.0) - 0.2)
    assert glided(0.0, -1.0, heading=1.0)[0] == pytest.approx(0.2 + turn)
    assert glided(0.0, 1.0)[0] == pytest.approx(0.2)


def test_points_apart_and_headings_wrapped() -> None:
    points = np.array([[0.0, 0.0], [0.001, 0.0], [0.5, 0.0], [0.5, 0.0], [0.5, 1.0]])
    kept, index = apart(points, 0.01)
    np.testing.assert_array_equal(index, [0, 2, 4])
    np.testing.assert_array_equal(kept, points[index])
    for bad in (np.nan, np.inf):
        assert len(apart(np.array([[0.0, 0.0], [1.0, bad]]), 0.01)[0]) == 0
    way = np.random.default_rng(6).normal(0.0, 8.0, (500, 3))
    headings = way[:, 2].copy()
    wrap_headings(way)
    assert (np.abs(way[:, 2]) <= math.pi).all()
    np.testing.assert_allclose(np.exp(1j * way[:, 2]), np.exp(1j * headings), atol=1e-12)


def test_walls_around_a_path_are_those_in_its_box() -> None:
    rng = np.random.default_rng(7)
    walls = random_walls(rng, 200)
    for _ in range(20):
        path, pose = rng.uniform(-4, 4, (3, 2)), rng.uniform(-4, 4, 3)
        box, near = walls_around(walls, path, pose, 0.7)
        bounds = shapely.MultiPoint(np.vstack([path, pose[:2]])).bounds
        np.testing.assert_allclose(box, np.add(bounds, [-0.7, -0.7, 0.7, 0.7]))
        np.testing.assert_array_equal(near, walls[walls_near(walls, *box)])


def test_walls_near_and_way_length() -> None:
    rng = np.random.default_rng(2)
    walls = random_walls(rng, 200)
    near = walls_near(walls, -2.0, -1.0, 1.0, 3.0)
    boxes = shapely.box(*np.minimum(walls[:, :2], walls[:, 2:]).T, *np.maximum(walls[:, :2], walls[:, 2:]).T)
    np.testing.assert_array_equal(near, np.flatnonzero(shapely.intersects(boxes, shapely.box(-2.0, -1.0, 1.0, 3.0))))
    way = rng.normal(size=(30, 3))
    assert way_length(way) == pytest.approx(shapely.LineString(way[:, :2]).length)
    assert way_length(way[:1]) == 0.0
