"""The pose filter: derivatives, a plain twin of the update, honest covariances, and matches that must not be made."""

import itertools
import math

import numpy as np
import pytest
from line_scenes import EXACT, HALF, box, measure

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import LineMap, Localizer, extract_lines
from polyexplore_gym.mapping import localize as module
from polyexplore_gym.mapping.slots import oriented

SENSOR = SensorConfig()
ROOM = box(0.0, 0.0, 7.0, 5.0)


def scan(walls, pose, rng):
    return extract_lines(HALF, measure(walls, pose, SENSOR, rng), SENSOR)


def started(walls, pose, rng):
    """A localiser and a map that know what is seen from a pose, exactly."""
    line_map, localizer = LineMap(), Localizer()
    add(localizer, line_map, scan(walls, pose, rng), np.asarray(pose, float), EXACT)
    return line_map, localizer


def add(localizer, line_map, lines, pose, covariance):
    fix = localizer.correct(lines, line_map, pose, covariance)
    line_map.insert(lines, fix.pose, fix.relative)
    localizer.learn(line_map)
    return fix


def turned(error):
    error[2] = math.remainder(error[2], 2.0 * math.pi)
    return error


def test_derivatives_of_a_line_seen_from_a_pose():
    rng = np.random.default_rng(0)
    for _ in range(50):
        pose, (rho, alpha) = rng.uniform(-3, 3, 3), rng.uniform(-3, 3, 2)
        _, _, by_pose, by_line = module._seen_from(pose, rho, alpha)

        def seen(p, line):
            r, a, _, _ = module._seen_from(p, line[1], line[0])
            return np.array([a, r])

        h = 1e-6
        line = np.array([alpha, rho])
        for derivative, at, view in (
            (by_pose, pose, lambda p, line=line: seen(p, line)),
            (by_line, line, lambda v, pose=pose: seen(pose, v)),
        ):
            for k in range(at.size):
                step = h * np.eye(at.size)[k]
                difference = view(at + step) - view(at - step)
                difference[0] = math.remainder(difference[0], 2.0 * math.pi)
                np.testing.assert_allclose(derivative[:, k], difference / (2 * h), atol=1e-6)


def test_update_equals_the_dense_filter():
    """The same matches, in numpy: the whole state's covariance, an optimal gain for the pose and none for the rest."""
    rng = np.random.default_rng(1)
    line_map, localizer = started(ROOM, (2.0, 2.0, 0.3), rng)
    add(localizer, line_map, scan(ROOM, (2.4, 2.2, 0.9), rng), np.array([2.41, 2.2, 0.91]), np.diag([4e-4, 4e-4, 1e-4]))
    pose = localizer._pose + np.array([0.4, 0.1, 0.3])
    # the odometry's covariance: the last one moved on, and noise
    move = np.eye(3)
    move[0, 2], move[1, 2] = -0.1, 0.4
    p = move @ localizer._covariance @ move.T + np.diag([1e-4, 1e-4, 4e-4])
    lines = scan(ROOM, (2.8, 2.3, 1.2), rng)
    n = 2 * line_map.rho.size
    joint = np.zeros((3 + n, 3 + n))
    joint[:3, :3] = p
    joint[:3, 3:] = move @ localizer._shared[:, :n]
    joint[3:, :3], joint[3:, 3:] = joint[:3, 3:].T, localizer._lines[:n, :n]
    fix = localizer.correct(lines, line_map, pose, p)
    assert (fix.matched >= 0).sum() >= 2

    length = np.bincount(lines.segment_line, np.hypot(*(lines.segments[:, 2:] - lines.segments[:, :2]).T))
    expected = pose.copy()
    for i in np.argsort(-length, kind="stable"):
        j = fix.matched[i]
        if j < 0:
            continue
        rho, alpha, _ = oriented(line_map.tables[1], j)
        c, s = math.cos(alpha), math.sin(alpha)
        h = np.zeros((2, 3 + n))
        h[0, 2], h[1, :2] = -1.0, (-c, -s)
        h[0, 3 + 2 * j] = h[1, 4 + 2 * j] = 1.0
        h[1, 3 + 2 * j] = expected[0] * s - expected[1] * c
        innovation = np.array(
            [
                math.remainder(lines.alpha[i] - alpha + expected[2], 2 * math.pi),
                lines.rho[i] - rho + expected[0] * c + expected[1] * s,
            ]
        )
        r = lines.covariance[i] + np.diag(np.square((module.BIAS[0], 0.5 * module.BIAS[1])))
        gain = np.zeros((3 + n, 2))
        gain[:3] = joint[:3] @ h.T @ np.linalg.inv(h @ joint @ h.T + r)
        expected += gain[:3] @ innovation
        keep = np.eye(3 + n) - gain @ h
        joint = keep @ joint @ keep.T + gain @ r @ gain.T  # Joseph's form holds for any gain
    np.testing.assert_allclose(fix.pose, expected, atol=1e-10)
    np.testing.assert_allclose(fix.covariance, joint[:3, :3], atol=1e-12)
    np.testing.assert_allclose(localizer._shared[:, :n], joint[:3, 3:], atol=1e-12)


