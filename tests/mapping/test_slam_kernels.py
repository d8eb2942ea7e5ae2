"""The kernels of SLAM against slow exact twins."""

import math

import numpy as np
import pytest
from line_scenes import HALF, box, cast

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping.logs.poses import between, compose
from polyexplore_gym.mapping.slam import align as aligning
from polyexplore_gym.mapping.slam.align import align, target_of
from polyexplore_gym.mapping.slam.correlative import BLUR, CELL, LEVELS, Window, field_of, search
from polyexplore_gym.mapping.slam.correlative import _headings as headings_of
from polyexplore_gym.mapping.slam.loops import _CLEAR, _WALL, _share_through
from polyexplore_gym.mapping.slam.surface import merged, placed, surface_of

SENSOR = SensorConfig(max_range=12.0)
CONFIG = MappingConfig(range_floor=0.01)
WALLS = [*box(0.0, 0.0, 6.0, 4.0), [2.0, 0.0, 2.0, 1.0], [6.0, 2.5, 5.0, 2.5], [5.0, 2.5, 5.0, 3.0]]


def seen(pose, rng=None, walls=WALLS, step=4):
    """The surface of a scan of every `step`-th beam."""
    angles = HALF[::step]
    ranges = cast(walls, pose, angles, SENSOR.max_range) + (0.0 if rng is None else rng.normal(0, 0.01, angles.size))
    return surface_of(angles, ranges, SENSOR, CONFIG)


def test_a_field_is_the_likelihood_of_the_nearest_return():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (20, 2))
    field = field_of(points)
    rows, columns = field.levels.shape[1:]
    x = field.corner[0] + (np.arange(columns) + 0.5) * CELL
    y = field.corner[1] + (np.arange(rows) + 0.5) * CELL
    d2 = ((np.stack(np.meshgrid(x, y), -1)[:, :, None] - points) ** 2).sum(-1).min(-1)
    exact = np.where(d2 < 9 * BLUR**2, np.exp(-0.5 * d2 / BLUR**2), 0.0)
    np.testing.assert_allclose(field.levels[0], exact, atol=1e-6)
    for n in range(1, LEVELS):
        size = 2**n
        blocks = [[exact[i : i + size, j : j + size].max() for j in range(columns)] for i in range(rows)]
        np.testing.assert_allclose(field.levels[n], blocks, atol=1e-6)


def scores(field, points, window):
    """(headings, shifts, shifts) mean of the field less the penalty for every pose in the window, one by one."""
    headings, shifts = headings_of(points, window), math.ceil(window.reach / CELL)
    rows, columns = field.levels[0].shape
    out = np.empty((len(headings), 2 * shifts + 1, 2 * shifts + 1))
    for t, heading in enumerate(headings):
        at = (
            compose(window.guess + np.array([0, 0, heading]), np.c_[points, np.zeros(len(points))])[:, :2]
            - field.corner
        )
        cells = np.floor(at / CELL).astype(int)
        for a in range(-shifts, shifts + 1):
            for b in range(-shifts, shifts + 1):
                i, j = cells[:, 1] + a, cells[:, 0] + b
                inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
                total = field.levels[0][i[inside], j[inside]].sum(dtype=float)
                cost = window.penalty[0] * (a * a + b * b) * CELL**2 + window.penalty[1] * heading**2
                out[t, a + shifts, b + shifts] = total / len(points) - cost
    return headings, shifts, out


@pytest.mark.parametrize("penalty", [(0.0, 0.0), (0.3, 0.5)])
@pytest.mark.parametrize("seed", range(4))
def test_the_search_finds_the_best_of_all_poses(seed, penalty):
    rng = np.random.default_rng(seed)
    true = np.array([*rng.uniform(1, 3, 2), rng.uniform(-3, 3)])
    pose = np.array([2.5, 2.0, true[2] + 0.3])
    field = field_of(placed(seen(pose, rng), pose).points)
    points = seen(true, rng).points
    window = Window(true + rng.uniform(-0.3, 0.3, 3), 0.45, 0.35, penalty)
    headings, shifts, value = scores(field, points, window)
    found = search(field, points, window)
    off = found.pose - window.guess
    t = int(np.abs(headings - off[2]).argmin())
    a, b = np.round(off[[1, 0]] / CELL).astype(int) + shifts
    assert value[t, a, b] == pytest.approx(value.max(), abs=1e-9)
    cost = penalty[0] * (off[:2] ** 2).sum() + penalty[1] * off[2] ** 2
    assert found.score - cost == pytest.approx(value.max(), abs=1e-9)
    # above what is asked for, or not at all
    assert search(field, points, window, value.max() - 1e-6).score == found.score
    nothing = search(field, points, window, value.max() + 1e-6)
    assert nothing.score == -1.0
    np.testing.assert_array_equal(nothing.pose, window.guess)


def test_the_search_recognises_a_place_from_far_off():
    true = np.array([4.0, 1.5, 2.0])
    guess, pose = true + np.array([0.9, -0.8, math.radians(50)]), np.array([3.5, 2.0, 2.2])
    found = search(field_of(placed(seen(pose), pose).points), seen(true, step=2).points, Window(guess, 1.5, 1.2))
    assert np.hypot(*(found.pose - true)[:2]) < 0.1
    assert abs(found.pose[2] - true[2]) < math.radians(1.5)
    assert search(field_of(np.zeros((1, 2))), np.zeros((0, 2)), Window(guess, 1.0, 1.0)).score == -1.0


