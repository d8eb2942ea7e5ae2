"""Small scenes and a plain ray caster for the mapping tests (numpy, all walls against all beams)."""

import math

import numpy as np

HALF = np.linspace(-math.pi / 2, math.pi / 2, 361)
EXACT = np.zeros((3, 3))


def cast(walls, pose, angles, max_range=8.0):
    """Ranges of beams at `angles` from `pose`; inf without a hit."""
    walls = np.asarray(walls, float)
    t = np.asarray(angles)[:, None] + pose[2]
    dx, dy = np.cos(t), np.sin(t)
    ax, ay = walls[:, 0] - pose[0], walls[:, 1] - pose[1]
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    cross = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (ax * ey - ay * ex) / cross
        s = (ax * dy - ay * dx) / cross
        hit = (r > 0) & (s >= 0) & (s <= 1)
    r = np.where(hit, r, np.inf).min(axis=1)
    return np.where(r < max_range, r, np.inf)


def measure(walls, pose, sensor, rng, angles=HALF):
    """Noisy ranges: the ray goes at the perturbed angle, the nominal one is reported."""
    ranges = cast(walls, pose, angles + rng.normal(0, sensor.sigma_angle, angles.size), sensor.max_range)
    return np.maximum(ranges + rng.normal(0, sensor.sigma_range, angles.size), 1e-3)


def box(x0, y0, x1, y1):
    """The four walls of a room, free space inside, on the left."""
    return [[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]]


def jagged_room(rng, size=8.0, steps=60):
    """A closed ragged wall around (0, 0)."""
    t = np.linspace(0, 2 * math.pi, steps, endpoint=False)
    r = 0.5 * size * (1 + 0.15 * rng.uniform(-1, 1, steps))
    p = np.c_[r * np.cos(t), r * np.sin(t)]
    return np.hstack([p, np.roll(p, -1, 0)])


def distance(points, segments):
    """(k,) distance of each point to the nearest segment."""
    p = np.asarray(points)[:, None]
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    q = np.maximum((d * d).sum(1), 1e-18)
    t = np.clip(((p - a) * d).sum(2) / q, 0, 1)
    return np.sqrt((((p - a) - t[..., None] * d) ** 2).sum(2)).min(1)


def ends_on(angles, ranges, pose=(0, 0, 0)):
    hit = np.isfinite(ranges)
    t = angles[hit] + pose[2]
    return np.c_[pose[0] + ranges[hit] * np.cos(t), pose[1] + ranges[hit] * np.sin(t)]
