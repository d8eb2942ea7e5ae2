"""LineMap: merging across scans, sides, doorways, slots."""

import numpy as np

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import LineMap, extract_lines


def test_a_room_seen_again_keeps_its_rows():
    sensor = SensorConfig()
    rng = np.random.default_rng(0)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 361)
    line_map = LineMap(sensor=sensor)
    for _ in range(5):
        c, s = np.cos(angles + rng.normal(0, sensor.sigma_angle, 361)), np.sin(angles)
        ranges = np.min(np.where(c > 1e-9, 3 / c, np.inf)[None] * 1, axis=0)
        ranges = np.minimum(ranges, np.where(s > 1e-9, 2 / np.maximum(s, 1e-9), np.inf))
        ranges = np.minimum(ranges, np.where(s < -1e-9, 2.5 / np.maximum(-s, 1e-9), np.inf))
        ranges = ranges + rng.normal(0, sensor.sigma_range, 361)
        line_map.insert(extract_lines(angles, ranges, sensor), np.zeros(3), np.zeros((3, 3)))
    assert line_map.alive.sum() == 3
    np.testing.assert_allclose(np.sort(line_map.rho), [2.0, 2.5, 3.0], atol=0.01)
