"""A building with a loop, and a drive round it whose odometry drifts, for the tests of SLAM."""

import math

import numpy as np
from line_scenes import HALF, box, measure

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import LaserLog
from polyexplore_gym.mapping.logs.poses import between, compose

SENSOR = SensorConfig(max_range=12.0)
BUILDING = [
    *box(0.0, 0.0, 16.0, 11.0), *box(3.0, 3.0, 12.5, 8.0),
    # stubs and niches at uneven places, so that no two corridors look alike
    [4.0, 0.0, 4.0, 0.7], [7.2, 0.0, 7.2, 0.9], [7.2, 0.9, 8.4, 0.9], [8.4, 0.9, 8.4, 0.0], [12.0, 0.0, 12.0, 0.6],
    [16.0, 4.0, 15.2, 4.0], [15.2, 4.0, 15.2, 5.1], [15.2, 5.1, 16.0, 5.1], [16.0, 8.3, 15.5, 8.3],
    [13.4, 11.0, 13.0, 10.1], [10.0, 11.0, 10.0, 10.3], [6.5, 11.0, 6.1, 10.2], [5.0, 10.2, 6.1, 10.2],
    [5.0, 10.2, 5.0, 11.0], [0.0, 7.7, 0.8, 7.7], [0.0, 5.2, 0.6, 5.0], [0.6, 5.0, 0.6, 3.4], [0.6, 3.4, 0.0, 3.4],
]  # fmt: skip
CORNERS = np.array([[1.6, 1.7], [14.0, 1.5], [14.2, 9.3], [1.8, 9.2]])


def rounds(count: int, step: float) -> np.ndarray:
    """(n, 3) poses of a drive `count` times round the block, a step (m) apart; at corners it turns by 30 degrees."""
    poses = []
    for k in range(4 * count):
        a, b = CORNERS[k % 4], CORNERS[(k + 1) % 4]
        heading = math.atan2(*(b - a)[::-1])
        n = round(math.dist(a, b) / step)
        poses += [(*(a + (b - a) * i / n), heading) for i in range(n)]
        poses += [(*b, heading + math.radians(30.0 * i)) for i in range(3)]
    poses = np.array(poses)
    poses[:, 2] = (poses[:, 2] + math.pi) % (2 * math.pi) - math.pi
    return poses


def drifted(true: np.ndarray, rng, veer: float = 0.05, noise: tuple[float, float] = (0.03, 0.03)) -> np.ndarray:
    """(n, 3) odometry: too short by 4 %, veering by so many rad a metre, with noise (m, rad) a step."""
    step = between(true[:-1], true[1:])
    step[:, 2] = 1.03 * step[:, 2] + veer * step[:, 0] + rng.normal(0, noise[1], len(step))
    step[:, :2] = 0.96 * step[:, :2] + rng.normal(0, noise[0], (len(step), 2))
    out = [true[0]]
    for one in step:
        out.append(compose(out[-1], one))
    return np.array(out)


def drive(rng, count: int = 2, step: float = 0.5, walls=BUILDING) -> tuple[LaserLog, np.ndarray]:
    """A log with raw odometry, and the true poses (n, 3)."""
    true = rounds(count, step)
    ranges = [measure(walls, pose, SENSOR, rng) for pose in true]
    odometry = drifted(true, rng)
    return (
        LaserLog(
            HALF, ranges, odometry, max_range=SENSOR.max_range, poses_are="odometry", odometry=odometry,
            times=10.0 + 0.8 * np.arange(len(true)),
        ),
        true,
    )  # fmt: skip
