"""The pose graph and the odometry of SLAM."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from slam_scenes import drifted, rounds

from polyexplore_gym.errors import InvalidLogError
from polyexplore_gym.mapping import LaserLog, Track
from polyexplore_gym.mapping.logs.poses import between, compose, wrap
from polyexplore_gym.mapping.logs.record import Way
from polyexplore_gym.mapping.slam.graph import Edges, _linear, covariances, errors, local_covariances, solve
from polyexplore_gym.mapping.slam.odometry import Calibration, calibrate, calibrated, filled, spread, way_of


def graph(rng, n=25, robust=False, noise=0.05):
    """True poses, and a graph of a chain with three loops whose edges err as they say, times `noise`."""
    true = np.cumsum(np.c_[rng.normal(0.5, 0.5, (n, 2)), rng.normal(0, 0.4, n)], axis=0)
    true[:, 2] = wrap(true[:, 2])
    rows = []
    for i, j in [*((k - 1, k) for k in range(1, n)), (0, n - 1), (3, n - 4), (5, n // 2)]:
        a = rng.normal(0, 1, (3, 3))
        covariance = noise**2 * (a @ a.T + 0.3 * np.eye(3))
        off = rng.multivariate_normal(np.zeros(3), covariance)
        rows.append((i, j, compose(between(true[i], true[j]), off), np.linalg.inv(covariance), robust))
    return true, Edges.of(rows)


def chained(edges, first, n):
    """Poses by the chain alone."""
    out = [first]
    for k in range(n - 1):
        out.append(compose(out[-1], edges.measured[k]))
    return np.array(out)


def test_derivatives_are_those_of_differences():
    true, edges = graph(np.random.default_rng(0))
    poses = true + np.random.default_rng(1).normal(0, 0.3, true.shape)
    off, by_first, by_second, _ = _linear(poses, edges)
    for k, (i, j) in enumerate(edges.ends):
        for end, derivative in ((i, by_first[k]), (j, by_second[k])):
            for c in range(3):
                step = np.zeros(3)
                step[c] = 1e-6
                sides = []
                for sign in (1, -1):
                    moved = poses.copy()
                    moved[end] = compose(poses[end], sign * step)
                    sides.append(between(edges.measured[k], between(moved[i], moved[j])))
                np.testing.assert_allclose(wrap(sides[0] - sides[1]) / 2e-6, derivative[:, c], atol=1e-6)
    np.testing.assert_allclose(off, [between(m, between(poses[i], poses[j])) for m, (i, j) in
                                     zip(edges.measured, edges.ends, strict=True)])  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_that_of_plain_least_squares(seed):
    true, edges = graph(np.random.default_rng(seed))
    roots = np.linalg.cholesky(edges.information).transpose(0, 2, 1)

    def residuals(flat):
        poses = np.concatenate([true[:1], flat.reshape(-1, 3)])
        i, j = edges.ends.T
        return np.einsum("kab,kb->ka", roots, between(edges.measured, between(poses[i], poses[j]))).ravel()

    begin = chained(edges, true[0], len(true))
    exact = least_squares(residuals, begin[1:].ravel(), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    got = solve(begin, edges)
    np.testing.assert_allclose(errors(got, edges).sum(), 2 * exact.cost, rtol=1e-5)
    np.testing.assert_allclose(between(got[1:], exact.x.reshape(-1, 3)), 0.0, atol=2e-3)
    np.testing.assert_array_equal(got[0], true[0])


def test_covariances_are_blocks_of_the_inverse():
    true, edges = graph(np.random.default_rng(5), robust=True)
    poses = solve(chained(edges, true[0], len(true)), edges)
    _, first, second, weighted = _linear(poses, edges)
    n = len(poses)
    h = np.zeros((3 * n, 3 * n))
    for k, (i, j) in enumerate(edges.ends):
        a = np.zeros((3, 3 * n))
        a[:, 3 * i : 3 * i + 3], a[:, 3 * j : 3 * j + 3] = first[k], second[k]
        h += a.T @ weighted[k] @ a
    inverse = np.linalg.inv(h[3:, 3:])
    got, local = covariances(poses, edges), local_covariances(poses, edges)
    assert not got[0].any()
    for k in range(n):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        at = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(local[k], turn @ np.linalg.inv(h[at, at]) @ turn.T, rtol=1e-9, atol=1e-15)
        if k:
            at = slice(3 * k - 3, 3 * k)
            np.testing.assert_allclose(got[k], turn @ inverse[at, at] @ turn.T, rtol=1e-9, atol=1e-15)


def test_the_covariances_say_how_far_poses_are_off():
    """NEES over 60 graphs; 3 is right."""
    nees = []
    for seed in range(60):
        true, edges = graph(np.random.default_rng(100 + seed), noise=0.01)
        poses = solve(chained(edges, true[0], len(true)), edges)
        covariance = covariances(poses, edges)
        off = true - poses
        off[:, 2] = wrap(off[:, 2])
        nees += [float(e @ np.linalg.solve(p, e)) for e, p in zip(off[1:], covariance[1:], strict=True)]
    assert 2.6 < np.mean(nees) < 3.4


def test_wrong_loops_are_overruled():
    rng = np.random.default_rng(2)
    true, edges = graph(rng, noise=0.02)
    wrong = [(i, j, rng.normal(0, 3, 3), 1e4 * np.eye(3), True) for i, j in ((1, 20), (4, 15), (2, 22))]
    every = Edges(*(np.concatenate(both) for both in zip(edges, Edges.of(wrong), strict=True)))
    begin = chained(edges, true[0], len(true))
    off = between(solve(begin, edges), solve(begin, every))
    assert np.abs(off).max() < 0.01
    trusted = every._replace(robust=np.zeros(len(every.robust), bool))
    assert np.abs(between(solve(begin, edges), solve(begin, trusted))).max() > 0.3


def test_a_graph_of_one_pose():
    one = np.array([[1.0, 2.0, 0.5]])
    np.testing.assert_array_equal(covariances(one, Edges.of([])), np.zeros((1, 3, 3)))
    np.testing.assert_array_equal(local_covariances(one, Edges.of([])), np.zeros((1, 3, 3)))


def test_what_is_wrong_with_odometry_is_found():
    rng = np.random.default_rng(3)
    robot = rounds(2, 0.4)
    laser = compose(robot, np.array([0.25, -0.1, 0.0]))
    odometry = drifted(robot, rng, veer=0.04, noise=(0.003, 0.003))
    way = Way(np.full(len(robot), math.nan), odometry, np.arange(len(robot)))
    found, error = calibrate(way, np.arange(len(robot)), laser)
    assert found.x == pytest.approx(0.25, abs=0.01)
    assert found.y == pytest.approx(-0.1, abs=0.01)
    assert found.along == pytest.approx(1 / 0.96, abs=0.01)
    assert found.turn == pytest.approx(1 / 1.03, abs=0.01)
    assert found.veer == pytest.approx(-0.04 / 1.03, abs=0.005)
    assert error.xy < 0.02
    # it leads on as the laser went, until noise has its way
    went = compose(laser[0], between(calibrated(odometry, found)[0], calibrated(odometry, found)))
    assert np.hypot(*(went - laser)[:40, :2].T).max() < 0.15
    assert np.hypot(*(compose(laser[0], between(odometry[0], odometry)) - laser)[:40, :2].T).max() > 0.5
    # too little to tell by
    assert calibrate(way, np.arange(20), laser[:20])[0] == Calibration()


def filled_plainly(odometry, at, poses):
    """The slow twin of `filled` between two known poses."""
    out = np.full(odometry.shape, np.nan)
    for (i, j), a, b in zip(np.c_[at[:-1], at[1:]], poses[:-1], poses[1:], strict=True):
        steps = between(odometry[i:j], odometry[i + 1 : j + 1])
        length = np.hypot(steps[:, 0], steps[:, 1])
        turned = np.abs(steps[:, 2]) + 0.05 * length
        miss = wrap(b[2] - a[2] - steps[:, 2].sum())
        heading = a[2] + np.r_[0, np.cumsum(steps[:, 2] + miss * turned / turned.sum())]
        x, y = a[0], a[1]
        way = [(x, y)]
        for (dx, dy, _), h in zip(steps, heading, strict=False):
            x, y = x + math.cos(h) * dx - math.sin(h) * dy, y + math.sin(h) * dx + math.cos(h) * dy
            way.append((x, y))
        gone = np.r_[0, np.cumsum(length)] / length.sum()
        out[i : j + 1, :2] = np.array(way) + gone[:, None] * (b[:2] - way[-1])
        out[i : j + 1, 2] = wrap(heading)
    return out


def test_odometry_between_known_poses_is_bent_to_fit():
    rng = np.random.default_rng(4)
    true = rounds(1, 0.1)
    odometry = drifted(true, rng, noise=(0.004, 0.01))
    at = np.arange(5, len(true) - 5, 7)
    got = filled(odometry, at, true[at])
    inside = slice(at[0], at[-1] + 1)
    np.testing.assert_allclose(between(got, filled_plainly(odometry, at, true[at]))[inside], 0.0, atol=1e-9)
    np.testing.assert_allclose(between(got[at], true[at]), 0.0, atol=1e-9)
    np.testing.assert_allclose(between(got[:5], got[1:6]), between(odometry[:5], odometry[1:6]), atol=1e-9)
    np.testing.assert_allclose(between(got[-5:-1], got[-4:]), between(odometry[-5:-1], odometry[-4:]), atol=1e-9)
    assert np.hypot(*(got - true)[inside, :2].T).max() < 0.05
    # a robot that stands
    still = np.zeros((4, 3))
    np.testing.assert_array_equal(filled(still, np.array([1, 2]), still[:2]), still)


def test_equal_stamps_get_times_of_their_own():
    stamps = np.array([1.0, 1.001, 1.001, 1.001, 1.003, 1.004, 1.004, 1.01])
    got = spread(stamps, np.array([2, 5]))
    assert (np.diff(got) > 0).all()
    assert np.abs(got - stamps).max() <= 0.0005
    assert got[2] == stamps[2]
    assert got[5] == stamps[5]
    np.testing.assert_array_equal(got[[0, 4, 7]], stamps[[0, 4, 7]])
    np.testing.assert_array_equal(spread(np.array([3.0]), np.array([0])), [3.0])


def test_where_odometry_comes_from():
    angles, ranges, odometry = np.linspace(-1, 1, 9), np.ones((3, 9)), np.arange(9.0).reshape(3, 3)
    log = LaserLog(angles, ranges, odometry, poses_are="unknown", times=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(way_of(log).poses, odometry)
    track = Track(np.array([0.5, 1.5, 2.5, 3.5]), np.arange(12.0).reshape(4, 3))
    timed = way_of(LaserLog(angles, ranges, None, times=np.array([1.0, 2.0, 3.0]), track=track))
    np.testing.assert_array_equal(timed.stamps, [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5])
    np.testing.assert_array_equal(timed.scans, [1, 3, 5])
    np.testing.assert_allclose(timed.poses[1], [1.5, 2.5, 3.5])
    with pytest.raises(InvalidLogError, match="no odometry to go by: by hand"):
        way_of(LaserLog(angles, ranges, odometry, poses_are="corrected", why="by hand"))
