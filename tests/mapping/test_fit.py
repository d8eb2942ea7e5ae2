"""The weighted fit, its covariance and the algebra of lines, against slow exact twins."""

import math

import numpy as np
import pytest
from line_scenes import HALF, measure
from scipy.optimize import least_squares

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import extract_lines
from polyexplore_gym.mapping.fit import distance2, distance2_shared, fit, fuse, normal_variance, shift, to_map, wrap

pytestmark = pytest.mark.bounds

WALLS = {
    "frontal": ([3.0, -2.0, 3.0, 2.0], False),
    "side": ([1.0, 1.5, 6.0, 1.5], False),
    "off-centre": ([2.0, 2.5, 4.5, 1.5], False),
    "short": ([3.0, 0.8, 3.0, 1.3], True),
}


def polar(wall):
    x1, y1, x2, y2 = wall
    alpha = math.atan2(x1 - x2, y2 - y1)
    rho = x1 * math.cos(alpha) + y1 * math.sin(alpha)
    return (rho, alpha) if rho >= 0 else (-rho, wrap(alpha + math.pi))


def twin(x, y, var_range, var_angle, alpha):
    """scipy on the residuals with the weights frozen, again and again until the weights agree with the line."""
    p = np.array([x.mean() * math.cos(alpha) + y.mean() * math.sin(alpha), alpha])
    for _ in range(60):
        weight = 1 / np.sqrt(
            [
                normal_variance(a, b, math.cos(p[1]), math.sin(p[1]), var_range, var_angle)
                for a, b in zip(x, y, strict=True)
            ]
        )
        p = least_squares(
            lambda q, w=weight: w * (x * math.cos(q[1]) + y * math.sin(q[1]) - q[0]),
            p,
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        ).x
    return p, float(np.sum((weight * (x * math.cos(p[1]) + y * math.sin(p[1]) - p[0])) ** 2))


@pytest.mark.parametrize("seed", range(6))
def test_fit_equals_least_squares(seed):
    rng = np.random.default_rng(seed)
    sensor = SensorConfig(sigma_range=0.02, sigma_angle=math.radians(0.3))
    wall = rng.uniform(-5, 5, 4)
    rho_true, alpha_true = polar(wall)
    full = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    ranges = measure([wall], np.zeros(3), sensor, rng, full)
    hit = np.isfinite(ranges)
    x, y = (ranges * np.cos(full))[hit], (ranges * np.sin(full))[hit]
    v, w = sensor.sigma_range**2, sensor.sigma_angle**2
    rho, alpha, _, _, _, chi2 = fit(x, y, np.arange(x.size), v, w)
    p, expected = twin(x, y, v, w, alpha_true)
    # rough fits of the twin may turn the normal round
    if abs(wrap(p[1] - alpha)) > 1:
        p = np.array([-p[0], p[1] + math.pi])
    np.testing.assert_allclose([rho, wrap(alpha - p[1])], [p[0], 0], atol=1e-7)
    assert chi2 == pytest.approx(expected, rel=1e-5)
    assert abs(rho - rho_true) < 0.2


def nees(rho, alpha, p, true, at):
    if abs(wrap(alpha - true[1])) > math.pi / 2:
        true = (-true[0], true[1] + math.pi)
    offset, cov, var = shift(rho, alpha, p[0, 0], p[0, 1], p[1, 1], at[0], at[1])
    e = np.array([wrap(alpha - true[1]), offset - (true[0] - at[0] * math.cos(true[1]) - at[1] * math.sin(true[1]))])
    return float(e @ np.linalg.solve([[p[0, 0], cov], [cov, var]], e))


@pytest.mark.parametrize("name", WALLS)
def test_covariance_is_consistent(name):
    """Mean NEES of 600 scans (its own deviation: 2 / sqrt(600) = 0.08), for the scan and for the map frame."""
    wall, centroid = WALLS[name]
    sensor, rng = SensorConfig(), np.random.default_rng(5)
    true, sigma, pose = polar(wall), np.array([0.02, 0.02, math.radians(0.5)]), np.array([-6.0, -5.0, 2.5])
    middle = np.array([wall[0] + wall[2], wall[1] + wall[3]]) / 2
    c, s = math.cos(pose[2]), math.sin(pose[2])
    alpha_map = true[1] + pose[2]
    true_map = (true[0] + pose[0] * math.cos(alpha_map) + pose[1] * math.sin(alpha_map), alpha_map)
    middle_map = pose[:2] + np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    own, moved = [], []
    for _ in range(600):
        lines = extract_lines(HALF, measure([wall], np.zeros(3), sensor, rng), sensor)
        assert lines.rho.size == 1
        rho, alpha, p = lines.rho[0], lines.alpha[0], lines.covariance[0]
        own.append(nees(rho, alpha, p, true, middle if centroid else np.zeros(2)))
        line = to_map(rho, alpha, p, pose + rng.normal(0, sigma), np.diag(sigma**2))
        moved.append(nees(*line, true_map, middle_map if centroid else np.zeros(2)))
    assert 1.75 < np.mean(own) < 2.3
    assert 1.75 < np.mean(moved) < 2.3


