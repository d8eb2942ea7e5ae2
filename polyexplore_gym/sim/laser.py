"""The 2D laser: a ray casting kernel over wall segments, and the noisy sensor built on it.

Each wall touches only the beams within its angular span, so the kernel loops over walls and, for
each, over its span. A beam from p in the unit direction d meets the line through a wall a, b
(relative to p, e = b - a) at the distance t with 1/t = (d x e) / (a x e). That is linear in d, so
the nearest wall is the largest 1/t: one fused loop without a division or a branch, which the
compiler vectorises.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.scan import beam_angles

ON_LINE = 1e-9
"""Closer than this (m) to a wall's line the wall is seen edge-on, and to the wall itself the sensor stands on it.
Rounding of coordinates in metres; it follows from no robot."""
END_TOLERANCE = 1e-12
"""A ray that passes this close (m) to the end of a wall hits it. Rounding, as above."""
MIN_RANGE = 1e-3
"""Smallest noisy reading, m: noise never makes a range zero or negative. The last digit that drivers report, whatever
the sensor; the robot's body keeps true ranges above it."""
_BEARING_ERROR = 2e-5
_TWO_PI = 2.0 * math.pi


@njit(cache=True, inline="always")
def _bearing(y, x):  # type: ignore[no-untyped-def]
    """atan2 to within 2e-5 rad: enough to find the beams near a wall, which are then tested exactly."""
    ax, ay = abs(x), abs(y)
    high, low = max(ax, ay), min(ax, ay)
    if high == 0.0:
        return 0.0
    z = low / high
    w = z * z
    angle = z * (
        0.99997726 + w * (-0.33262347 + w * (0.19354346 + w * (-0.11643287 + w * (0.05265332 - w * 0.01172120))))
    )
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(cache=True, inline="always")
def out_of_reach(ax, ay, bx, by, reach):  # type: ignore[no-untyped-def]
    """Whether the wall a, b surely lies farther than `reach` from the origin (bounding boxes)."""
    return (min(ax, bx) > reach) | (max(ax, bx) < -reach) | (min(ay, by) > reach) | (max(ay, by) < -reach)


