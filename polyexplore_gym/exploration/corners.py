"""Corners: where a shortest path of the robot's disc turns.

Paths turn at wall ends. Around each stand a few vertices, on a polyline at the radius and a little more; a leg
belongs to a path through a vertex only if it is taut there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.scan_polygon import contains
from polyexplore_gym.exploration.segments import bucket, clearance, norm, point_segment_distance

CORNER, LEAF = 0, 1
"""Kinds of vertices; -1 is none."""

REACH = 0.45
"""Margin (m) of the wall grid: no clearance beyond it is ever asked for."""
_NEIGHBOURHOOD = 0.25
"""Radius (m) of the circle around a wall end on which its corner is judged: raggedness below it is no corner."""
_SPACING = 0.1
"""Two vertices nearer than this (m) are one."""
_FLAT = 0.2
"""A corner that turns less than this (rad) beyond straight gets no vertex."""
_ARC = math.pi / 4
"""A path turns round a corner in steps of at most this angle, rad."""
_SAME = 0.92
"""Cosine above which a wall leaves its end as it did when the corner was judged: the map breathes."""
_LEEWAY = 0.15
"""Sine by which a path through a corner vertex may miss being taut: the map is noisy."""
_APART = 0.03
"""Wall ends farther apart than this (m) are two; nearer ones are one end seen twice."""
_SHORT = 0.7
"""Legs up to this length (m) need not be taut."""
_FREE = 2.0
"""Stands for the largest sine where a vertex serves every direction past its corner."""
OPEN_SPACE = 4.0
"""Stands for the largest sine of a vertex in the open, without a corner."""
TRAIL = 8.0
"""The same, for a place where the robot has driven: no wall refutes that."""


class Known(NamedTuple):
    """The scan polygons so far, in the layout of `scan_polygon`: which space is known."""

    apexes: np.ndarray
    """(s, 2)"""
    headings: np.ndarray
    """(s,)"""
    points: np.ndarray
    """(s, n, 2) corners about the apex"""
    angles: np.ndarray
    """(n,)"""
    full: bool
    reach: float
    """Maximum range, m."""


EVERYTHING = Known(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), np.array([0.0, 1.0]), False, 0.0)
"""No limit to what is known."""


@njit(cache=True)
def is_known(x, y, known, since):
    """Whether a point lies in a scan polygon from number `since` on; the newest are tried first."""
    for s in range(known.headings.size - 1, since - 1, -1):
        dx = x - known.apexes[s, 0]
        dy = y - known.apexes[s, 1]
        if (
            abs(dx) <= known.reach
            and abs(dy) <= known.reach
            and contains(dx, dy, known.points[s], known.angles, known.headings[s], known.full)
        ):
            return True
    return False


@njit(cache=True)
def _free_sector(ex, ey, walls, start, items):
    """The widest free sector around a wall end: the directions (from, to) of the walls that bound it.

    Walls are judged where they cross a small circle; returns (a, b, width) with b = a + width. One
    wall leaves 2 pi; where nothing crosses the circle, width is 4 pi: the obstacle is small.
    """
    mask = start.size - 2
    h = _NEIGHBOURHOOD
    angles = np.empty(64)
    n = 0
    b = bucket(math.floor(ex), math.floor(ey), mask)
    for e in range(start[b], start[b + 1]):
        i = items[e]
        x1 = walls[i, 0] - ex
        y1 = walls[i, 1] - ey
        x2 = walls[i, 2] - ex
        y2 = walls[i, 3] - ey
        dx = x2 - x1
        dy = y2 - y1
        qa = dx * dx + dy * dy
        if qa == 0.0:
            continue
        qb = x1 * dx + y1 * dy
        qc = x1 * x1 + y1 * y1 - h * h
        disc = qb * qb - qa * qc
        if disc <= 0.0:
            continue
        root = math.sqrt(disc)
        for sign in (-1.0, 1.0):
            t = (-qb + sign * root) / qa
            if 0.0 <= t <= 1.0 and n < 64:
                angles[n] = math.atan2(y1 + t * dy, x1 + t * dx)
                n += 1
    if n == 0:
        return 0.0, 0.0, 4.0 * math.pi
    found = np.sort(angles[:n])
    best = found[0] + 2.0 * math.pi - found[n - 1]
    a = found[n - 1]
    for i in range(n - 1):
        gap = found[i + 1] - found[i]
        if gap > best:
            best = gap
            a = found[i]
    return a, a + best, best


@njit(cache=True)
def corner_vertices(ends, walls, start, items, rho, need, known, waited, since):
    """Vertices around wall ends (m, 2): (v, 2) positions and (v, 7) shapes for the test of tautness.

    Only vertices in known space (all space if nothing is said to be known); third, which ends have
    more of them waiting in the unknown. The ends from number `waited` on were judged before: for
    them only the scans from number `since` on can have news.

    They stand at `rho` from the end on a polyline around it, nearer where the passage is narrow but
    never nearer than `need` to any wall. A shape is the anchor (the wall end), the two bounding wall
    directions, and the sine of the largest angle between a taut path and the polyline's tangent.
    """
    out = np.empty((16 * ends.shape[0], 2))
    shape = np.empty((out.shape[0], 7))
    waiting = np.zeros(ends.shape[0], np.bool_)
    count = 0
    for q in range(ends.shape[0]):
        ex = ends[q, 0]
        ey = ends[q, 1]
        twin = False
        for p in range(q):
            if abs(ends[p, 0] - ex) < 0.02 and abs(ends[p, 1] - ey) < 0.02:
                twin = True
                break
        if twin:
            continue
        a, b, gap = _free_sector(ex, ey, walls, start, items)
        lone = gap > 3.0 * math.pi
        turn = 2.0 * math.pi if lone else gap - math.pi
        if turn < _FLAT:
            continue
        parts = math.ceil(turn / _ARC - 1e-9)
        first = a if lone else a + 0.5 * math.pi
        last_plain = True
        for p in range(parts):
            if count == out.shape[0]:
                break
            half = 0.5 * turn / parts
            direction = first + (2 * p + 1) * half
            ux = math.cos(direction)
            uy = math.sin(direction)
            away = rho / math.cos(half)
            x = ex + away * ux
            y = ey + away * uy
            limit = math.sin(half) + _LEEWAY
            kept = True
            if clearance(x, y, walls, start, items, REACH) < need:
                # A narrow passage: stand in the middle between the end and what faces it.
                low = -1.0
                for step in range(12):
                    d = need + 0.02 + step * (rho + 0.1 - need) / 11.0
                    c = clearance(ex + d * ux, ey + d * uy, walls, start, items, REACH)
                    if c >= need and c > low:
                        low = c
                        x = ex + d * ux
                        y = ey + d * uy
                limit = OPEN_SPACE
                kept = low >= 0.0
                # The neighbour on the polyline takes over its directions.
                if last_plain and p > 0 and count > 0:
                    shape[count - 1, 6] = _FREE
            if not kept:
                last_plain = False
                continue
            if known.headings.size > 0 and not is_known(x, y, known, since if q >= waited else 0):
                waiting[q] = True
                continue
            out[count, 0] = x
            out[count, 1] = y
            shape[count, 0] = ex
            shape[count, 1] = ey
            # A small obstacle has no walls beside which a path could not be taut.
            shape[count, 2] = 0.0 if lone else math.cos(a)
            shape[count, 3] = 0.0 if lone else math.sin(a)
            shape[count, 4] = 0.0 if lone else math.cos(b)
            shape[count, 5] = 0.0 if lone else math.sin(b)
            shape[count, 6] = limit if last_plain else _FREE
            last_plain = limit < _FREE
            count += 1
    return out[:count].copy(), shape[:count].copy(), waiting


@njit(cache=True)
def retire(position, kind, shape, n_vertices, touched, walls, start, items, need):
    """Retire the corners that the `touched` walls (m, 4) changed; the wall ends (k, 2) to judge anew."""
    again = np.empty((n_vertices, 2))
    count = 0
    if touched.shape[0] == 0:
        return again[:0].copy()
    reach = 2.0 * _NEIGHBOURHOOD
    x0 = min(touched[:, 0].min(), touched[:, 2].min()) - reach
    x1 = max(touched[:, 0].max(), touched[:, 2].max()) + reach
    y0 = min(touched[:, 1].min(), touched[:, 3].min()) - reach
    y1 = max(touched[:, 1].max(), touched[:, 3].max()) + reach
    for v in range(n_vertices):
        if kind[v] != CORNER:
            continue
        ex = shape[v, 0]
        ey = shape[v, 1]
        if ex < x0 or ex > x1 or ey < y0 or ey > y1:
            continue
        near = False
        for w in range(touched.shape[0]):
            if (
                max(touched[w, 0], touched[w, 2]) < ex - reach
                or min(touched[w, 0], touched[w, 2]) > ex + reach
                or max(touched[w, 1], touched[w, 3]) < ey - reach
                or min(touched[w, 1], touched[w, 3]) > ey + reach
            ):
                continue
            if point_segment_distance(ex, ey, touched[w, 0], touched[w, 1], touched[w, 2], touched[w, 3]) < reach:
                near = True
                break
        if not near:
            continue
        a, b, gap = _free_sector(ex, ey, walls, start, items)
        same = gap - math.pi >= _FLAT
        if gap < 3.0 * math.pi:
            for k, direction in ((2, a), (4, b)):
                # A direction of zero length stands for any.
                if shape[v, k] != 0.0 or shape[v, k + 1] != 0.0:
                    same &= shape[v, k] * math.cos(direction) + shape[v, k + 1] * math.sin(direction) > _SAME
        if same and clearance(position[v, 0], position[v, 1], walls, start, items, REACH) >= need - 0.005:
            continue
        # The vertices of one wall end serve together: judge it anew as a whole.
        for u in range(n_vertices):
            if kind[u] == CORNER and shape[u, 0] == ex and shape[u, 1] == ey:
                kind[u] = -1
        again[count, 0] = ex
        again[count, 1] = ey
        count += 1
    return again[:count].copy()


@njit(cache=True)
def _absorb(x, y, form, px, py, shape):
    """Whether the vertex at (px, py) with `shape` can stand for a candidate at (x, y) with `form`; if so, widen it.

    Both must stand beside each other and look the same way from their corners.
    """
    if norm(px - x, py - y) > _SPACING:
        return False
    # One that stands nearer to the candidate's own corner would let taut paths scrape it.
    if norm(px - form[0], py - form[1]) < norm(x - form[0], y - form[1]) - 0.01:
        return False
    rx = x - form[0]
    ry = y - form[1]
    qx = px - shape[0]
    qy = py - shape[1]
    if rx * qx + ry * qy <= 0.9 * norm(rx, ry) * norm(qx, qy):
        return False
    for k in (2, 4):
        if form[k] * shape[k] + form[k + 1] * shape[k + 1] < 0.95:
            # Their corners differ: what is taut past one need not be past the other.
            shape[k] = 0.0
            shape[k + 1] = 0.0
            shape[6] = _FREE
    if norm(shape[0] - form[0], shape[1] - form[1]) > _APART:
        # It now serves two wall ends.
        shape[2:6] = 0.0
        shape[6] = max(shape[6], _FREE)
    shape[6] = max(shape[6], form[6])
    return True


@njit(cache=True)
def distinct(candidates, forms, position, shape, kind, n_vertices):
    """Which candidates (m, 2) with `forms` (m, 7) no living corner vertex, or earlier candidate, can stand for."""
    m = candidates.shape[0]
    keep = np.ones(m, np.bool_)
    for i in range(m):
        x = candidates[i, 0]
        y = candidates[i, 1]
        apart = 0.0
        for v in range(n_vertices):
            if kind[v] != CORNER or abs(position[v, 0] - x) > _SPACING or abs(position[v, 1] - y) > _SPACING:
                continue
            if _absorb(x, y, forms[i], position[v, 0], position[v, 1], shape[v]):
                keep[i] = False
                apart = norm(forms[i, 0] - shape[v, 0], forms[i, 1] - shape[v, 1])
                break
        for j in range(i):
            if keep[i] and keep[j] and _absorb(x, y, forms[i], candidates[j, 0], candidates[j, 1], forms[j]):
                keep[i] = False
                apart = norm(forms[i, 0] - forms[j, 0], forms[i, 1] - forms[j, 1])
        if apart > _APART:
            # Its neighbours round the corner now turn to a vertex that stands a little elsewhere.
            for j in (i - 1, i + 1):
                if 0 <= j < m and forms[j, 0] == forms[i, 0] and forms[j, 1] == forms[i, 1]:
                    forms[j, 6] = max(forms[j, 6], _FREE)
    return keep


@njit(cache=True, inline="always")
def tangent(dx, dy, length, x, y, shape, v):
    """Whether a leg in direction d (a unit vector) at corner vertex v can be part of a taut path."""
    # Short legs turn round one corner, whose vertices need not stand just where they should.
    if shape[v, 6] >= OPEN_SPACE or length <= _SHORT:
        return True
    rx = x - shape[v, 0]
    ry = y - shape[v, 1]
    if abs(dx * rx + dy * ry) > shape[v, 6] * norm(rx, ry):
        return False
    side = dy * rx - dx * ry
    c1 = dx * shape[v, 3] - dy * shape[v, 2]
    c2 = dx * shape[v, 5] - dy * shape[v, 4]
    if side > 0.0:
        return c1 >= -_LEEWAY and c2 >= -_LEEWAY
    return c1 <= _LEEWAY and c2 <= _LEEWAY
