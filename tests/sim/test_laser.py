import math

import numpy as np
import pytest
import shapely
from sim_scenes import boxed, lines_of, random_walls

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim.laser import MIN_RANGE, Laser, cast_rays

pytestmark = pytest.mark.bounds


def exact_ranges(walls: np.ndarray, x: float, y: float, angles: np.ndarray, max_range: float) -> np.ndarray:
    """Nearest intersection of each ray with the walls, by shapely."""
    tips = np.stack([x + max_range * np.cos(angles), y + max_range * np.sin(angles)], axis=1)
    rays = shapely.linestrings(np.stack([np.broadcast_to([x, y], tips.shape), tips], axis=1))
    hits = shapely.intersection(rays, lines_of(walls))
    return np.where(shapely.is_empty(hits), np.inf, shapely.distance(hits, shapely.points(x, y)))


def random_angles(rng: np.random.Generator, kind: int) -> np.ndarray:
    heading, n = rng.uniform(-7, 7), int(rng.integers(2, 120))
    if kind == 0:
        return heading + np.linspace(-math.pi / 2, math.pi / 2, n)
    if kind == 1:
        return heading - math.pi + np.arange(n) * (2 * math.pi / n)
    if kind == 2:
        return heading - math.pi + np.arange(n) * (2 * math.pi / n) + rng.normal(0.0, 0.02, n)
    if kind == 3:
        return rng.uniform(-9, 9, n)
    return heading + np.linspace(0, rng.uniform(0.1, 6.2), n) + rng.normal(0, 0.3 / n, n)


