"""Elementary geometry of segments and a hashed grid over them: kernels shared by this package."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit


class Obstacles(NamedTuple):
    """Segments and a hashed grid over them. A bucket may hold segments of several cells: a query finds a superset."""

    segments: np.ndarray
    """(m, 4), m"""
    owner: np.ndarray
    """(m,) the jump edge that each belongs to, -1 for none"""
    start: np.ndarray
    """(buckets + 1,) where each bucket begins in `items`"""
    items: np.ndarray
    """rows of `segments`"""
    cell: float
    """side of a cell, m"""


@njit(cache=True)
def norm(x, y):
    """Length of a vector of some metres; `hypot`, made for any size, takes seven times as long."""
    return math.sqrt(x * x + y * y)


@njit(cache=True, inline="always")
def point_segment_distance(px, py, x1, y1, x2, y2):
    """Distance from a point to a segment."""
    dx = x2 - x1
    dy = y2 - y1
    q = dx * dx + dy * dy
    t = 0.0
    if q > 0.0:
        t = ((px - x1) * dx + (py - y1) * dy) / q
        t = min(max(t, 0.0), 1.0)
    return norm(px - x1 - t * dx, py - y1 - t * dy)


@njit(cache=True, inline="always")
def crossing(ax, ay, bx, by, cx, cy, dx, dy):
    """Parameter along a-b where it properly crosses c-d, or -1."""
    ux = bx - ax
    uy = by - ay
    vx = dx - cx
    vy = dy - cy
    den = ux * vy - uy * vx
    if den == 0.0:
        return -1.0
    wx = cx - ax
    wy = cy - ay
    t = (wx * vy - wy * vx) / den
    s = (wx * uy - wy * ux) / den
    if 0.0 <= t <= 1.0 and 0.0 <= s <= 1.0:
        return t
    return -1.0


@njit(cache=True)
def segment_distance(ax, ay, bx, by, cx, cy, dx, dy):
    """Distance between two segments."""
    if crossing(ax, ay, bx, by, cx, cy, dx, dy) >= 0.0:
        return 0.0
    d = point_segment_distance(ax, ay, cx, cy, dx, dy)
    d = min(d, point_segment_distance(bx, by, cx, cy, dx, dy))
    d = min(d, point_segment_distance(cx, cy, ax, ay, bx, by))
    return min(d, point_segment_distance(dx, dy, ax, ay, bx, by))


@njit(cache=True)
def near_point(segments, alive, x, y, reach):
    """Rows of the living segments (m, 4) whose box comes within `reach` of a point (in the maximum norm)."""
    n = segments.shape[0]
    rows = np.empty(n, np.int64)
    count = 0
    for i in range(n):
        if (
            alive[i]
            and min(segments[i, 0], segments[i, 2]) <= x + reach
            and max(segments[i, 0], segments[i, 2]) >= x - reach
            and min(segments[i, 1], segments[i, 3]) <= y + reach
            and max(segments[i, 1], segments[i, 3]) >= y - reach
        ):
            rows[count] = i
            count += 1
    return rows[:count].copy()


@njit(cache=True, inline="always")
def bucket(ix, iy, mask):
    """Hash of a grid cell."""
    return ((ix * 73856093) ^ (iy * 19349663)) & mask


@njit(cache=True)
def indexed(segments, owner, alive, margin, cell):
    """The living segments (m, 4) as obstacles: each stands in all cells within `margin` m of it."""
    n = segments.shape[0]
    size = 256
    while size < 4 * n:
        size *= 2
    mask = size - 1
    start = np.zeros(size + 1, np.int64)
    reach = margin + 0.5 * math.sqrt(2.0) * cell
    items = np.empty(0, np.int64)
    for pass_ in range(2):
        if pass_ == 1:
            for b in range(size):
                start[b + 1] += start[b]
            items = np.empty(start[size], np.int64)
            fill = start[:-1].copy()
        for i in range(n):
            if not alive[i]:
                continue
            x1 = segments[i, 0]
            y1 = segments[i, 1]
            x2 = segments[i, 2]
            y2 = segments[i, 3]
            ix0 = math.floor((min(x1, x2) - margin) / cell)
            ix1 = math.floor((max(x1, x2) + margin) / cell)
            iy0 = math.floor((min(y1, y2) - margin) / cell)
            iy1 = math.floor((max(y1, y2) + margin) / cell)
            small = (ix1 - ix0 + 1) * (iy1 - iy0 + 1) <= 4
            for ix in range(ix0, ix1 + 1):
                for iy in range(iy0, iy1 + 1):
                    if (
                        not small
                        and point_segment_distance((ix + 0.5) * cell, (iy + 0.5) * cell, x1, y1, x2, y2) > reach
                    ):
                        continue
                    b = bucket(ix, iy, mask)
                    if pass_ == 0:
                        start[b + 1] += 1
                    else:
                        items[fill[b]] = i
                        fill[b] += 1
    return Obstacles(segments, owner, start, items, cell)


@njit(cache=True, inline="always")
def bucket_at(x, y, obstacles):
    """The bucket that holds a point's cell: its rows are `items[start[b] : start[b + 1]]`."""
    return bucket(math.floor(x / obstacles.cell), math.floor(y / obstacles.cell), obstacles.start.size - 2)