@njit(cache=True)
def strike(dir_x, dir_y, best, low, high, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Raise best[low:high] to 1/t where the ray t (dir_x, dir_y) from the origin meets wall a, b; needs a x b > 0."""
    ex, ey = bx - ax, by - ay
    inverse = 1.0 / (ax * by - ay * bx)
    mx, my = ex * inverse, ey * inverse
    # unsigned, so that no index is tested for counting from the end; bounds instead of slices, which cost more
    for i in range(np.uint64(low), np.uint64(high)):
        dx, dy = dir_x[i], dir_y[i]
        value = dx * my - dy * mx
        inside = (ax * dy - ay * dx >= -END_TOLERANCE) & (dx * by - dy * bx >= -END_TOLERANCE)
        best[i] = value if inside & (value > best[i]) else best[i]


@njit(cache=True)
def strike_edge_on(dir_x, dir_y, best, low, high, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """The same for a wall on a line through the origin, or of no length: only its nearer end can be hit.

    Directions must have unit length. Returns True if the origin lies on the wall itself.
    """
    if ax * bx + ay * by <= 0.0:  # the ends lie on opposite sides, or one on the origin
        return True
    if bx * bx + by * by < ax * ax + ay * ay:
        ax, ay = bx, by
    distance = math.hypot(ax, ay)
    if distance <= ON_LINE:
        return True
    for i in range(low, high):
        if abs(ax * dir_y[i] - ay * dir_x[i]) <= ON_LINE and ax * dir_x[i] + ay * dir_y[i] > 0.0:
            best[i] = max(best[i], 1.0 / distance)
    return False


@njit(cache=True)
def _cast(segments, x, y, dir_x, dir_y, first, step, slack, max_range):  # type: ignore[no-untyped-def]
    """True ranges along unit directions, the i-th within `slack` of the absolute angle first + i * step.

    A slack of pi or more (or a step of 0) means that nothing is known of the directions: all beams are tested.
    """
    n = dir_x.size
    best = np.zeros(n)
    blind = step <= 0.0 or slack >= math.pi
    slack += _BEARING_ERROR
    first = (first + math.pi) % _TWO_PI - math.pi
    inverse_step = 1.0 / step if step > 0.0 else 0.0
    for k in range(segments.shape[0]):
        ax, ay = segments[k, 0] - x, segments[k, 1] - y
        bx, by = segments[k, 2] - x, segments[k, 3] - y
        if out_of_reach(ax, ay, bx, by, max_range):
            continue
        cross = ax * by - ay * bx
        ex, ey = bx - ax, by - ay
        length2 = ex * ex + ey * ey
        if cross * cross > max_range * max_range * length2:
            continue
        edge_on = cross * cross <= ON_LINE * ON_LINE * length2
        if cross < 0.0:  # seen from its other face: swap, so that b lies counter-clockwise of a
            ax, ay, bx, by = bx, by, ax, ay
        low, high = 0, n - 1
        if blind:
            if edge_on:
                if strike_edge_on(dir_x, dir_y, best, 0, n, ax, ay, bx, by):
                    return np.zeros(n)
            else:
                strike(dir_x, dir_y, best, 0, n, ax, ay, bx, by)
            continue
        start = _bearing(ay, ax) - first
        start += _TWO_PI if start < 0.0 else 0.0
        width = _bearing(by, bx) - first
        width += (_TWO_PI if width < 0.0 else 0.0) - start
        if edge_on:
            if ax * bx + ay * by <= 0.0:
                return np.zeros(n)
            # both ends lie in one direction, up to the error of the bearing
            width = (width + math.pi) % _TWO_PI - math.pi
            start, width = start + min(width, 0.0), abs(width)
        elif width < -2.0 * _BEARING_ERROR:
            width += _TWO_PI
        for turn in range(-1, 2):  # beams on either side of the seam, and those whose noise carries them across it
            at = start + turn * _TWO_PI
            low = max(0, math.ceil((at - slack) * inverse_step))
            high = min(n - 1, math.floor((at + width + slack) * inverse_step))
            if high < low:
                continue
            if edge_on:
                if strike_edge_on(dir_x, dir_y, best, low, high + 1, ax, ay, bx, by):
                    return np.zeros(n)
            else:
                strike(dir_x, dir_y, best, low, high + 1, ax, ay, bx, by)
    for i in range(n):
        distance = 1.0 / best[i] if best[i] > 0.0 else np.inf
        best[i] = distance if distance <= max_range else np.inf
    return best


@njit(cache=True)
def cast_rays(segments, x, y, angles, max_range):  # type: ignore[no-untyped-def]
    """True distances from a point to the nearest wall along rays.

    segments (M, 4) m; x, y m; angles (n,) absolute, rad, in any order; max_range m. Returns (n,) m, inf where
    no wall lies within max_range. Both faces of a wall reflect; a ray through the very end of a wall hits it;
    from a point on a wall every ray reads 0. Fast for (nearly) equally spaced increasing angles within one
    turn, merely right for others.
    """
    n = angles.size
    dir_x, dir_y = np.cos(angles), np.sin(angles)
    if n == 0:
        return np.empty(0)
    first, step, slack = angles[0], 0.0, 0.0
    if n > 1 and 0.0 < angles[n - 1] - angles[0] <= _TWO_PI:
        step = (angles[n - 1] - angles[0]) / (n - 1)
        for i in range(n):
            slack = max(slack, abs(angles[i] - first - i * step))
    return _cast(segments, x, y, dir_x, dir_y, first, step, slack, max_range)


@njit(cache=True)
def _measure(segments, pose, cosines, sines, first, step, max_range, sigma_range, sigma_angle, noise):  # type: ignore[no-untyped-def]
    """A scan: beams turned by heading plus angle noise, cast, and range noise added. noise (2, n): range, angle."""
    n = cosines.size
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dir_x, dir_y = np.empty(n), np.empty(n)
    slack = 0.0
    for i in range(n):
        slack = max(slack, abs(noise[1, i]))
    slack *= sigma_angle
    small = slack < 0.03  # then four terms of the series are exact to rounding, and vectorise
    for i in range(n):
        eps = sigma_angle * noise[1, i]
        if small:
            w = eps * eps
            ce = 1.0 - w * (0.5 - w * (1.0 / 24.0 - w * (1.0 / 720.0 - w / 40320.0)))
            se = eps * (1.0 - w * (1.0 / 6.0 - w * (1.0 / 120.0 - w / 5040.0)))
        else:
            ce, se = math.cos(eps), math.sin(eps)
        cx, cy = c * ce - s * se, s * ce + c * se
        dir_x[i] = cosines[i] * cx - sines[i] * cy
        dir_y[i] = sines[i] * cx + cosines[i] * cy
    ranges = _cast(segments, pose[0], pose[1], dir_x, dir_y, pose[2] + first, step, slack, max_range)
    for i in range(n):
        if ranges[i] <= max_range:
            reading = max(ranges[i] + sigma_range * noise[0, i], MIN_RANGE)
            ranges[i] = reading if reading <= max_range else np.inf
    return ranges


class Laser:
    """A 2D laser range finder: reports nominal angles, casts at the true, perturbed ones.

    A beam whose wall lies beyond the maximum range, or whose noisy reading does, has no return: inf.
    """

    def __init__(self, config: SensorConfig) -> None:
        self.config = config
        angles = beam_angles(config)
        angles.flags.writeable = False
        self._angles = angles
        self._cos, self._sin = np.cos(angles), np.sin(angles)

    @property
    def angles(self) -> np.ndarray:
        """(n,) nominal beam angles in the robot frame, rad, increasing; read-only."""
        return self._angles

    def measure(self, segments: np.ndarray, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One scan. segments (M, 4) m, pose (3,) of the sensor; returns ranges (n,) m, inf for no return.

        Always draws 2 n normals (range noise, then angle noise), so that streams match across noise settings.

        Raises `InvalidMotionError` if the pose is not three finite numbers.
        """
        return self.scan(segments, pose, rng.standard_normal((2, self.config.beams)))

    def scan(self, segments: np.ndarray, pose: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """As `measure`, with the standard normal noise (2, n) given; zeros give the true ranges."""
        pose = np.ascontiguousarray(pose, dtype=np.float64)
        if pose.shape != (3,) or not all(map(math.isfinite, pose)):
            raise InvalidMotionError(f"sensor pose {pose!r}: expected three finite numbers")
        config = self.config
        return _measure(
            segments,
            pose,
            self._cos,
            self._sin,
            self._angles[0],
            config.resolution,
            config.max_range,
            config.sigma_range,
            config.sigma_angle,
            noise,
        )
