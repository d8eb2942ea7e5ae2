"""Corners: where a shortest path of the robot's disc turns.

Paths turn at wall ends. Around each stand a few vertices, on a polyline at the radius and a little more; a leg
belongs to a path through a vertex only if it is taut there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.scan_polygon import is_known
from polyexplore_gym.exploration.segments import bucket_at, clearance, norm, point_segment_distance

CORNER, LEAF, BEND = 0, 1, 2
"""Kinds of vertices: at walls and where the robot was; where paths end; at open edges. -1 is none."""

_FLAT = 0.2
"""A corner that turns less than this (rad) beyond straight gets no vertex."""
_ARC = math.pi / 4
"""A path turns round a corner in steps of at most this angle, rad."""
_SAME = 0.92
"""Cosine above which a wall leaves its end as it did when the corner was judged: the map breathes."""
_LEEWAY = 0.15
"""Sine by which a path through a corner vertex may miss being taut: the map is noisy."""
_FREE = 2.0
"""Stands for the largest sine where a vertex serves every direction past its corner."""
OPEN_SPACE = 4.0
"""Stands for the largest sine of a vertex in the open, without a corner."""
GATE = 5.0
"""The same, in a narrow passage, where a hand's breadth decides."""
TRAIL = 8.0
"""The same, for a place where the robot has driven: no wall refutes that."""
_AXIS = (0.0, 0.7, -0.7, 1.3, -1.3)
"""Where vertices stand on the axis of a narrow passage, in radii from its middle: the way in must be straight."""
_NARROW = 2.32
"""Passages narrower than this, in radii, need vertices on their axis; wider ones are passed from corner to corner."""


