"""One laser scan, as the robot knows it: beams and the estimated pose. Nothing of the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from polyexplore_gym.config import SensorConfig

_LEAST_RANGE = 1e-6
"""Smaller readings (m) say nothing, as in `mapping.extract_lines`."""


@dataclass(frozen=True, slots=True)
class Scan:
    """Ranges of one measurement and where the robot believes it stood.

    A range of `inf` is a beam without a return: free space up to the maximum range, never a
    point on a wall.
    """

    angles: np.ndarray
    """(n,) nominal beam angles in the robot frame, rad, strictly increasing."""
    ranges: np.ndarray
    """(n,) measured ranges, m; inf where nothing returned."""
    pose: np.ndarray
    """(3,) estimated x, y (m) and heading (rad) in the map frame."""
    covariance: np.ndarray
    """(3, 3) covariance of the pose, m2, m rad, rad2; zero when the pose is exact."""
    full_circle: bool = False
    """Whether the beams go all the way round, so that the last neighbours the first."""


def beam_angles(sensor: SensorConfig) -> np.ndarray:
    """(n,) nominal beam angles of a sensor in the robot frame, rad, increasing; of a full turn from -pi on."""
    n, view = sensor.beams, sensor.field_of_view
    if sensor.full_circle:
        return -math.pi + np.arange(n) * (2.0 * math.pi / n)
    return np.linspace(-view / 2, view / 2, n)


def on_beams(angles: np.ndarray, ranges: np.ndarray, sensor: SensorConfig) -> np.ndarray:
    """(n,) the readings of another scanner's beams for those of a sensor: each that of the nearest beam.

    Args:
        angles: (k,) rad, in any order and of any turn.
        ranges: (k,) m.
        sensor: whose beams are wanted; NaN, unknown, where none of the given lies within 0.75 steps of it.
    """
    turned = np.remainder(np.asarray(angles, np.float64) + math.pi, 2.0 * math.pi) - math.pi
    order = np.argsort(turned, kind="stable")
    around = np.concatenate((turned[order][-1:] - 2.0 * math.pi, turned[order], turned[order][:1] + 2.0 * math.pi))
    readings = np.asarray(ranges, np.float64)[np.concatenate((order[-1:], order, order[:1]))]
    wanted = beam_angles(sensor)
    after = np.clip(np.searchsorted(around, wanted), 1, len(around) - 1)
    nearest = np.where(wanted - around[after - 1] <= around[after] - wanted, after - 1, after)
    return np.where(np.abs(around[nearest] - wanted) <= 0.75 * sensor.resolution, readings[nearest], math.nan)


def readings(ranges: np.ndarray, sensor: SensorConfig) -> np.ndarray:
    """(n,) what drivers give, m, as in a `Scan`: inf from the maximum range on; NaN, unknown, for what is too small."""
    return np.where(ranges >= sensor.max_range, math.inf, np.where(ranges >= _LEAST_RANGE, ranges, math.nan))


def filled(ranges: np.ndarray, sensor: SensorConfig, gap: float, least: float) -> np.ndarray:
    """(n,) ranges with those that are NaN, unknown, replaced by ranges that claim no more than is known.

    So many neighbours that nothing wider than `gap` m fits between them get the nearer range of the two beams beside
    them. Else free is only what the body of radius `least` m covers, and a scan polygon is open at both sides of it.
    """
    unknown = np.isnan(ranges)
    if not unknown.any():
        return ranges
    if unknown.all():
        return np.full_like(ranges, least)
    n, out = len(ranges), ranges.copy()
    known = np.flatnonzero(~unknown)
    pairs = list(zip(known[:-1].tolist(), known[1:].tolist(), strict=True))
    if sensor.full_circle:
        pairs.append((int(known[-1]), int(known[0]) + n))
    else:
        out[: known[0]] = out[known[-1] + 1 :] = least
    for before, after in pairs:
        between = np.arange(before + 1, after) % n
        if len(between):
            near = min(ranges[before], ranges[after % n])
            wide = min(near, sensor.max_range) * (after - before) * sensor.resolution
            out[between] = near if wide <= gap else least
    return out


def carried(
    pose: np.ndarray, covariance: np.ndarray, mount: np.ndarray, *, back: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The laser's pose (3,) and its covariance for those of the robot; `back`: the robot's for those of the laser."""
    if not mount.any():
        return pose, covariance
    heading = pose[2] - mount[2] if back else pose[2]
    c, s = math.cos(heading), math.sin(heading)
    off = np.array([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1], mount[2]]) * (-1.0 if back else 1.0)
    # A turn by a small angle e about the one moves the other by e (-off_y, off_x).
    jacobian = np.array([[1.0, 0.0, -off[1]], [0.0, 1.0, off[0]], [0.0, 0.0, 1.0]])
    moved = pose + off
    moved[2] = math.pi - (math.pi - moved[2]) % (2.0 * math.pi)
    return moved, jacobian @ covariance @ jacobian.T