@pytest.mark.parametrize("part", range(5))
def test_kernel_agrees_with_shapely_on_500_random_scenes(part: int) -> None:
    rng = np.random.default_rng(part)
    for scene in range(100):
        walls = random_walls(rng, int(rng.integers(1, 60)))
        if scene % 2:
            walls = boxed(walls, 8.0)
        x, y = rng.uniform(-6, 6, 2)
        angles = random_angles(rng, scene % 5)
        max_range = rng.uniform(2.0, 20.0)
        got = cast_rays(walls, x, y, angles, max_range)
        np.testing.assert_allclose(got, exact_ranges(walls, x, y, angles, max_range), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("beams", [3, 7, 361])
@pytest.mark.parametrize("fov", [0.3, math.pi, 5.0, 2 * math.pi])
@pytest.mark.parametrize("sigma_angle", [0.0, 0.002, 0.3])
def test_sensor_casts_at_perturbed_angles_and_reports_nominal_ones(beams: int, fov: float, sigma_angle: float) -> None:
    config = SensorConfig(beams=beams, field_of_view=fov, sigma_angle=sigma_angle, sigma_range=0.0, max_range=9.0)
    laser = Laser(config)
    rng = np.random.default_rng(beams)
    for _ in range(4):
        walls = random_walls(rng, 30)
        pose = rng.uniform(-4, 4, 3)
        noise = rng.standard_normal((2, beams))
        angles = pose[2] + laser.angles + sigma_angle * noise[1]
        expected = exact_ranges(walls, pose[0], pose[1], angles, 9.0)
        got = laser.scan(walls, pose, noise)
        near = expected < 9.0 - 1e-9
        np.testing.assert_allclose(got[near], np.maximum(expected[near], MIN_RANGE), rtol=1e-9, atol=1e-9)
        assert np.isinf(got[~near]).all()


def test_nominal_angles() -> None:
    half = Laser(SensorConfig(beams=361)).angles
    np.testing.assert_allclose(half, np.radians(np.arange(-90, 90.25, 0.5)), atol=1e-12)
    full = Laser(SensorConfig(beams=8, field_of_view=2 * math.pi)).angles
    np.testing.assert_allclose(full, -math.pi + np.arange(8) * math.pi / 4)
    with pytest.raises(ValueError, match="read-only"):
        half[0] = 0.0


def test_wall_across_the_seam_of_a_full_circle() -> None:
    wall = np.array([[-2.0, -1.0, -2.0, 1.0]])
    angles = -math.pi + np.arange(720) * (math.pi / 360)
    for heading in (0.0, 1.0, math.pi, -9.0):
        got = cast_rays(wall, 0.0, 0.0, heading + angles, 8.0)
        off = np.abs(np.remainder(heading + angles, 2 * math.pi) - math.pi)
        hit = off <= math.atan(0.5)
        np.testing.assert_allclose(got[hit], 2.0 / np.cos(off[hit]), rtol=1e-12)
        assert np.isinf(got[~hit]).all()


def test_ends_hit_exactly_do_not_leak() -> None:
    # a closed square whose corners are aimed at exactly, and corners shared by two walls at random places
    square = boxed(np.empty((0, 4)), 1.0)
    angles = np.arange(8) * (math.pi / 4)
    expected = np.where(np.arange(8) % 2 == 0, 1.0, math.sqrt(2.0))
    np.testing.assert_allclose(cast_rays(square, 0.0, 0.0, angles, 8.0), expected, rtol=1e-12)
    rng = np.random.default_rng(3)
    for _ in range(200):
        x, y = rng.uniform(-0.9, 0.9, 2)
        aims = np.sort(np.arctan2(square[:, 1] - y, square[:, 0] - x))
        got = cast_rays(square, x, y, aims, 8.0)
        corners = np.hypot(square[:, 0] - x, square[:, 1] - y)[
            np.argsort(np.arctan2(square[:, 1] - y, square[:, 0] - x))
        ]
        np.testing.assert_allclose(got, corners, rtol=1e-9)


def test_wall_seen_edge_on_stops_only_the_ray_along_it() -> None:
    angles = np.array([-0.1, 0.0, 0.1, math.pi])
    for wall in ([[2.0, 0.0, 5.0, 0.0]], [[5.0, 0.0, 2.0, 0.0]], [[2.0, 0.0, 2.0, 0.0]]):
        np.testing.assert_array_equal(cast_rays(np.array(wall), 0.0, 0.0, angles, 8.0), [np.inf, 2.0, np.inf, np.inf])
        shuffled = cast_rays(np.array(wall), 0.0, 0.0, angles[[3, 1, 0]], 8.0)
        np.testing.assert_array_equal(shuffled, [np.inf, 2.0, np.inf])


@pytest.mark.parametrize("wall", [[-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
@pytest.mark.parametrize("angles", [np.linspace(-1.0, 1.0, 50), np.array([2.0, 1.0, 5.0])])
def test_from_a_point_on_a_wall_every_ray_reads_zero(wall: list[float], angles: np.ndarray) -> None:
    np.testing.assert_array_equal(cast_rays(np.array([wall]), 0.0, 0.0, angles, 8.0), np.zeros(len(angles)))


def test_no_walls_and_no_rays() -> None:
    assert np.isinf(cast_rays(np.empty((0, 4)), 0.0, 0.0, np.linspace(0, 1, 5), 8.0)).all()
    assert cast_rays(np.array([[1.0, 0.0, 1.0, 1.0]]), 0.0, 0.0, np.empty(0), 8.0).shape == (0,)


def test_noise_has_the_stated_moments() -> None:
    config = SensorConfig(sigma_range=0.02, sigma_angle=math.radians(0.2))
    wall = np.array([[5.0, -100.0, 5.0, 100.0]])
    laser = Laser(config)
    rng = np.random.default_rng(0)
    scans = np.array([laser.measure(wall, np.array([2.0, 0.0, 0.0]), rng) for _ in range(4000)])
    for beam in (180, 260):  # straight ahead, and at 40 degrees
        theta = laser.angles[beam]
        slope = 3.0 * math.sin(theta) / math.cos(theta) ** 2  # d(range) / d(angle)
        sigma = math.hypot(0.02, slope * config.sigma_angle)
        assert abs(scans[:, beam].mean() - 3.0 / math.cos(theta)) < 4 * sigma / math.sqrt(4000) + 1e-4
        assert scans[:, beam].std() == pytest.approx(sigma, rel=0.05)


def test_no_return_and_clamping() -> None:
    laser = Laser(SensorConfig(beams=3, field_of_view=0.1, max_range=8.0, sigma_range=0.1, sigma_angle=0.0))
    pose = np.zeros(3)
    up, down = np.array([[1.0, 1.0, 1.0], [0.0] * 3]), np.array([[-1.0, -1.0, -1.0], [0.0] * 3])
    at = lambda x: np.array([[x, -9.0, x, 9.0]])  # noqa: E731
    assert np.isinf(laser.scan(at(7.95), pose, up)).all()  # the reading is out of range
    assert np.isinf(laser.scan(at(8.05), pose, down)).all()  # the wall is
    np.testing.assert_allclose(laser.scan(at(7.95), pose, down)[1], 7.85)
    np.testing.assert_array_equal(laser.scan(at(0.05), pose, down), MIN_RANGE)


def test_same_seed_same_scan_and_bad_poses_are_refused() -> None:
    laser, walls = Laser(SensorConfig()), random_walls(np.random.default_rng(1), 20)
    scans = [laser.measure(walls, np.zeros(3), np.random.default_rng(7)) for _ in range(2)]
    np.testing.assert_array_equal(scans[0], scans[1])
    for pose in (np.zeros(2), np.array([0.0, np.nan, 0.0]), np.array([np.inf, -np.inf, 0.0])):
        with pytest.raises(InvalidMotionError, match="sensor pose"):
            laser.measure(walls, pose, np.random.default_rng(0))