def aligned_plainly(surface, known, guess, prior, sigma):
    """The slow twin of `align`: all points against all, the normal equations written out."""
    pose = guess.copy()
    for reach in aligning.REACHES:
        for _ in range(aligning.ROUNDS):
            turn = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
            points, normals = surface.points[: len(surface.feet)] @ turn.T, surface.normals @ turn.T
            apart = np.linalg.norm((points + pose[:2])[:, None] - known.feet, axis=2)
            apart[(normals @ known.normals.T) <= aligning.SAME_WAY] = np.inf
            at = apart.argmin(axis=1)
            on = apart[np.arange(len(at)), at] < reach
            u = known.normals[at[on]]
            r = ((points[on] + pose[:2] - known.feet[at[on]]) * u).sum(1)
            jacobian = np.c_[u, u[:, 1] * points[on, 0] - u[:, 0] * points[on, 1]]
            weight = 1.0 / (sigma**2 * (1.0 + r**2 / (4.0 * sigma**2)))
            h = jacobian.T @ (weight[:, None] * jacobian)
            step = np.linalg.solve(h + prior, -jacobian.T @ (weight * r) + prior @ (guess - pose))
            pose = pose + step
            if np.hypot(*step[:2]) < 1e-5 and abs(step[2]) < 1e-6:
                break
    return pose, h, int(on.sum()), math.sqrt((r**2).mean())


@pytest.mark.parametrize("seed", range(5))
def test_a_scan_is_aligned_as_by_hand(seed):
    rng = np.random.default_rng(seed)
    true = np.array([*rng.uniform(1, 3, 2), rng.uniform(-3, 3)])
    poses = np.array([true + rng.uniform(-0.5, 0.5, 3) for _ in range(2)])
    known = merged([seen(pose, rng) for pose in poses], poses)
    surface, guess = seen(true, rng), true + rng.uniform(-0.05, 0.05, 3)
    prior = np.diag([100.0, 50.0, 400.0])
    got = align(surface, target_of(known), guess, prior, 0.02)
    pose, information, matched, rms = aligned_plainly(surface, known, guess, prior, 0.02)
    np.testing.assert_allclose(got.pose, pose, atol=1e-9)
    np.testing.assert_allclose(got.information, information, rtol=1e-6, atol=1e-3)
    assert (got.matched, got.share) == (matched, matched / len(surface.feet))
    assert got.rms == pytest.approx(rms)
    assert np.hypot(*(got.pose - true)[:2]) < 0.02
    assert abs(got.pose[2] - true[2]) < math.radians(0.3)


def test_where_there_are_no_lines_the_guess_stays():
    empty = surface_of(HALF, np.full(HALF.size, math.nan), SENSOR, CONFIG)
    guess = np.array([1.0, 2.0, 3.0])
    for surface, target in ((empty, target_of(seen(guess))), (seen(guess), target_of(empty))):
        got = align(surface, target, guess, np.eye(3))
        np.testing.assert_array_equal(got.pose, guess)
        assert (got.matched, got.share) == (0, 0.0)
        assert not got.information.any()


def test_a_surface_is_the_scan_and_its_lines():
    rng = np.random.default_rng(3)
    pose = np.array([2.5, 2.0, 0.7])
    surface = seen(pose, rng, step=1)
    ranges = cast(WALLS, pose, HALF, SENSOR.max_range)
    assert len(surface.points) == np.isfinite(ranges).sum()
    assert len(surface.feet) > 0.9 * len(surface.points)
    there = placed(surface, pose)
    np.testing.assert_allclose(
        between(pose, np.c_[there.points, np.zeros(len(there.points))])[:, :2], surface.points, atol=1e-12
    )
    # normals point away from where the wall was seen, feet lie on the walls
    assert ((surface.normals * surface.feet).sum(1) > 0).all()
    walls = np.array(WALLS)
    near = [
        min(abs((f - w[:2]) @ [w[3] - w[1], w[0] - w[2]]) / math.hypot(*(w[2:] - w[:2])) for w in walls)
        for f in there.feet
    ]
    assert max(near) < 0.03
    np.testing.assert_allclose(merged([surface], pose[None], pose).points, surface.points, atol=1e-12)


def test_beams_that_pass_through_walls_are_counted():
    field = field_of(np.c_[np.full(60, 2.0), np.linspace(-1.5, 1.5, 60)])  # a wall at x = 2
    surface = surface_of(HALF[::6], cast(box(-5, -5, 5, 5), (0, 0, 0), HALF[::6], 12.0), SENSOR, CONFIG)
    pose = np.array([0.3, 0.1, 0.2])
    got = _share_through(field, [surface], pose[None])
    passed = 0
    for point in surface.points:
        end = compose(pose, np.array([*point, 0.0]))[:2]
        along = np.arange(0.0, np.hypot(*point) - _CLEAR, 0.002)[:, None] * (end - pose[:2]) / np.hypot(*point)
        cells = np.floor((pose[:2] + along - field.corner) / CELL).astype(int)
        i, j = cells[:, 1], cells[:, 0]
        inside = (i >= 0) & (j >= 0) & (i < field.levels.shape[1]) & (j < field.levels.shape[2])
        passed += bool((field.levels[0][i[inside], j[inside]] > _WALL).any())
    # the kernel takes steps of a cell: at the end of the wall it may miss a corner of one
    assert got == pytest.approx(passed / len(surface.points), abs=2.5 / len(surface.points))
    assert 0.2 < got < 0.6