@njit(cache=True)
def clearance(px, py, obstacles, limit):
    """Distance from a point to the nearest segment, or `limit` if that is less (<= the grid's margin)."""
    b = bucket_at(px, py, obstacles)
    segments = obstacles.segments
    best = limit
    for e in range(obstacles.start[b], obstacles.start[b + 1]):
        i = obstacles.items[e]
        d = point_segment_distance(px, py, segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3])
        best = min(best, d)
    return best


@njit(cache=True)
def clearances(points, obstacles, limit):
    """`clearance` of points (k, 2)."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        out[i] = clearance(points[i, 0], points[i, 1], obstacles, limit)
    return out


@njit(cache=True, inline="always")
def walk(ax, ay, bx, by, cell):
    """How a-b runs through the grid: its first cell, the steps in x and y, the parameters along it of the next
    borders in x and y and what they grow by, and the number of cells (Amanatides and Woo 1987)."""
    dx = bx - ax
    dy = by - ay
    ix = math.floor(ax / cell)
    iy = math.floor(ay / cell)
    cells = abs(math.floor(bx / cell) - ix) + abs(math.floor(by / cell) - iy) + 1
    sx = 1 if dx > 0 else -1
    sy = 1 if dy > 0 else -1
    tx = ((ix + (1 if dx > 0 else 0)) * cell - ax) / dx if dx != 0.0 else math.inf
    ty = ((iy + (1 if dy > 0 else 0)) * cell - ay) / dy if dy != 0.0 else math.inf
    wx = cell / abs(dx) if dx != 0.0 else math.inf
    wy = cell / abs(dy) if dy != 0.0 else math.inf
    return ix, iy, sx, sy, tx, ty, wx, wy, cells


@njit(cache=True)
def first_hit(ax, ay, bx, by, obstacles, radius):
    """A segment nearer than `radius` (<= the grid's margin) to a-b, about the first on the way; -1 if none is."""
    segments = obstacles.segments
    start = obstacles.start
    items = obstacles.items
    mask = start.size - 2
    dx = bx - ax
    dy = by - ay
    length = norm(dx, dy)
    ux = dx / length if length > 0.0 else 1.0
    uy = dy / length if length > 0.0 else 0.0
    ix, iy, sx, sy, tx, ty, wx, wy, cells = walk(ax, ay, bx, by, obstacles.cell)
    for _ in range(cells):
        b = bucket(ix, iy, mask)
        for e in range(start[b], start[b + 1]):
            i = items[e]
            cx = segments[i, 0]
            cy = segments[i, 1]
            ex = segments[i, 2]
            ey = segments[i, 3]
            # Most walls lie beside, before or behind the strip that the disc sweeps.
            n1 = ux * (cy - ay) - uy * (cx - ax)
            n2 = ux * (ey - ay) - uy * (ex - ax)
            if (n1 > radius and n2 > radius) or (n1 < -radius and n2 < -radius):
                continue
            t1 = ux * (cx - ax) + uy * (cy - ay)
            t2 = ux * (ex - ax) + uy * (ey - ay)
            if (t1 < -radius and t2 < -radius) or (t1 > length + radius and t2 > length + radius):
                continue
            if segment_distance(ax, ay, bx, by, cx, cy, ex, ey) < radius:
                return i
        if tx < ty:
            ix += sx
            tx += wx
        else:
            iy += sy
            ty += wy
    return -1


@njit(cache=True)
def sweep_free(ax, ay, bx, by, obstacles, radius):
    """Whether every segment keeps at least `radius` (<= the grid's margin) from a-b."""
    return first_hit(ax, ay, bx, by, obstacles, radius) < 0


@njit(cache=True)
def crossing_free(ax, ay, bx, by, obstacles, own_a, own_b, slack_a, slack_b):
    """Whether a-b crosses no segment, but within `slack_a` m of a, `slack_b` m of b, or those of its owners."""
    segments = obstacles.segments
    owner = obstacles.owner
    start = obstacles.start
    items = obstacles.items
    mask = start.size - 2
    dx = bx - ax
    dy = by - ay
    length = norm(dx, dy)
    ix, iy, sx, sy, tx, ty, wx, wy, cells = walk(ax, ay, bx, by, obstacles.cell)
    for _ in range(cells):
        b = bucket(ix, iy, mask)
        for e in range(start[b], start[b + 1]):
            i = items[e]
            if owner[i] >= 0 and (owner[i] == own_a or owner[i] == own_b):
                continue
            t = crossing(ax, ay, bx, by, segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3])
            if t >= 0.0 and t * length >= slack_a and (1.0 - t) * length >= slack_b:
                return False
        if tx < ty:
            ix += sx
            tx += wx
        else:
            iy += sy
            ty += wy
    return True