def walk(seed, steps, correlated=True):
    """Squared normalised pose errors, and errors in m, along a walk through a ring of corridors."""
    rng = np.random.default_rng(seed)
    walls = box(0.0, 0.0, 14.0, 10.0) + [[x2, y2, x1, y1] for x1, y1, x2, y2 in box(2.0, 2.0, 12.0, 8.0)]
    corners = np.array([[1.0, 1.0], [13.0, 1.0], [13.0, 9.0], [1.0, 9.0]])
    true = np.array([2.0, 1.0, 0.0])
    line_map, localizer = started(walls, true, rng)
    pose, p = true.copy(), np.zeros((3, 3))
    target, values, errors = 1, [], []
    for _ in range(steps):
        ahead = corners[target] - true[:2]
        if np.hypot(*ahead) < 0.5:
            target = (target + 1) % 4
            ahead = corners[target] - true[:2]
        turn = math.remainder(math.atan2(ahead[1], ahead[0]) - true[2], 2 * math.pi)
        turn, forward = (np.clip(turn, -0.5, 0.5), 0.0) if abs(turn) > 0.1 else (turn, 0.5)
        for heading, where, noise in ((true[2] + turn, true, False), (pose[2] + turn, pose, True)):
            where[2] = heading
            step = forward * np.array([math.cos(heading), math.sin(heading)])
            where[:2] += step
            if noise:
                move = np.eye(3)
                move[0, 2], move[1, 2] = -step[1], step[0]
                q = np.array([4e-4 * forward, 4e-4 * forward, 3e-4 * forward + 1e-4 * abs(turn)])
                p = move @ p @ move.T + np.diag(q)
                where += np.sqrt(q) * rng.standard_normal(3)
        lines = scan(walls, true, rng)
        fix = localizer.correct(lines, line_map, pose, p)
        line_map.insert(lines, fix.pose, fix.relative)
        localizer.learn(line_map)
        if not correlated:  # the map taken as independent of the pose, with the covariances that it states
            localizer._shared[:] = 0.0
            localizer._lines[:] = 0.0
            for j in range(line_map.rho.size):
                at = slice(2 * j, 2 * j + 2)
                localizer._lines[at, at] = oriented(line_map.tables[1], j)[2]
        pose, p = fix.pose.copy(), fix.covariance.copy()
        error = turned(true - pose)
        values.append(error @ np.linalg.solve(p, error))
        errors.append(np.hypot(*error[:2]))
    return np.array(values), np.array(errors)


def consistency(walks, steps):
    results = [walk(seed, steps) for seed in range(walks)]
    return np.mean([v.mean() for v, _ in results]), np.concatenate([e for _, e in results])


def test_covariance_is_honest_in_a_ring_of_corridors():
    value, errors = consistency(12, 80)
    assert 1.8 < value < 4.2
    assert np.median(errors) < 0.05


@pytest.mark.slow
def test_covariance_is_honest_in_many_rings():
    value, errors = consistency(200, 200)
    assert 2.6 < value < 3.4
    assert np.median(errors) < 0.05


def test_without_the_correlation_the_filter_believes_too_much():
    """Why the joint covariance is kept."""
    naive = np.mean([walk(seed, 80, correlated=False)[0].mean() for seed in range(6)])
    assert naive > 2.0 * consistency(6, 80)[0]


