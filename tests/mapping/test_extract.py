"""extract_lines: doorways, occluders, thin and oblique walls, odd input."""

import math

import numpy as np
import pytest
from line_scenes import HALF, box, cast, distance, ends_on, jagged_room, measure

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping import extract_lines

SENSOR = SensorConfig()
FIVE = SensorConfig(sigma_range=0.05, sigma_angle=math.radians(0.5))
FULL = np.linspace(-math.pi, math.pi, 720, endpoint=False)
ROUND = SensorConfig(beams=720, field_of_view=2 * math.pi)
ROBOT = np.zeros(3)


def seen(walls, sensor=SENSOR, seed=0, angles=HALF, config=None):
    ranges = measure(walls, ROBOT, sensor, np.random.default_rng(seed), angles)
    return extract_lines(angles, ranges, sensor, config), ranges


@pytest.mark.parametrize("start", ["endpoint", "hough"])
def test_a_room(start):
    lines, ranges = seen(box(-1, -2, 3, 2.5), config=MappingConfig(start=start))
    np.testing.assert_allclose(np.sort(lines.rho), [2.0, 2.5, 3.0], atol=0.01)
    assert len(lines.segments) == 3
    assert (lines.point_segment >= 0).mean() > 0.97
    # every return lies near its own segment
    for k in range(3):
        own = np.where(lines.point_segment == k, ranges, np.inf)
        assert distance(ends_on(HALF, own), lines.segments[k : k + 1]).max() < 0.06


@pytest.mark.parametrize("sensor", [SENSOR, FIVE])
@pytest.mark.parametrize("seed", range(5))
def test_a_doorway_parts_the_segments_of_one_line(sensor, seed):
    walls = [[3, -2.5, 3, -0.45], [3, 0.45, 3, 2.5], [6, -4, 6, 4]]
    lines, _ = seen(walls, sensor, seed)
    front = np.flatnonzero(np.abs(lines.rho - 3) < 0.1)
    assert front.size == 1
    pieces = np.flatnonzero(lines.segment_line == front[0])
    assert pieces.size == 2
    low, high = np.sort(lines.segments[pieces][:, [1, 3]], axis=1)[np.argsort(lines.segments[pieces, 1])]
    assert high[0] - low[1] > 0.75
    y = 3 * np.tan(HALF)
    left, right = lines.point_segment[(y > 0.7) & (y < 2.2)], lines.point_segment[(y < -0.7) & (y > -2.2)]
    assert set(left[left >= 0]).isdisjoint(right[right >= 0])


def test_a_doorway_beyond_the_range_of_the_sensor():
    """No return through the door: still free space, not wall."""
    lines, ranges = seen([[3, -2.5, 3, -0.45], [3, 0.45, 3, 2.5]])
    assert np.isinf(ranges).any()
    assert len(lines.segments) == 2


def test_an_occluder_says_nothing():
    pole = box(1.95, -0.03, 2.05, 0.03)
    lines, _ = seen([[3, -2.5, 3, 2.5], *pole])
    wall = np.flatnonzero(np.abs(lines.rho - 3) < 0.1)
    assert (lines.segment_line == wall[0]).sum() == 1  # a narrow shadow is bridged
    cupboard = box(1.9, -0.6, 2.0, 0.6)
    lines, _ = seen([[3, -3.5, 3, 3.5], *cupboard])
    wall = np.flatnonzero(np.abs(lines.rho - 3) < 0.1)
    assert (lines.segment_line == wall[0]).sum() == 2  # one wider than a door is not


@pytest.mark.parametrize("step", [0.3, 1.0])
def test_no_line_over_a_range_jump(step):
    walls = [[2, -2, 2, 0], [2 + step, 0, 2 + step, 2]]
    for seed in range(10):
        lines, _ = seen(walls, FIVE if step > 0.5 else SENSOR, seed)
        pieces = np.vstack([lines.segments, lines.fragments])
        t = np.linspace(0, 1, 50)[:, None, None]
        points = (pieces[:, :2] + t * (pieces[:, 2:] - pieces[:, :2])).reshape(-1, 2)
        assert distance(points, np.array(walls, float)).max() < 0.16
        assert np.isclose(lines.rho, 2, atol=0.1).any()
        assert np.isclose(lines.rho, 2 + step, atol=0.1).any()


def test_an_oblique_wall_is_one_segment():
    for seed in range(10):
        lines, _ = seen([[0.5, 1.0, 6.0, 1.0]], seed=seed)
        assert len(lines.segments) == 1
        assert np.ptp(lines.segments[0, [0, 2]]) > 4


@pytest.mark.parametrize("sensor", [SENSOR, FIVE])
def test_every_return_is_represented(sensor):
    for seed in range(10):
        walls = jagged_room(np.random.default_rng(seed))
        lines, ranges = seen(walls, sensor, seed)
        pieces = np.vstack([lines.segments, lines.fragments])
        points = ends_on(HALF, ranges)
        sigma = np.sqrt(sensor.sigma_range**2 + (sensor.sigma_angle * np.hypot(*points.T)) ** 2)
        assert (distance(points, pieces) <= 4.5 * sigma).all()
        t = np.linspace(0, 1, 30)[:, None, None]
        middle = (pieces[:, :2] + t * (pieces[:, 2:] - pieces[:, :2])).reshape(-1, 2)
        assert distance(middle, walls).max() < 0.05 + 4.5 * sigma.max()


