"""The explored share of the free area, by sample points.

A point counts as seen when it lies within the sensor's range and field of view and no wall crosses
the sight line: geometric visibility from the true pose, not "some beam passed by", so that it does
not depend on the number of beams or on the noise. It is exact up to rounding: each near, unseen
point is itself a ray of the laser's kernel. A sight line that touches the very end of a wall is
blocked (within `END_TOLERANCE`); a point on a wall is visible from the side that faces the sensor.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.errors import InvalidMotionError
from polyexplore_gym.sim.laser import ON_LINE, out_of_reach, strike

MOST_POINTS = 2_000_000
"""Sample points of a plan, at most: 50 MB, and a fifth of a second at the start of an episode."""
_A_CELL = 25
"""Points in a cell of the look-up grid, in the mean."""
_BINS = 1024
_RANGE_TOLERANCE = 1e-9
_DEPTH_TOLERANCE = 1e-9
"""A wall hides a point only if it is nearer by this share of the distance."""


def grid_spacing(radius: float, area: float) -> float:
    """Spacing (m) of the sample points for a robot of this radius (m) in a free area (m2).

    0.8 radii: whatever lets the robot in then holds points, two or three in a row across its body, and
    what it can do nothing with hardly counts. Wider where a plan would get more than `MOST_POINTS`.
    """
    return max(0.8 * radius, math.sqrt(area / MOST_POINTS))


@njit(cache=True, inline="always")
def _bin(y, x):  # type: ignore[no-untyped-def]
    """Angular bin 0 .. _BINS - 1, growing with the bearing from 0 to 2 pi: no trigonometry, no branches."""
    share = y / (abs(x) + abs(y) + 1e-300)
    quarter = (2.0 - share) if x < 0.0 else (share + (4.0 if y < 0.0 else 0.0))
    return np.uint32(min(quarter * (_BINS / 4.0), _BINS - 0.5))


@njit(cache=True)
def visible(segments, x, y, dx, dy, reach):  # type: ignore[no-untyped-def]
    """Which of the points at (dx, dy) (n,) from the sensor at x, y no wall hides: (n,) bool.

    All points lie within reach."""
    n = dx.size
    starts, bins, place = np.zeros(_BINS + 1, np.uint32), np.empty(n, np.uint32), np.empty(n, np.uint32)
    for i in range(n):
        bins[i] = _bin(dy[i], dx[i])
    for i in range(n):  # counting sort by bin
        b = bins[i]
        place[i] = starts[b]
        starts[b] += np.uint32(1)
    total = np.uint32(0)
    for k in range(_BINS + 1):
        starts[k], total = total, total + starts[k]
    sx, sy, nearest = np.empty(n), np.empty(n), np.zeros(n)
    for i in range(n):
        at = place[i] + starts[bins[i]]
        place[i] = at
        sx[at], sy[at] = dx[i], dy[i]
    for k in range(segments.shape[0]):
        ax, ay = segments[k, 0] - x, segments[k, 1] - y
        bx, by = segments[k, 2] - x, segments[k, 3] - y
        if out_of_reach(ax, ay, bx, by, reach):
            continue
        cross = ax * by - ay * bx
        length2 = (bx - ax) ** 2 + (by - ay) ** 2
        if cross * cross <= ON_LINE * ON_LINE * length2:
            _hide_edge_on(sx, sy, nearest, ax, ay, bx, by)
            continue
        if cross < 0.0:
            ax, ay, bx, by = bx, by, ax, ay
        low, high = _bin(ay, ax), _bin(by, bx)
        i, j = starts[low], starts[high + 1]
        if low <= high:
            strike(sx, sy, nearest, i, j, ax, ay, bx, by)
        else:  # across the seam
            strike(sx, sy, nearest, i, n, ax, ay, bx, by)
            strike(sx, sy, nearest, 0, j, ax, ay, bx, by)
    out = np.empty(n, np.bool_)
    for i in range(n):
        out[i] = nearest[place[i]] <= 1.0 + _DEPTH_TOLERANCE
    return out


@njit(cache=True)
def _hide_edge_on(sx, sy, nearest, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """A wall seen edge-on hides what lies exactly behind its nearer end; a sensor on the wall sees nothing."""
    if ax * bx + ay * by <= 0.0:
        nearest[:] = np.inf
        return
    if bx * bx + by * by < ax * ax + ay * ay:
        ax, ay = bx, by
    length2 = ax * ax + ay * ay
    if length2 <= ON_LINE * ON_LINE:
        nearest[:] = np.inf
        return
    for i in range(sx.size):
        along = ax * sx[i] + ay * sy[i]
        if along > 0.0 and abs(ax * sy[i] - ay * sx[i]) <= ON_LINE * math.hypot(sx[i], sy[i]):
            nearest[i] = max(nearest[i], along / length2)


@njit(cache=True)
def _bucket(x, y, x0, y0, size, columns, rows):  # type: ignore[no-untyped-def]
    """Points by grid cell: order (n,) and the start of each cell in it (cells + 1,)."""
    n = x.size
    cell, starts = np.empty(n, np.int64), np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        cell[i] = int((y[i] - y0) / size) * columns + int((x[i] - x0) / size)
        starts[cell[i] + 1] += 1
    for k in range(columns * rows):
        starts[k + 1] += starts[k]
    filled, order = starts[:-1].copy(), np.empty(n, np.int64)
    for i in range(n):
        order[filled[cell[i]]] = i
        filled[cell[i]] += 1
    return order, starts


@njit(cache=True)
def _mark(segments, pose, max_range, half_view, px, py, order, starts, unseen, size, columns, x0, y0, seen):  # type: ignore[no-untyped-def]
    """Mark the points seen from pose; the unseen ones of a cell stand first in it. Returns how many are new."""
    rows = unseen.size // columns
    x, y = pose[0], pose[1]
    hx, hy, least = math.cos(pose[2]), math.sin(pose[2]), math.cos(half_view) - 1e-12
    reach = max_range + _RANGE_TOLERANCE
    c0, c1 = max(0, math.floor((x - reach - x0) / size)), min(columns - 1, math.floor((x + reach - x0) / size))
    r0, r1 = max(0, math.floor((y - reach - y0) / size)), min(rows - 1, math.floor((y + reach - y0) / size))
    count = 0
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            count += unseen[r * columns + c]
    slots, dx, dy = np.empty(count, np.int64), np.empty(count), np.empty(count)
    n = 0
    for r in range(r0, r1 + 1):
        for c in range(c0, c1 + 1):
            cell = r * columns + c
            mx, my = x0 + (c + 0.5) * size - x, y0 + (r + 0.5) * size - y
            if math.hypot(mx, my) > reach + size or (half_view <= 0.5 * math.pi and mx * hx + my * hy < -size):
                continue  # the whole cell is out of range, or behind
            for j in range(starts[cell], starts[cell] + unseen[cell]):
                ux, uy = px[j] - x, py[j] - y
                d2 = ux * ux + uy * uy
                if d2 <= reach * reach and ux * hx + uy * hy >= least * math.sqrt(d2):
                    slots[n], dx[n], dy[n] = j, ux, uy
                    n += 1
    shown = visible(segments, x, y, dx[:n], dy[:n], reach)
    new = 0
    for i in range(n - 1, -1, -1):  # from the back, so that a swap moves no slot still to come
        if not shown[i]:
            continue
        j = slots[i]
        cell = int((py[j] - y0) / size) * columns + int((px[j] - x0) / size)
        last = starts[cell] + unseen[cell] - 1
        unseen[cell] -= 1
        seen[order[j]] = True
        px[j], px[last] = px[last], px[j]
        py[j], py[last] = py[last], py[j]
        order[j], order[last] = order[last], order[j]
        new += 1
    return new


@njit(cache=True, inline="always")
def _at(index, origin, spacing):  # type: ignore[no-untyped-def]
    return origin + (index + 0.5) * spacing


@njit(cache=True)
def _first_at(value, origin, spacing, count):  # type: ignore[no-untyped-def]
    """The first index of a row of points, 0 to count, that lies at `value` or beyond."""
    i = min(max(math.ceil((value - origin) / spacing - 0.5), 0), count)
    while i > 0 and _at(i - 1, origin, spacing) >= value:
        i -= 1
    while i < count and _at(i, origin, spacing) < value:
        i += 1
    return i


@njit(cache=True)
def _crossings(segments, spacing, x0, y0, columns, rows):  # type: ignore[no-untyped-def]
    """Where walls cross the rows of the grid, and the points on walls: numbers row * (columns + 1) + column, sorted.

    A crossing's column is that of the first point strictly to its right. As many crossings lie to the left of a
    point that is on no wall as on any other way out, if a wall owns its lower end only.
    """
    most = 0
    for k in range(segments.shape[0]):
        ax, ay, bx, by = segments[k]
        most += int(abs(by - ay) / spacing) + 3
        most += int(abs(bx - ax) / spacing) + 3 if ay == by else 0
    crossed, on = np.empty(most, np.int64), np.empty(most, np.int64)
    m = n = 0
    for k in range(segments.shape[0]):
        ax, ay, bx, by = segments[k]
        if by < ay:
            ax, ay, bx, by = bx, by, ax, ay
        for r in range(_first_at(ay, y0, spacing, rows), rows):
            y = _at(r, y0, spacing)
            if y > by:
                break
            row = r * (columns + 1)
            if ay == by:
                for c in range(_first_at(min(ax, bx), x0, spacing, columns), columns):
                    if _at(c, x0, spacing) > max(ax, bx):
                        break
                    on[n] = row + c
                    n += 1
                continue
            c = _first_at(ax + (y - ay) / (by - ay) * (bx - ax), x0, spacing, columns)  # but for rounding
            while c > 0 and side(ax, ay, bx, by, _at(c - 1, x0, spacing), y) <= 0:
                c -= 1
            while c < columns and side(ax, ay, bx, by, _at(c, x0, spacing), y) > 0:
                c += 1
            if c < columns and side(ax, ay, bx, by, _at(c, x0, spacing), y) == 0:
                on[n] = row + c
                n += 1
                c += 1
            if y < by:
                crossed[m] = row + c
                m += 1
    return np.sort(crossed[:m]), np.sort(on[:n])


@njit(cache=True)
def grid_points(segments, spacing):  # type: ignore[no-untyped-def]
    """Points (k, 2) of a square grid of `spacing` m in the free area bounded by closed rings of walls (M, 4).

    The grid starts half a spacing from the lowest x and y. Points within by the even-odd rule; those on a wall are
    left out. Both hold exactly for the coordinates as they are, as in `shapely.contains_xy`.
    """
    x0 = min(segments[:, 0].min(), segments[:, 2].min())
    x1 = max(segments[:, 0].max(), segments[:, 2].max())
    y0 = min(segments[:, 1].min(), segments[:, 3].min())
    y1 = max(segments[:, 1].max(), segments[:, 3].max())
    columns = math.ceil((x1 - x0) / spacing)
    crossed, on = _crossings(segments, spacing, x0, y0, columns, math.ceil((y1 - y0) / spacing))
    most = 0
    for i in range(0, crossed.size - 1, 2):
        most += crossed[i + 1] - crossed[i]
    out = np.empty((most, 2))
    n = j = 0
    for i in range(0, crossed.size - 1, 2):
        for number in range(crossed[i], crossed[i + 1]):
            while j < on.size and on[j] < number:
                j += 1
            if j < on.size and on[j] == number:
                continue
            out[n, 0] = _at(number % (columns + 1), x0, spacing)
            out[n, 1] = _at(number // (columns + 1), y0, spacing)
            n += 1
    return out[:n].copy()


@njit(cache=True)
def side(ax, ay, bx, by, px, py):  # type: ignore[no-untyped-def]
    """1, 0 or -1: p lies to the left of the line from a to b, on it, or to the right. Exact (Shewchuk 1997)."""
    left, right = (bx - ax) * (py - ay), (by - ay) * (px - ax)
    if abs(left - right) > 1e-15 * (abs(left) + abs(right)):
        return 1 if left > right else -1
    terms = np.empty(16)
    n = 0
    for u in _difference(bx, ax):
        for v in _difference(py, ay):
            for term in _product(u, v):
                n = _add(terms, n, term)
    for u in _difference(by, ay):
        for v in _difference(px, ax):
            for term in _product(u, v):
                n = _add(terms, n, -term)
    for i in range(n - 1, -1, -1):
        if terms[i] != 0.0:
            return 1 if terms[i] > 0.0 else -1
    return 0


@njit(cache=True)
def _difference(a, b):  # type: ignore[no-untyped-def]
    """Rounding error and rounded value of a - b."""
    x = a - b
    back = a - x
    return (a - (x + back)) + (back - b), x


@njit(cache=True)
def _product(a, b):  # type: ignore[no-untyped-def]
    """Rounding error and rounded value of a * b."""
    x = a * b
    wide = 134217729.0 * a  # 2^27 + 1 splits a number into halves
    a1 = wide - (wide - a)
    wide = 134217729.0 * b
    b1 = wide - (wide - b)
    a2, b2 = a - a1, b - b1
    return a2 * b2 - (((x - a1 * b1) - a2 * b1) - a1 * b2), x


@njit(cache=True)
def _add(terms, n, value):  # type: ignore[no-untyped-def]
    """Add a number to a sum kept as n parts, the small ones first, none of which overlaps another; n + 1."""
    for i in range(n):
        x = value + terms[i]
        part = x - value
        terms[i] = (value - (x - part)) + (terms[i] - part)
        value = x
    terms[n] = value
    return n + 1


class Coverage:
    """Which sample points of the free area have been seen from the poses added so far."""

    def __init__(self, points: np.ndarray) -> None:
        """points (k, 2) m, say a grid over the free area (`grid_points`).

        Raises `InvalidMotionError` unless they are finite, of that shape, and at least one.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0 or not np.isfinite(points).all():
            raise InvalidMotionError(f"sample points of shape {points.shape}: expected finite (k, 2), k >= 1")
        self._origin = points.min(axis=0)
        wide, high = points.max(axis=0) - self._origin
        share = _A_CELL / len(points)  # of a cell; so there are never many more cells than points
        self._size = max(math.sqrt(share * wide * high), share * max(wide, high)) or 1.0
        self._columns, rows = int(wide / self._size) + 1, int(high / self._size) + 1
        x0, y0 = self._origin
        self._order, self._starts = _bucket(points[:, 0], points[:, 1], x0, y0, self._size, self._columns, rows)
        self._x, self._y = points[self._order, 0].copy(), points[self._order, 1].copy()
        self._unseen = np.diff(self._starts)
        self._seen = np.zeros(len(points), dtype=np.bool_)
        self._count = 0

    @property
    def share(self) -> float:
        """Share of the points seen so far, 0 to 1."""
        return self._count / len(self._seen)

    @property
    def seen(self) -> np.ndarray:
        """(k,) bool, in the order of the points given; a copy."""
        return self._seen.copy()

    def add(self, segments: np.ndarray, pose: np.ndarray, sensor: SensorConfig) -> int:
        """Mark the points seen from the true pose (3,) among walls (M, 4); returns how many are new."""
        pose = np.ascontiguousarray(pose, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InvalidMotionError(f"sensor pose {pose!r}: expected three finite numbers")
        half_view = math.pi if sensor.full_circle else sensor.field_of_view / 2
        new: int = _mark(
            segments,
            pose,
            sensor.max_range,
            half_view,
            self._x,
            self._y,
            self._order,
            self._starts,
            self._unseen,
            self._size,
            self._columns,
            self._origin[0],
            self._origin[1],
            self._seen,
        )
        self._count += new
        return new