def test_joint_covariance_stays_one():
    rng = np.random.default_rng(3)
    line_map, localizer = started(ROOM, (2.0, 2.0, 0.3), rng)
    pose, p = np.array([2.0, 2.0, 0.3]), np.zeros((3, 3))
    for _ in range(40):
        p = p + np.diag([1e-4, 1e-4, 1e-4])
        fix = add(localizer, line_map, scan(ROOM, pose, rng), pose + 0.01 * rng.standard_normal(3), p)
        p = fix.covariance.copy()
        alive = np.flatnonzero(line_map.line_alive)
        at = np.stack((2 * alive, 2 * alive + 1), axis=1).ravel()
        joint = np.block(
            [[p, localizer._shared[:, at]], [localizer._shared[:, at].T, localizer._lines[np.ix_(at, at)]]]
        )
        np.testing.assert_allclose(joint, joint.T, atol=1e-15)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(joint), 1e-18))
        assert np.linalg.eigvalsh(joint * np.outer(scale, scale)).min() > -1e-6
        assert np.linalg.eigvalsh(fix.relative).min() >= -1e-15
        assert np.trace(fix.relative) <= np.trace(p) + 1e-12
        absolute = localizer.covariance(line_map) - line_map.tables[1].spread[: line_map.rho.size]
        for j in alive:
            sign = np.array([1.0, line_map.line_side[j]])
            own = localizer._lines[2 * j : 2 * j + 2, 2 * j : 2 * j + 2]
            np.testing.assert_allclose(absolute[j], own * np.outer(sign, sign), rtol=1e-9, atol=1e-18)


def test_parallel_walls_20_cm_apart_are_told_apart_or_left_alone():
    """A niche: where the prediction could mean either wall, none is matched."""
    walls = [[-5.0, 3.0, 0.0, 3.0], [0.0, 3.0, 0.0, 3.2], [0.0, 3.2, 5.0, 3.2]]
    walls = [[x2, y2, x1, y1] for x1, y1, x2, y2 in walls]
    rng = np.random.default_rng(4)
    lines = scan(walls, (0.0, 0.0, math.pi / 2), rng)
    for offset, sigma, most in ((0.005, 0.01, 0.01), (0.1, 0.15, 0.1)):
        for sign in (-1, 1):
            twin_map, twin = started(walls, (0.0, 0.0, math.pi / 2), np.random.default_rng(4))
            pose = np.array([0.0, sign * offset, math.pi / 2])
            fix = twin.correct(lines, twin_map, pose, np.diag([sigma**2, sigma**2, 1e-5]))
            assert abs(fix.pose[1]) <= most + 1e-3  # corrected, or left as it was, but never drawn to the other wall
            assert twin_map.rho.size >= 2


def test_two_faces_of_a_thin_wall_do_not_match():
    walls = [[3.0, -4.0, 3.0, 4.0], [3.1, 4.0, 3.1, -4.0]]
    rng = np.random.default_rng(5)
    line_map, localizer = started(walls, (0.0, 0.0, 0.0), rng)
    beyond = scan(walls, (6.0, 0.0, math.pi), rng)
    fix = localizer.correct(beyond, line_map, np.array([5.95, 0.0, math.pi]), np.diag([0.01, 0.01, 1e-4]))
    assert (fix.matched == -1).all()
    np.testing.assert_array_equal(fix.pose, [5.95, 0.0, math.pi])


def test_a_corridor_corrects_across_and_not_along():
    walls = [[0.0, 0.0, 30.0, 0.0], [30.0, 2.0, 0.0, 2.0]]
    rng = np.random.default_rng(6)
    line_map, localizer = started(walls, (10.0, 1.0, 0.0), rng)
    sigma = np.diag([0.04, 0.01, 1e-3])
    fix = localizer.correct(scan(walls, (12.0, 1.0, 0.0), rng), line_map, np.array([12.2, 1.08, 0.03]), sigma)
    assert (fix.matched >= 0).all()
    assert abs(fix.pose[1] - 1.0) < 0.01
    assert abs(fix.pose[2]) < 0.003
    assert fix.covariance[0, 0] > 0.9 * 0.04 > 0.01 > fix.covariance[1, 1]
    # heading the other way, the walls' sides are the wrong ones
    back = localizer.correct(scan(walls, (12.0, 1.0, 0.0), rng), line_map, np.array([12.0, 1.0, math.pi]), sigma)
    assert abs(back.pose[2]) > 3.0


def test_the_same_input_gives_the_same_output():
    (a, _), (b, _) = walk(7, 40), walk(7, 40)
    np.testing.assert_array_equal(a, b)


def test_nothing_known_or_nothing_seen_changes_nothing():
    line_map, localizer = LineMap(), Localizer()
    empty = extract_lines(HALF, np.full(HALF.size, np.inf), SENSOR)
    p = np.diag([0.1, 0.2, 0.3])
    for _, lines in itertools.product(range(2), (empty, scan(ROOM, (2.0, 2.0, 0.0), np.random.default_rng(0)))):
        fix = localizer.correct(lines, LineMap(), np.array([1.0, 2.0, 0.5]), p)
        np.testing.assert_array_equal(fix.pose, [1.0, 2.0, 0.5])
        np.testing.assert_array_equal(fix.covariance, p)
    assert line_map.rho.size == 0
