"""Grouping switched off, as the ablation does it: what the Hough transform finds stays as it is."""

import dataclasses
import math

import numpy as np
import pytest
from line_scenes import HALF, box, jagged_room, measure

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping import LineMap, extract_lines
from polyexplore_gym.mapping.hough import RASTER, take_each

pytestmark = pytest.mark.bounds

SENSOR = SensorConfig(sigma_range=0.02, sigma_angle=math.radians(0.2))
ROOM = box(-1, -2, 3, 2.5)
APART = MappingConfig(start="hough", grouping=False)


def scan(walls, pose, seed, config):
    ranges = measure(walls, np.asarray(pose, float), SENSOR, np.random.default_rng(seed))
    return extract_lines(HALF, ranges, SENSOR, config)


def test_without_grouping_walls_are_doubled():
    """Every line still lies along one of the three walls in view, but there are more of them than walls."""
    grouped = [scan(ROOM, (0, 0, 0), seed, MappingConfig(start="hough")) for seed in range(10)]
    apart = [scan(ROOM, (0, 0, 0), seed, APART) for seed in range(10)]
    assert all(lines.rho.size == 3 for lines in grouped)
    assert sum(lines.rho.size for lines in apart) > 45
    for lines in apart:
        walls = np.array([[3.0, 0.0], [2.5, 0.5 * math.pi], [2.0, -0.5 * math.pi]])
        middle = 0.5 * (lines.segments[:, :2] + lines.segments[:, 2:])
        off = np.abs(middle[:, :1] * np.cos(walls[:, 1]) + middle[:, 1:] * np.sin(walls[:, 1]) - walls[:, 0])
        assert (off.min(1) < 0.08).all()


@pytest.mark.parametrize("seed", range(5))
def test_each_line_takes_the_free_returns_within_a_pixel(seed):
    rng = np.random.default_rng(seed)
    x, y, ends = rng.uniform(-1, 1, 800), rng.uniform(-0.2, 0.2, 800), rng.uniform(-1, 1, (12, 4))
    ends[:, 1::2] *= 0.2
    expected, count = np.full(800, -1), 0
    for a, b, c, d in ends:
        ux, uy = np.array([c - a, d - b]) / math.hypot(c - a, d - b)
        t, off = (x - a) * ux + (y - b) * uy, np.abs((y - b) * ux - (x - a) * uy)
        on = (expected < 0) & (off <= RASTER) & (t >= -RASTER) & (t <= math.hypot(c - a, d - b) + RASTER)
        if on.sum() >= 6:
            expected[on] = count
            count += 1
    label = np.full(800, -1)
    assert take_each(x, y, ends, label, 6, RASTER) == count > 3
    np.testing.assert_array_equal(label, expected)


def test_without_grouping_lines_enter_the_map_as_if_from_scans_of_their_own():
    together, single = LineMap(APART, SENSOR), LineMap(MappingConfig(start="hough"), SENSOR)
    rng = np.random.default_rng(0)
    for seed in range(12):
        pose = np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-math.pi, math.pi)])
        covariance = np.diag([0.02, 0.02, math.radians(0.5)]) ** 2
        lines = dataclasses.replace(scan(jagged_room(rng), pose, seed, APART), fragments=np.zeros((0, 4)), lone=None)
        together.insert(lines, pose, covariance)
        for i in range(lines.rho.size):
            own = lines.segment_line == i
            one = dataclasses.replace(
                lines,
                rho=lines.rho[i : i + 1],
                alpha=lines.alpha[i : i + 1],
                covariance=lines.covariance[i : i + 1],
                segments=lines.segments[own],
                segment_line=np.zeros(own.sum(), int),
            )
            single.insert(one, pose, covariance)
    assert together.line_alive.sum() > 20
    for name in ("segments", "alive", "line", "side", "rho", "alpha", "covariance", "line_alive"):
        np.testing.assert_array_equal(getattr(together, name), getattr(single, name))
