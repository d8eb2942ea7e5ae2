"""The end-point start: where pieces are parted, against a slow exact twin."""

import math

import numpy as np
import pytest
from line_scenes import HALF, measure

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import extract_lines
from polyexplore_gym.mapping.endpoint import border, divide, misfit
from polyexplore_gym.mapping.fit import fit, normal_variance

pytestmark = pytest.mark.bounds

TWO = SensorConfig(sigma_range=0.02, sigma_angle=math.radians(0.2))


def wall_with_step(step, rng, sensor=TWO):
    walls = [[3.0, -2.5, 3.0, 0.3], [3.0 + step, 0.3, 3.0 + step, 2.5]]
    return measure(walls, np.zeros(3), sensor, rng)


def chi_square(t, e, w):
    """Of the weighted straight line through e over t."""
    root = np.sqrt(w)
    matrix = np.c_[root, root * t]
    found = np.linalg.lstsq(matrix, root * e, rcond=None)[0]
    return float(np.sum((root * e - matrix @ found) ** 2))


@pytest.mark.parametrize("seed", range(5))
def test_the_border_is_where_two_straight_lines_fit_best(seed):
    rng = np.random.default_rng(seed)
    ranges = wall_with_step(0.08, rng)
    hit = np.isfinite(ranges)
    x, y = (ranges[hit] * np.cos(HALF[hit])), (ranges[hit] * np.sin(HALF[hit]))
    v, a = TWO.sigma_range**2, TWO.sigma_angle**2
    rho, alpha, *_ = fit(x, y, np.arange(x.size), v, a)
    k, chi2 = border(x, y, 0, x.size - 1, rho, alpha, v, a)
    c, s = math.cos(alpha), math.sin(alpha)
    t, e = y * c - x * s, x * c + y * s - rho
    w = 1 / np.array([normal_variance(p, q, c, s, v, a) for p, q in zip(x, y, strict=True)])
    expected = [chi_square(t[:q], e[:q], w[:q]) + chi_square(t[q:], e[q:], w[q:]) for q in range(3, x.size - 2)]
    assert k == 3 + int(np.argmin(expected)) - 1
    assert chi2 == pytest.approx(min(expected), rel=1e-6)
    sums = np.array([w.sum(), w @ t, w @ t**2, w @ e, w @ (e * t), w @ e**2])
    assert misfit(sums) == pytest.approx(chi_square(t, e, w), rel=1e-6)
    pieces = divide(x, y, np.array([[0, x.size - 1]]), v, a)
    assert pieces.tolist()[0][0] == 0
    assert pieces.tolist()[-1][1] == x.size - 1
    assert (pieces[1:, 0] == pieces[:-1, 1] + 1).all()
    assert np.abs(y[pieces[:-1, 1]] - 0.3).min() < 0.15


def test_a_step_of_four_sigma_parts_two_lines_and_a_straight_wall_stays_whole():
    """No return leaves the chord over a step of 8 cm by 3.5 sigma of 2 cm, but no one line fits either."""
    parted = whole = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        lines = extract_lines(HALF, wall_with_step(0.08, rng), TWO)
        parted += any(abs(r - 3.0) < 0.02 for r in lines.rho) and any(abs(r - 3.08) < 0.02 for r in lines.rho)
        whole += extract_lines(HALF, wall_with_step(0.0, rng), TWO).rho.size == 1
    assert parted >= 45
    assert whole >= 49