def random_covariance(rng, n, scale=0.05):
    a = rng.normal(0, scale, (n, n))
    return a @ a.T + 1e-6 * np.eye(n)


@pytest.mark.parametrize("seed", range(10))
def test_to_map_is_the_matrix_formula(seed):
    rng = np.random.default_rng(seed)
    rho, alpha, p = rng.uniform(0, 5), rng.uniform(-3, 3), random_covariance(rng, 2)
    pose, g = rng.uniform(-5, 5, 3), random_covariance(rng, 3)
    rho0, alpha0, p0 = to_map(rho, alpha, p, pose, g)
    a = alpha + pose[2]
    dpsi = pose[1] * math.cos(a) - pose[0] * math.sin(a)
    h = np.array([[1, 0], [dpsi, 1]])
    k = np.array([[0, 0, 1], [math.cos(a), math.sin(a), dpsi]])
    np.testing.assert_allclose(p0, h @ p @ h.T + k @ g @ k.T, rtol=1e-10, atol=1e-12)
    # a point of the line in the robot frame lies on the map line
    t = rng.uniform(-3, 3)
    q = np.array([rho * math.cos(alpha) - t * math.sin(alpha), rho * math.sin(alpha) + t * math.cos(alpha)])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    m = pose[:2] + np.array([c * q[0] - s * q[1], s * q[0] + c * q[1]])
    assert m[0] * math.cos(alpha0) + m[1] * math.sin(alpha0) == pytest.approx(rho0, abs=1e-10)
    assert -math.pi < alpha0 <= math.pi


@pytest.mark.parametrize("seed", range(10))
def test_distance_and_fusion_are_the_information_form(seed):
    rng = np.random.default_rng(seed)
    p1, p2 = random_covariance(rng, 2, 0.02), random_covariance(rng, 2, 0.02)
    l1 = np.array([math.pi - 0.005, 2.0])  # alpha, rho: across the seam of the angle
    l2 = np.array([-math.pi + 0.01, 2.01])
    d = np.array([wrap(l1[0] - l2[0]), l1[1] - l2[1]])
    d2 = distance2(l1[1], l1[0], p1, l2[1], l2[0], p2, 0.0, 0.0)
    assert d2 == pytest.approx(d @ np.linalg.solve(p1 + p2, d), rel=1e-9)
    rho, alpha, p, _, _ = fuse(l1[1], l1[0], p1, l2[1], l2[0], p2, np.zeros((2, 2)), 0.0, 0.0)
    i1, i2 = np.linalg.inv(p1), np.linalg.inv(p2)
    expected = np.linalg.inv(i1 + i2)
    np.testing.assert_allclose(p, expected, rtol=1e-8)
    mean = expected @ (i1 @ l1 + i2 @ (l1 - d))
    np.testing.assert_allclose([wrap(alpha - mean[0]), rho], [0, mean[1]], atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_lines_with_a_common_error_are_fused_with_the_least_variance(seed):
    """Against generalised least squares with the whole covariance of both; at any place the same."""
    rng = np.random.default_rng(seed)
    joint = random_covariance(rng, 4, 0.02)
    joint[:2, :2] += 1e-4 * np.eye(2)
    p1, x, p2 = joint[:2, :2], joint[:2, 2:], joint[2:, 2:]
    l1, l2 = np.array([0.7, 2.0]), np.array([0.7, 2.003])
    h = np.vstack([np.eye(2), np.eye(2)])
    expected = np.linalg.inv(h.T @ np.linalg.solve(joint, h))
    mean = expected @ h.T @ np.linalg.solve(joint, np.concatenate([l1, l2]))
    d = l1 - l2
    for at in ((0.0, 0.0), (3.0, -2.0)):
        rho, alpha, p, a, b = fuse(l1[1], l1[0], p1, l2[1], l2[0], p2, x, *at)
        np.testing.assert_allclose(p, expected, rtol=0.02, atol=1e-7)
        np.testing.assert_allclose([alpha, rho], mean, atol=1e-4)
        both = np.hstack([a, b])
        np.testing.assert_allclose(p, both @ joint @ both.T, rtol=1e-9)
        d2 = distance2_shared(l1[1], l1[0], p1, l2[1], l2[0], p2, x, *at)
        assert d2 == pytest.approx(d @ np.linalg.solve(p1 + p2 - x - x.T, d), rel=1e-6)
    none = distance2_shared(l1[1], l1[0], p1, l2[1], l2[0], p2, np.zeros((2, 2)), 3.0, -2.0)
    assert none == pytest.approx(distance2(l1[1], l1[0], p1, l2[1], l2[0], p2, 3.0, -2.0), rel=1e-9)


def test_shift_there_and_back():
    rho, alpha, p = 3.0, 0.7, np.array([[1e-4, 2e-4], [2e-4, 1e-3]])
    o, cov, var = shift(rho, alpha, p[0, 0], p[0, 1], p[1, 1], 20.0, -7.0)
    back = shift(o, alpha, p[0, 0], cov, var, -20.0, 7.0)
    np.testing.assert_allclose(back, [rho, p[0, 1], p[1, 1]], atol=1e-12)
