"""extract_lines: doorways, occluders, thin and oblique walls, odd input."""

import math

import numpy as np
import pytest
from line_scenes import HALF, box, cast, distance, ends_on, jagged_room, measure

from polyexplore_gym.config import MappingConfig, SensorConfig
from polyexplore_gym.mapping import extract_lines

pytestmark = pytest.mark.bounds

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


FIELDS = ("rho", "alpha", "covariance", "segments", "segment_line", "point_segment", "fragments", "smoothed")


def assert_same(a, b, **tolerance):
    for name in FIELDS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), **tolerance, err_msg=name)


@pytest.mark.parametrize("start", ["endpoint", "hough"])
@pytest.mark.parametrize("unknown", [np.nan, 0.0, -1.0, -np.inf, 1e-7])
def test_a_beam_of_which_nothing_is_known_is_as_if_it_were_not_there(unknown, start):
    config = MappingConfig(start=start)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        _, ranges = seen(jagged_room(rng), seed=seed)
        gone = rng.random(361) < 0.3
        gone[[0, -1]] = False
        lines = extract_lines(HALF, np.where(gone, unknown, ranges), config=config)
        assert_same(lines, extract_lines(HALF, np.where(gone, np.nan, ranges), config=config))
        assert (lines.point_segment[gone] == -1).all()
        assert np.isnan(lines.smoothed[gone]).all()
        assert np.isfinite(lines.smoothed[~gone]).all()
        walls = np.vstack([lines.segments, lines.fragments])
        assert (distance(ends_on(HALF[~gone], ranges[~gone]), walls) < 0.08).all()


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_walls_are_found_through_beams_that_are_missing(share):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        walls, sensor = box(-1, -2, 3, 2.5), SENSOR
        ranges = measure(walls, ROBOT, sensor, rng)
        gone = rng.random(361) < share if share < 0.5 else np.arange(361) % 2 == 1
        lines = extract_lines(HALF, np.where(gone, np.nan, ranges), sensor)
        np.testing.assert_allclose(np.sort(lines.rho), [2.0, 2.5, 3.0], atol=0.015)
        assert len(lines.segments) == 3


def test_unknown_beams_are_no_doorway():
    """Where nothing is known within a wall it is not cut; where beams pass it is."""
    ranges = cast([[3, -2.5, 3, 2.5]], ROBOT, HALF)
    middle = np.abs(np.degrees(HALF)) < 4.0
    for value, pieces in ((np.nan, 1), (0.0, 1), (np.inf, 2), (6.0, 2)):
        lines = extract_lines(HALF, np.where(middle, value, ranges), SENSOR)
        wall = np.flatnonzero(np.abs(lines.rho - 3.0) < 0.1)
        assert np.isin(lines.segment_line, wall).sum() == pieces, value


def test_the_order_of_the_beams_does_not_matter():
    rng = np.random.default_rng(0)
    for seed in range(5):
        walls = jagged_room(np.random.default_rng(seed))
        expected, ranges = seen(walls, seed=seed)
        unordered = rng.permutation(361)
        wide = np.linspace(-2.5, 2.0, 361)
        far = measure(walls, ROBOT, SENSOR, rng, wide)
        for angles, values in ((HALF, ranges), (wide, far)):
            expected = extract_lines(angles, values)
            reversed_ = extract_lines(angles[::-1], values[::-1])
            for name in FIELDS:
                got = getattr(reversed_, name)
                got = got[::-1] if name in ("point_segment", "smoothed") else got
                np.testing.assert_array_equal(got, getattr(expected, name))
            mixed = extract_lines(angles[unordered], values[unordered])
            back = np.argsort(unordered)
            np.testing.assert_array_equal(mixed.point_segment[back], expected.point_segment)
            np.testing.assert_allclose(mixed.rho, expected.rho, atol=1e-9)
        # mounted backwards: from pi to -pi in the middle, counted from -pi or from 0
        turned = wide + math.pi
        for wrapped in (np.where(turned > math.pi, turned - 2 * math.pi, turned), turned % (2 * math.pi)):
            assert_same(extract_lines(wrapped, far), extract_lines(turned, far), rtol=1e-9, atol=1e-9)


