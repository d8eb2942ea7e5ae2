"""A disc that moves straight among segments: where it touches. Kernels on arrays, for bodies simulated and real.

The distance from a point that moves straight to a segment is convex in time, so a disc that starts clear of a segment
meets it at most once, and one that touches it and does not move closer never meets it again.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_GRAZE = 4e-9
"""A disc that dips less than this, in radii, into a wall does not touch it when it glides along a path."""


@njit(cache=True)
def enters(ax, ay, bx, by, dx, dy, radius):  # type: ignore[no-untyped-def]
    """First t in [0, 1] at which the point t (dx, dy) comes within radius of the segment a, b; inf if never.

    At t = 0 it counts only if the point moves closer.
    """
    ex, ey = bx - ax, by - ay
    length2 = ex * ex + ey * ey
    u = 0.0
    if length2 > 0.0:
        u = min(1.0, max(0.0, -(ax * ex + ay * ey) / length2))
    qx, qy = ax + u * ex, ay + u * ey
    if qx * qx + qy * qy <= radius * radius:
        return 0.0 if qx * dx + qy * dy > 0.0 else np.inf
    first = np.inf
    if length2 > 0.0:  # the straight sides
        length = math.sqrt(length2)
        nx, ny = -ey / length, ex / length
        height, rate = -(ax * nx + ay * ny), dx * nx + dy * ny  # signed height of the point over the line
        if height < 0.0:
            height, rate = -height, -rate
        if rate < 0.0:
            t = max(height - radius, 0.0) / -rate  # beside the wall it is higher, but for rounding
            along = ((t * dx - ax) * ex + (t * dy - ay) * ey) / length2
            if t <= 1.0 and 0.0 <= along <= 1.0:
                return t
    square = dx * dx + dy * dy
    for end in range(2):  # the round ends
        cx, cy = (ax, ay) if end == 0 else (bx, by)
        half = cx * dx + cy * dy
        gap = max(cx * cx + cy * cy - radius * radius, 0.0)
        root = half * half - square * gap
        if half > 0.0 and root >= 0.0:
            t = gap / (half + math.sqrt(root))
            if t <= 1.0:
                first = min(first, t)
    return first


@njit(cache=True)
def first_contact(segments, x, y, dx, dy, radius, standoff):  # type: ignore[no-untyped-def]
    """How far a disc at (x, y) gets along (dx, dy) before it touches a wall.

    standoff m. Returns (contact, stop): the share of the motion at which it touches, inf if it never does, and the
    share at which its rim is still `standoff` from that wall (0 if it starts closer). A disc that touches a wall
    already is only held by it if it moves into it.
    """
    contact, stop = np.inf, np.inf
    graze = _GRAZE * radius
    reach = radius + standoff
    x_min, x_max = x + min(0.0, dx) - reach, x + max(0.0, dx) + reach
    y_min, y_max = y + min(0.0, dy) - reach, y + max(0.0, dy) + reach
    if dx == 0.0 and dy == 0.0:
        return contact, stop
    for k in range(segments.shape[0]):
        x1, y1, x2, y2 = segments[k]
        if max(x1, x2) < x_min or min(x1, x2) > x_max or max(y1, y2) < y_min or min(y1, y2) > y_max:
            continue
        t = enters(x1 - x, y1 - y, x2 - x, y2 - y, dx, dy, radius - graze)
        if t < contact:
            contact = t
            stop = min(t, enters(x1 - x, y1 - y, x2 - x, y2 - y, dx, dy, reach))
    return contact, stop


@njit(cache=True)
def contact_along(segments, path, radius):  # type: ignore[no-untyped-def]
    """Way (m) along a path (k, 2) after which a disc touches a segment (m, 4); inf if it touches none.

    One that it touches at the start counts only if it moves into it.
    """
    way = 0.0
    for k in range(path.shape[0] - 1):
        x, y = path[k]
        dx, dy = path[k + 1, 0] - x, path[k + 1, 1] - y
        length = math.hypot(dx, dy)
        contact, _ = first_contact(segments, x, y, dx, dy, radius, 0.0)
        if contact <= 1.0:
            return way + contact * length
        way += length
    return np.inf