class Shapes(NamedTuple):
    """What paths may do at vertices, one row each."""

    anchor: np.ndarray
    """(v, 2) the wall end, m"""
    first: np.ndarray
    """(v, 2) direction of the wall on one side of the free sector; (0, 0) stands for any"""
    second: np.ndarray
    """(v, 2) and on the other"""
    limit: np.ndarray
    """(v,) sine of the largest angle between a taut path and the tangent; or `_FREE`, `OPEN_SPACE`, `TRAIL`"""

    @classmethod
    def none(cls, rows: int) -> Shapes:
        """So many rows, all zero."""
        return cls(np.zeros((rows, 2)), np.zeros((rows, 2)), np.zeros((rows, 2)), np.zeros(rows))

    @classmethod
    def free(cls, points: np.ndarray, limit: float) -> Shapes:
        """Of places (k, 2) without a corner."""
        k = len(points)
        return cls(np.full((k, 2), math.inf), np.zeros((k, 2)), np.zeros((k, 2)), np.full(k, limit))

    def put(self, rows: np.ndarray, other: Shapes) -> None:
        """Write other rows into these."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs

    def take(self, rows: np.ndarray) -> Shapes:
        """Some rows."""
        return Shapes(*(column[rows] for column in self))


@njit(cache=True)
def _free_sector(ex, ey, walls, tol):
    """The widest free sector around a wall end: the directions (from, to) of the walls that bound it.

    Walls are judged where they cross a small circle; returns (a, b, width) with b = a + width. One
    wall leaves 2 pi; where nothing crosses the circle, width is 4 pi: the obstacle is small.
    """
    h = tol.neighbourhood
    segments = walls.segments
    b = bucket_at(ex, ey, walls)
    angles = np.empty(2 * (walls.start[b + 1] - walls.start[b]))
    n = 0
    for e in range(walls.start[b], walls.start[b + 1]):
        i = walls.items[e]
        x1 = segments[i, 0] - ex
        y1 = segments[i, 1] - ey
        x2 = segments[i, 2] - ex
        y2 = segments[i, 3] - ey
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
            if 0.0 <= t <= 1.0:
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
def _in_narrows(ex, ey, ux, uy, walls, tol):
    """Distance from a wall end at which its direction u has the most room, and how much: where a passage is narrow.

    Clearance rises and falls once between the end and what faces it: coarse steps, then halving where it is tight.
    """
    best = 0.0
    room = -1.0
    step = 0.16 * tol.radius
    d = tol.need
    while d <= 1.6 * tol.radius:
        c = clearance(ex + d * ux, ey + d * uy, walls, tol.reach)
        if c > room:
            room = c
            best = d
        d += step
    # A step changes the clearance by its length at most: no use where even that is too little.
    while room < tol.stand and room + step >= tol.need and step > 0.002 * tol.radius:
        step *= 0.5
        for side in (-step, step):
            d = best + side
            c = clearance(ex + d * ux, ey + d * uy, walls, tol.reach) if d >= tol.need else -1.0
            if c > room:
                room = c
                best = d
    return best, room


@njit(cache=True)
def _across(ex, ey, walls, tol):
    """What faces a wall end across a narrow passage: (x, y, found), the nearest point of it.

    It lies at least two `tol.need` away, and the middle between is nearer to no other wall.
    """
    segments = walls.segments
    best = _NARROW * tol.radius  # less than the grid's margin: all that counts stands in the end's own cell
    fx = 0.0
    fy = 0.0
    found = False
    b = bucket_at(ex, ey, walls)
    for k in range(walls.start[b], walls.start[b + 1]):
        i = walls.items[k]
        dx = segments[i, 2] - segments[i, 0]
        dy = segments[i, 3] - segments[i, 1]
        q = dx * dx + dy * dy
        t = 0.0
        if q > 0.0:
            t = min(max(((ex - segments[i, 0]) * dx + (ey - segments[i, 1]) * dy) / q, 0.0), 1.0)
        x = segments[i, 0] + t * dx
        y = segments[i, 1] + t * dy
        d = norm(x - ex, y - ey)
        if (
            2.0 * tol.sweep <= d < best
            and clearance(0.5 * (x + ex), 0.5 * (y + ey), walls, tol.reach) >= 0.5 * d - 0.1 * tol.still
        ):
            best = d
            fx = x
            fy = y
            found = True
    return fx, fy, found


@njit(cache=True)
def corner_vertices(ends, walls, scans, waited, since, tol):
    """Vertices around wall ends (m, 2): their positions (v, 2) and shapes.

    Only vertices in known space (all space if nothing is said to be known); third, which ends have
    more of them waiting in the unknown. The ends from number `waited` on were judged before: for
    them only the scans from number `since` on can have news.

    They stand at the radius and the spare from the end on a polyline around it, nearer where the passage is narrow
    but never nearer than `tol.need` to any wall; in a narrow passage others stand on its axis.
    """
    rho = tol.radius + tol.spare
    rows = 16 * ends.shape[0]
    out = np.empty((rows, 2))
    shape = Shapes(np.empty((rows, 2)), np.empty((rows, 2)), np.empty((rows, 2)), np.empty(rows))
    waiting = np.zeros(ends.shape[0], np.bool_)
    count = 0
    twin_within = 2.0 * tol.same_corner / 3.0
    for q in range(ends.shape[0]):
        ex = ends[q, 0]
        ey = ends[q, 1]
        twin = False
        for p in range(q):
            if abs(ends[p, 0] - ex) < twin_within and abs(ends[p, 1] - ey) < twin_within:
                twin = True
                break
        if twin:
            continue
        a, b, gap = _free_sector(ex, ey, walls, tol)
        lone = gap > 3.0 * math.pi
        turn = 2.0 * math.pi if lone else gap - math.pi
        if turn < _FLAT:
            continue
        news = since if q >= waited else 0
        parts = math.ceil(turn / _ARC - 1e-9)
        first = a if lone else a + 0.5 * math.pi
        last_plain = True
        narrow = False
        for p in range(parts):
            half = 0.5 * turn / parts
            direction = first + (2 * p + 1) * half
            ux = math.cos(direction)
            uy = math.sin(direction)
            away = rho / math.cos(half)
            x = ex + away * ux
            y = ey + away * uy
            limit = math.sin(half) + _LEEWAY
            kept = True
            room = clearance(x, y, walls, tol.reach)
            # Something else is nearer than the wall end: from one side of a passage to the other no leg need be free.
            narrow |= room < rho
            if room < tol.stand:
                away, room = _in_narrows(ex, ey, ux, uy, walls, tol)
                x = ex + away * ux
                y = ey + away * uy
                limit = OPEN_SPACE
                kept = room >= tol.need
                # The neighbour on the polyline takes over its directions.
                if last_plain and p > 0 and count > 0:
                    shape.limit[count - 1] = _FREE
            if not kept:
                last_plain = False
                continue
            if scans.headings.size > 0 and not is_known(x, y, scans, news):
                waiting[q] = True
                continue
            out[count, 0] = x
            out[count, 1] = y
            shape.anchor[count, 0] = ex
            shape.anchor[count, 1] = ey
            # A small obstacle has no walls beside which a path could not be taut.
            shape.first[count, 0] = 0.0 if lone else math.cos(a)
            shape.first[count, 1] = 0.0 if lone else math.sin(a)
            shape.second[count, 0] = 0.0 if lone else math.cos(b)
            shape.second[count, 1] = 0.0 if lone else math.sin(b)
            shape.limit[count] = limit if last_plain else _FREE
            last_plain = limit < _FREE
            count += 1
        if not narrow:
            continue
        fx, fy, found = _across(ex, ey, walls, tol)
        if not found:
            continue
        d = norm(fx - ex, fy - ey)
        ux = -(fy - ey) / d
        uy = (fx - ex) / d
        for k in _AXIS:
            x = 0.5 * (ex + fx) + k * tol.radius * ux
            y = 0.5 * (ey + fy) + k * tol.radius * uy
            if clearance(x, y, walls, tol.reach) < tol.sweep:
                continue
            if scans.headings.size > 0 and not is_known(x, y, scans, news):
                waiting[q] = True
                continue
            out[count, 0] = x
            out[count, 1] = y
            shape.anchor[count, 0] = ex
            shape.anchor[count, 1] = ey
            shape.first[count] = 0.0
            shape.second[count] = 0.0
            shape.limit[count] = GATE
            count += 1
    return (
        out[:count].copy(),
        Shapes(
            shape.anchor[:count].copy(), shape.first[:count].copy(), shape.second[:count].copy(),
            shape.limit[:count].copy(),
        ),
        waiting,
    )  # fmt: skip


@njit(cache=True)
def retire(position, kind, shape, n_vertices, touched, walls, tol):
    """Retire the corners that the `touched` walls (m, 4) changed; the wall ends (k, 2) to judge anew."""
    again = np.empty((n_vertices, 2))
    count = 0
    if touched.shape[0] == 0:
        return again[:0].copy()
    reach = 2.0 * tol.neighbourhood
    x0 = min(touched[:, 0].min(), touched[:, 2].min()) - reach
    x1 = max(touched[:, 0].max(), touched[:, 2].max()) + reach
    y0 = min(touched[:, 1].min(), touched[:, 3].min()) - reach
    y1 = max(touched[:, 1].max(), touched[:, 3].max()) + reach
    for v in range(n_vertices):
        if kind[v] != CORNER:
            continue
        ex = shape.anchor[v, 0]
        ey = shape.anchor[v, 1]
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
        a, b, gap = _free_sector(ex, ey, walls, tol)
        same = gap - math.pi >= _FLAT
        if gap < 3.0 * math.pi:
            for side, direction in ((shape.first[v], a), (shape.second[v], b)):
                # A direction of zero length stands for any.
                if side[0] != 0.0 or side[1] != 0.0:
                    same &= side[0] * math.cos(direction) + side[1] * math.sin(direction) > _SAME
        if same and clearance(position[v, 0], position[v, 1], walls, tol.reach) >= tol.sweep:
            continue
        # The vertices of one wall end serve together: judge it anew as a whole.
        for u in range(n_vertices):
            if kind[u] == CORNER and shape.anchor[u, 0] == ex and shape.anchor[u, 1] == ey:
                kind[u] = -1
        again[count, 0] = ex
        again[count, 1] = ey
        count += 1
    return again[:count].copy()


@njit(cache=True)
def _absorb(x, y, form, i, px, py, shape, v, tol):
    """Whether the vertex v at (px, py) can stand for the candidate i at (x, y) with `form`; if so, widen its shape.

    Both must stand beside each other and look the same way from their corners.
    """
    if norm(px - x, py - y) > tol.same_vertex or math.isinf(shape.anchor[v, 0]):
        return False
    # One that stands nearer to the candidate's own corner would let taut paths scrape it.
    rx = x - form.anchor[i, 0]
    ry = y - form.anchor[i, 1]
    if norm(px - form.anchor[i, 0], py - form.anchor[i, 1]) < norm(rx, ry) - tol.same_corner / 3.0:
        return False
    qx = px - shape.anchor[v, 0]
    qy = py - shape.anchor[v, 1]
    if rx * qx + ry * qy <= 0.9 * norm(rx, ry) * norm(qx, qy):
        return False
    if form.first[i, 0] * shape.first[v, 0] + form.first[i, 1] * shape.first[v, 1] < 0.95:
        # Their corners differ: what is taut past one need not be past the other.
        shape.first[v] = 0.0
        shape.limit[v] = _FREE
    if form.second[i, 0] * shape.second[v, 0] + form.second[i, 1] * shape.second[v, 1] < 0.95:
        shape.second[v] = 0.0
        shape.limit[v] = _FREE
    if norm(shape.anchor[v, 0] - form.anchor[i, 0], shape.anchor[v, 1] - form.anchor[i, 1]) > tol.same_corner:
        # It now serves two wall ends.
        shape.first[v] = 0.0
        shape.second[v] = 0.0
        shape.limit[v] = max(shape.limit[v], _FREE)
    shape.limit[v] = max(shape.limit[v], form.limit[i])
    return True


@njit(cache=True)
def distinct(candidates, forms, position, shape, kind, n_vertices, tol):
    """Which candidates (m, 2) with `forms` no living corner vertex, or earlier candidate, can stand for."""
    m = candidates.shape[0]
    keep = np.ones(m, np.bool_)
    for i in range(m):
        x = candidates[i, 0]
        y = candidates[i, 1]
        if forms.limit[i] == GATE:
            for v in range(n_vertices):
                if kind[v] == CORNER and norm(position[v, 0] - x, position[v, 1] - y) < tol.still:
                    keep[i] = False
                    break
            for j in range(i):
                if keep[j] and norm(candidates[j, 0] - x, candidates[j, 1] - y) < tol.still:
                    keep[i] = False
                    break
            continue
        apart = 0.0
        for v in range(n_vertices):
            if (
                kind[v] != CORNER
                or abs(position[v, 0] - x) > tol.same_vertex
                or abs(position[v, 1] - y) > tol.same_vertex
            ):
                continue
            if _absorb(x, y, forms, i, position[v, 0], position[v, 1], shape, v, tol):
                keep[i] = False
                apart = norm(forms.anchor[i, 0] - shape.anchor[v, 0], forms.anchor[i, 1] - shape.anchor[v, 1])
                break
        for j in range(i):
            if keep[i] and keep[j] and _absorb(x, y, forms, i, candidates[j, 0], candidates[j, 1], forms, j, tol):
                keep[i] = False
                apart = norm(forms.anchor[i, 0] - forms.anchor[j, 0], forms.anchor[i, 1] - forms.anchor[j, 1])
        if apart > tol.same_corner:
            # Its neighbours round the corner now turn to a vertex that stands a little elsewhere.
            for j in (i - 1, i + 1):
                if 0 <= j < m and forms.anchor[j, 0] == forms.anchor[i, 0] and forms.anchor[j, 1] == forms.anchor[i, 1]:
                    forms.limit[j] = max(forms.limit[j], _FREE)
    return keep


@njit(cache=True)
def tangent(dx, dy, length, rx, ry, ax, ay, bx, by, limit, short):
    """Whether a leg in direction d (a unit vector) at a vertex r from its corner can be part of a taut path.

    Its walls run in the directions a and b from there (see `Shapes`). Numbers, not arrays: these would cost more to
    hand over than what is done with them.
    """
    # Short legs turn round one corner, whose vertices need not stand just where they should.
    if limit >= OPEN_SPACE or length <= short:
        return True
    if abs(dx * rx + dy * ry) > limit * norm(rx, ry):
        return False
    side = dy * rx - dx * ry
    c1 = dx * ay - dy * ax
    c2 = dx * by - dy * bx
    if side > 0.0:
        return c1 >= -_LEEWAY and c2 >= -_LEEWAY
    return c1 <= _LEEWAY and c2 <= _LEEWAY


@njit(cache=True)
def _bend(x, y, ax, ay, bx, by, walls, tol, out, shape, count):
    """Append the vertex for paths round the point (x, y) between open edges that leave it in the directions a and b.

    The known space lies from a counter-clockwise to b. Returns the new number of vertices.
    """
    wide = math.atan2(ax * by - ay * bx, ax * bx + ay * by)
    if wide <= 0.0:
        wide += 2.0 * math.pi
    turn = wide - math.pi
    if turn < _FLAT:
        return count
    direction = math.atan2(ay, ax) + 0.5 * wide
    px = x + tol.crumb * math.cos(direction)
    py = y + tol.crumb * math.sin(direction)
    if clearance(px, py, walls, tol.reach) < tol.need:
        return count
    out[count, 0] = px
    out[count, 1] = py
    shape.anchor[count, 0] = x
    shape.anchor[count, 1] = y
    shape.first[count, 0] = ax
    shape.first[count, 1] = ay
    shape.second[count, 0] = bx
    shape.second[count, 1] = by
    shape.limit[count] = math.sin(0.5 * turn) + _LEEWAY
    return count + 1


@njit(cache=True)
def bend_vertices(segments, sigma, box, walls, tol):
    """Vertices where a shortest path may turn round open edges (m, 4) inside `box`: positions (v, 2) and shapes.

    At a bend of the boundary of what is known, and at an open edge that ends where no other begins. Nothing has to be
    kept from an open edge: they stand right beside it.
    """
    m = segments.shape[0]
    out = np.empty((2 * m, 2))
    shape = Shapes(np.empty((2 * m, 2)), np.empty((2 * m, 2)), np.empty((2 * m, 2)), np.empty(2 * m))
    has_before = np.zeros(m, np.bool_)
    ux = np.empty(m)
    uy = np.empty(m)
    for i in range(m):
        size = norm(segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1])
        ux[i] = (segments[i, 2] - segments[i, 0]) / size
        uy[i] = (segments[i, 3] - segments[i, 1]) / size
    count = 0
    for i in range(m):
        x = segments[i, 2]
        y = segments[i, 3]
        if x < box[0] or x > box[2] or y < box[1] or y > box[3]:
            continue
        after = -1
        best = math.inf
        for j in range(m):
            limit = tol.join + 2.0 * max(sigma[i], sigma[j])
            if j == i or abs(segments[j, 0] - x) > limit or abs(segments[j, 1] - y) > limit:
                continue
            d = norm(segments[j, 0] - x, segments[j, 1] - y)
            if d < min(best, limit):
                best = d
                after = j
        if after < 0:
            count = _bend(x, y, -ux[i], -uy[i], -ux[i], -uy[i], walls, tol, out, shape, count)
        else:
            has_before[after] = True
            count = _bend(x, y, ux[after], uy[after], -ux[i], -uy[i], walls, tol, out, shape, count)
    for j in range(m):
        x = segments[j, 0]
        y = segments[j, 1]
        if not has_before[j] and box[0] <= x <= box[2] and box[1] <= y <= box[3]:
            count = _bend(x, y, ux[j], uy[j], ux[j], uy[j], walls, tol, out, shape, count)
    return (
        out[:count].copy(),
        Shapes(
            shape.anchor[:count].copy(), shape.first[:count].copy(), shape.second[:count].copy(),
            shape.limit[:count].copy(),
        ),
    )  # fmt: skip


@njit(cache=True)
def still_there(position, kind, n_vertices, candidates, box, tol):
    """Which bends (v,) no candidate (k, 2) stands for any more, and which candidates are new; only inside `box`."""
    gone = np.zeros(n_vertices, np.bool_)
    new = np.ones(candidates.shape[0], np.bool_)
    for v in range(n_vertices):
        x = position[v, 0]
        y = position[v, 1]
        if kind[v] != BEND or x < box[0] or x > box[2] or y < box[1] or y > box[3]:
            continue
        gone[v] = True
        for k in range(candidates.shape[0]):
            if abs(candidates[k, 0] - x) < tol.still and abs(candidates[k, 1] - y) < tol.still:
                gone[v] = False
                new[k] = False
    for k in range(candidates.shape[0]):
        for i in range(k):
            if (
                new[i]
                and abs(candidates[k, 0] - candidates[i, 0]) < tol.still
                and abs(candidates[k, 1] - candidates[i, 1]) < tol.still
            ):
                new[k] = False
    return gone, new