def test_a_full_turn_may_begin_anywhere():
    ranges = cast(jagged_room(np.random.default_rng(1)), ROBOT, FULL)
    expected = extract_lines(FULL, ranges, ROUND)
    positive = FULL % (2 * math.pi)
    for angles, values in ((positive, ranges), (np.roll(FULL, 100), np.roll(ranges, 100)), (FULL[::-1], ranges[::-1])):
        lines = extract_lines(angles, values, ROUND)
        np.testing.assert_allclose(np.sort(lines.rho), np.sort(expected.rho), atol=1e-9)
    # both ends of a full turn are one beam, twice; a step that was rounded may overlap a little
    for step in (2 * math.pi / 720, 0.008727, 0.0088):
        angles = -math.pi + step * np.arange(721)
        lines = extract_lines(angles, cast(box(-2, -2, 3, 2.5), ROBOT, angles), ROUND)
        np.testing.assert_allclose(np.sort(lines.rho), [2, 2, 2.5, 3], atol=1e-3)


def test_whatever_the_readings_are_the_lines_are_sound():
    odd = [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-300, 1e-6, 1e300]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 120))
        angles = rng.choice(np.r_[np.linspace(-math.pi, math.pi, 60), np.nan, np.inf], n)
        ranges = rng.choice(np.r_[odd, rng.uniform(0, 10, 20)], n)
        config = MappingConfig(start="hough" if seed % 4 == 0 else "endpoint")
        lines = extract_lines(angles, ranges, ROUND if seed % 2 else SENSOR, config)
        for name in ("rho", "alpha", "covariance", "segments", "fragments"):
            assert np.isfinite(getattr(lines, name)).all()
        unknown = ~(np.isfinite(angles) & (ranges >= 1e-6))
        np.testing.assert_array_equal(np.isnan(lines.smoothed), unknown)
        assert (lines.point_segment[unknown] == -1).all()


def test_what_lies_between_far_beams_of_a_wall_is_no_wall():
    """Single returns far off on an oblique wall lie on it, and do not stick out of it as pieces across their beams."""
    sensor, config = SensorConfig(beams=181, max_range=30.0, sigma_angle=0.002), MappingConfig(range_floor=0.01)
    angles = np.linspace(-math.pi / 2, math.pi / 2, 181)
    lines = extract_lines(angles, 4.0 / np.maximum(np.cos(angles), 1e-9), sensor, config)
    assert len(lines.segments) == 1
    assert len(lines.fragments) == 28  # all returns a door's width apart, 14 on each side
    np.testing.assert_allclose(lines.fragments[:, [0, 2]], 4.0, atol=1e-6)
    # The free space on the left; a fifth of a door's width long: what lies between far beams is not known.
    np.testing.assert_allclose(lines.fragments[:, 3] - lines.fragments[:, 1], 0.1, rtol=0.01)
    # a pole beside the wall is still a piece across its beam
    ranges = 4.0 / np.maximum(np.cos(angles), 1e-9)
    ranges[160] = 2.0
    pole = extract_lines(angles, ranges, sensor, config).fragments
    assert (np.abs(np.hypot(*pole[:, :2].T) - 2.0) < 0.01).sum() == 1


def test_bad_input_is_named():
    good = np.full(361, 2.0)
    assert extract_lines(HALF, np.full(361, 1e-6)).point_segment.shape == (361,)
    with pytest.raises(ValueError, match="361 and 360"):
        extract_lines(HALF, good[:-1])
    with pytest.raises(ValueError, match=r"angles must be one-dimensional, got shape \(1, 361\)"):
        extract_lines(HALF[None], good[None])
    with pytest.raises(ValueError, match="ranges must be one-dimensional"):
        extract_lines(HALF, np.float64(2.0))
    with pytest.raises(ValueError, match="ranges must be real numbers, got complex128"):
        extract_lines(HALF, good + 1j)
    with pytest.raises(ValueError, match="angles must be real numbers, got <U"):
        extract_lines(["a"] * 361, good)
