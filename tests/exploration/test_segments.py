"""Segment geometry and the hashed grid against shapely and against looking at every segment."""

from __future__ import annotations

import os

import numpy as np
import pytest
import shapely
from exploration_scenes import lines_of
from numba import njit

from polyexplore_gym.exploration import segments as sg

pytestmark = pytest.mark.bounds


def random_segments(rng, n, half=12.0):
    """Short and long ones, some along the axes, some on the edges of grid cells."""
    start = rng.uniform(-half, half, (n, 2))
    start[::5] = np.round(start[::5])
    end = start + rng.normal(0.0, 1.0, (n, 2)) * rng.choice([0.1, 1.0, 6.0], (n, 1))
    end[::3, 0] = start[::3, 0]
    return np.hstack([start, end])


def line(s):
    return shapely.linestrings(np.asarray(s).reshape(-1, 2, 2))


@njit
def _point_distances(points, segments):
    out = np.empty(len(points))
    for i in range(len(points)):
        s = segments[i]
        out[i] = sg.point_segment_distance(points[i, 0], points[i, 1], s[0], s[1], s[2], s[3])
    return out


@pytest.mark.parametrize("seed", range(3))
def test_distances(seed):
    rng = np.random.default_rng(seed)
    a, b = random_segments(rng, 2000, 5.0), random_segments(rng, 2000, 5.0)
    a[:20, 2:] = a[:20, :2]  # of no length
    wanted = shapely.distance(line(a), line(b))
    got = np.array([sg.segment_distance(*p, *q) for p, q in zip(a, b, strict=True)])
    np.testing.assert_allclose(got, wanted, atol=1e-9)
    assert (wanted == 0).sum() > 20
    np.testing.assert_allclose(
        _point_distances(a[:, :2], b), shapely.distance(shapely.points(a[:, :2]), line(b)), atol=1e-9
    )


def test_crossing_gives_the_place():
    rng = np.random.default_rng(3)
    a, b = random_segments(rng, 3000, 4.0), random_segments(rng, 3000, 4.0)
    crosses = shapely.crosses(line(a), line(b))
    for p, q, hit in zip(a, b, crosses, strict=True):
        t = sg.crossing(*p, *q)
        if hit and min(np.hypot(*(p[2:] - p[:2])), np.hypot(*(q[2:] - q[:2]))) > 1e-6:
            at = p[:2] + t * (p[2:] - p[:2])
            assert shapely.Point(at).distance(line(q)[0]) < 1e-9
    assert crosses.sum() > 50


@pytest.mark.parametrize("seed", range(4))
def test_grid_answers_like_all_segments(seed):
    rng = np.random.default_rng(seed)
    segments = random_segments(rng, 60)
    alive = rng.random(60) < 0.8
    grid = sg.indexed(segments, np.full(60, -1), alive, 0.45, float(rng.choice([0.3, 1.0, 5.0])))
    living = lines_of(segments[alive])
    points = rng.uniform(-13, 13, (2000, 2))
    got = np.array([sg.clearance(x, y, grid, 0.45) for x, y in points])
    wanted = np.minimum(shapely.distance(living, shapely.points(points)), 0.45)
    np.testing.assert_allclose(got, wanted, atol=1e-9)
    np.testing.assert_array_equal(sg.clearances(points, grid, 0.45), got)

    ways = random_segments(rng, 3000)
    distance = shapely.distance(living, line(ways))
    for radius in (0.1, 0.25, 0.45):
        sure = np.abs(distance - radius) > 1e-9
        free = np.array([sg.sweep_free(*w, grid, radius) for w in ways])
        assert (free == (distance >= radius))[sure].all()
        assert 50 < free.sum() < 2950


@pytest.mark.parametrize("seed", range(4))
def test_crossing_free_with_owners_and_slack(seed):
    rng = np.random.default_rng([7, seed])
    segments = random_segments(rng, 40)
    owner = rng.integers(-1, 5, 40)
    grid = sg.indexed(segments, owner, np.ones(40, np.bool_), 0.0, 1.0)
    lines = line(segments)
    outcomes = []
    for w in random_segments(rng, 3000) + 1e-4 * np.sqrt(2):  # a way along a segment is no crossing
        a, b, slack_a, slack_b = *rng.integers(-2, 5, 2), *rng.choice([0.0, 0.3], 2)
        way = line(w)[0]
        ignored = (owner >= 0) & ((owner == a) | (owner == b))
        blocked = False
        near = False
        for cut in shapely.intersection(way, lines[~ignored]):
            for x, y in shapely.get_coordinates(cut):
                da, db = np.hypot(x - w[0], y - w[1]), np.hypot(x - w[2], y - w[3])
                near |= abs(da - slack_a) < 1e-7 or abs(db - slack_b) < 1e-7
                blocked |= da >= slack_a and db >= slack_b
        if not near:
            assert sg.crossing_free(*w, grid, a, b, slack_a, slack_b) != blocked
            outcomes.append(blocked)
    assert 0.03 < np.mean(outcomes) < 0.95


@pytest.mark.skipif(os.environ.get("NUMBA_BOUNDSCHECK") != "1", reason="make bounds checks them")
def test_array_bounds_are_checked():
    with pytest.raises(IndexError):
        _point_distances(np.zeros((2, 2)), np.zeros((1, 4)))


def test_first_hit_names_a_wall_that_is_near():
    rng = np.random.default_rng(5)
    walls = random_segments(rng, 60)
    index = sg.indexed(walls, np.full(60, -1), np.ones(60, bool), 0.6, 1.0)
    legs = random_segments(rng, 400)
    near = shapely.distance(line(legs)[:, None], line(walls)) < 0.3
    got = np.array([sg.first_hit(*leg, index, 0.3) for leg in legs])
    assert 40 < (got < 0).sum() < 360
    np.testing.assert_array_equal(got >= 0, near.any(axis=1))
    assert near[np.flatnonzero(got >= 0), got[got >= 0]].all()