def test_smoothed_ranges_are_nearer_to_the_truth():
    walls = box(-1, -2, 3, 2.5)
    lines, ranges = seen(walls, FIVE)
    true = cast(walls, ROBOT, HALF)
    on = lines.point_segment >= 0
    np.testing.assert_array_equal(lines.smoothed[~on], np.where(ranges < FIVE.max_range, ranges, np.inf)[~on])
    steady = on & (np.abs(np.gradient(true)) < 0.05)
    assert np.std((lines.smoothed - true)[steady]) < 0.4 * np.std((ranges - true)[steady])


def test_full_circle_does_not_depend_on_the_first_beam():
    walls = box(-2, -2, 3, 2.5)
    found = []
    for turn in (0.0, 1.0, 2.5, -2.0):
        ranges = cast(walls, (0, 0, turn), FULL)
        lines = extract_lines(FULL, ranges, ROUND)
        found.append(np.sort(lines.rho))
        assert (lines.point_segment >= 0).all()
    for rho in found:
        np.testing.assert_allclose(rho, [2, 2, 2.5, 3], atol=1e-3)


def test_normal_points_away_and_free_space_lies_left():
    for seed in range(5):
        lines, _ = seen(jagged_room(np.random.default_rng(seed)), seed=seed)
        assert (lines.rho >= 0).all()
        assert ((lines.alpha > -math.pi) & (lines.alpha <= math.pi)).all()
        x1, y1, x2, y2 = lines.segments.T
        assert ((x2 - x1) * (0 - y1) - (y2 - y1) * (0 - x1) > 0).all()


@pytest.mark.parametrize("n", [0, 1, 2, 361])
def test_nothing_seen(n):
    angles = np.linspace(-1, 1, n)
    lines = extract_lines(angles, np.full(n, np.inf))
    assert lines.rho.shape == (0,)
    assert lines.covariance.shape == (0, 2, 2)
    assert lines.segments.shape == lines.fragments.shape == (0, 4)
    assert lines.point_segment.shape == lines.smoothed.shape == (n,)
    assert (lines.point_segment == -1).all()
    assert np.isinf(lines.smoothed).all()


def test_a_lone_return_is_a_tiny_fragment():
    ranges = np.full(361, np.inf)
    ranges[100] = 4.0
    lines = extract_lines(HALF, ranges)
    assert lines.fragments.shape == (1, 4)
    assert np.hypot(*(lines.fragments[0, 2:] - lines.fragments[0, :2])) == pytest.approx(4 * np.pi / 360, rel=0.01)


@pytest.mark.parametrize("start", ["endpoint", "hough"])
def test_without_noise(start):
    sensor = SensorConfig(sigma_range=0.0, sigma_angle=0.0)
    ranges = cast(box(-1, -2, 3, 2.5), ROBOT, HALF)
    lines = extract_lines(HALF, ranges, sensor, MappingConfig(start=start))
    np.testing.assert_allclose(np.sort(lines.rho), [2.0, 2.5, 3.0], atol=1e-6)
    assert np.isfinite(lines.covariance).all()


@pytest.mark.parametrize("start", ["endpoint", "hough"])
def test_the_same_scan_gives_the_same_lines(start):
    config = MappingConfig(start=start)
    a, _ = seen(jagged_room(np.random.default_rng(3)), config=config)
    b, _ = seen(jagged_room(np.random.default_rng(3)), config=config)
    for name in ("rho", "alpha", "covariance", "segments", "segment_line", "point_segment", "fragments", "smoothed"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_bad_input_is_named():
    good = np.full(361, 2.0)
    nan = good.copy()
    nan[7] = np.nan
    with pytest.raises(ValueError, match="beam 7 is NaN"):
        extract_lines(HALF, nan)
    negative = good.copy()
    negative[3] = -1
    with pytest.raises(ValueError, match=r"beam 3 is -1\.0"):
        extract_lines(HALF, negative)
    with pytest.raises(ValueError, match="beam 0 is 1e-300"):
        extract_lines(HALF, np.full(361, 1e-300))
    assert extract_lines(HALF, np.full(361, 1e-6)).point_segment.shape == (361,)
    with pytest.raises(ValueError, match="361 and 360"):
        extract_lines(HALF, good[:-1])
    with pytest.raises(ValueError, match="increase strictly"):
        extract_lines(HALF[::-1], good)
    with pytest.raises(ValueError, match="one-dimensional"):
        extract_lines(HALF[None], good[None])
    bad = HALF.copy()
    bad[-1] = np.inf
    with pytest.raises(ValueError, match="must be finite"):
        extract_lines(bad, good)
