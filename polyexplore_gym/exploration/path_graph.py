"""The exploration graph: shortest collision-free paths for the robot's disc through known space.

A visibility graph over the inflated wall ends, kept between decisions. Walls block an edge for
good, open edges (the boundary to the unknown) only as long as they are there. Nodes and the robot
are leaves: paths end at them, none leads through. Every source (node) keeps a field of distances
that is repaired where the graph changed, instead of being searched anew (Ramalingam and Reps 1996).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.scan_polygon import contains
from polyexplore_gym.exploration.segments import (
    build_grid,
    clearance,
    crossing_free,
    point_segment_distance,
    segment_distance,
    sweep_free,
)

DEAD, OPEN, BLOCKED = 0, 1, 2
CORNER, LEAF = 0, 1

REACH = 0.45
"""Margin (m) of the wall grid: no clearance beyond it is ever asked for."""
_NEIGHBOURHOOD = 0.25
"""Radius (m) of the circle around a wall end on which its corner is judged: raggedness below it is no corner."""
_SPACING = 0.1
"""Two vertices nearer than this (m) are one."""
_MAX_LEAF_EDGE = 15.0
_MAX_EDGE = 10.0
"""Longest edges of the graph, to leaves and between corners, m."""
_FLAT = 0.2
"""A corner that turns less than this (rad) beyond straight gets no vertex."""
_ARC = math.pi / 4
"""A path turns round a corner in steps of at most this angle, rad."""
_TRAIL = 8.0
"""The same, for a place where the robot has driven: no wall refutes that."""
_TRAIL_EDGE = 0.6
"""Longest edge (m) from the way driven to anything else."""
_WAY_POINT = 4.0
_CORNER_NEAR = 1.5
"""A scan's place becomes a vertex where no other such place and no corner stands within these distances, m."""
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
_ANY = 4.0
"""Stands for the largest sine of a vertex in the open, without a corner."""


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
    cell = (math.floor(ex) * 73856093) ^ (math.floor(ey) * 19349663)
    b = cell & mask
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
                limit = _ANY
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
    if math.hypot(px - x, py - y) > _SPACING:
        return False
    # One that stands nearer to the candidate's own corner would let taut paths scrape it.
    if math.hypot(px - form[0], py - form[1]) < math.hypot(x - form[0], y - form[1]) - 0.01:
        return False
    rx = x - form[0]
    ry = y - form[1]
    qx = px - shape[0]
    qy = py - shape[1]
    if rx * qx + ry * qy <= 0.9 * math.hypot(rx, ry) * math.hypot(qx, qy):
        return False
    for k in (2, 4):
        if form[k] * shape[k] + form[k + 1] * shape[k + 1] < 0.95:
            # Their corners differ: what is taut past one need not be past the other.
            shape[k] = 0.0
            shape[k + 1] = 0.0
            shape[6] = _FREE
    if math.hypot(shape[0] - form[0], shape[1] - form[1]) > _APART:
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
                apart = math.hypot(forms[i, 0] - shape[v, 0], forms[i, 1] - shape[v, 1])
                break
        for j in range(i):
            if keep[i] and keep[j] and _absorb(x, y, forms[i], candidates[j, 0], candidates[j, 1], forms[j]):
                keep[i] = False
                apart = math.hypot(forms[i, 0] - forms[j, 0], forms[i, 1] - forms[j, 1])
        if apart > _APART:
            # Its neighbours round the corner now turn to a vertex that stands a little elsewhere.
            for j in (i - 1, i + 1):
                if 0 <= j < m and forms[j, 0] == forms[i, 0] and forms[j, 1] == forms[i, 1]:
                    forms[j, 6] = max(forms[j, 6], _FREE)
    return keep


@njit(cache=True, inline="always")
def _tangent(dx, dy, length, x, y, shape):
    """Whether a leg in direction d (a unit vector) at a corner vertex can be part of a taut path."""
    # Short legs turn round one corner, whose vertices need not stand just where they should.
    if shape[6] >= _ANY or length <= _SHORT:
        return True
    rx = x - shape[0]
    ry = y - shape[1]
    if abs(dx * rx + dy * ry) > shape[6] * math.hypot(rx, ry):
        return False
    side = dy * rx - dx * ry
    c1 = dx * shape[3] - dy * shape[2]
    c2 = dx * shape[5] - dy * shape[4]
    if side > 0.0:
        return c1 >= -_LEEWAY and c2 >= -_LEEWAY
    return c1 <= _LEEWAY and c2 <= _LEEWAY


@njit(cache=True)
def connect(fresh, position, shape, kind, n_vertices, walls, w_start, w_items, pieces, p_start, p_items, owner,
            vertex_owner, need, relaxed, slack):  # fmt: skip
    """New edges between the `fresh` vertices and all others: (e, 2) vertices, lengths, states, needs.

    `relaxed[v]` is the clearance that a leaf can offer where it stands (a bumped robot may stand
    nearer to a wall than paths do); `slack` how near (m) to a leaf an open edge may be crossed.
    """
    capacity = 256
    pairs = np.empty((capacity, 2), np.int64)
    length = np.empty(capacity)
    state = np.empty(capacity, np.int8)
    wants = np.empty(capacity)
    count = 0
    rank = np.full(n_vertices, -1, np.int64)
    for i in range(fresh.size):
        rank[fresh[i]] = i
    for i in range(fresh.size):
        u = fresh[i]
        ux = position[u, 0]
        uy = position[u, 1]
        for v in range(n_vertices):
            if v == u or kind[v] < 0 or rank[v] > i:
                continue
            dx = position[v, 0] - ux
            dy = position[v, 1] - uy
            limit = _MAX_LEAF_EDGE if kind[u] == LEAF or kind[v] == LEAF else _MAX_EDGE
            if abs(dx) > limit or abs(dy) > limit:
                continue
            d = math.hypot(dx, dy)
            if d > limit or (d > _TRAIL_EDGE and max(shape[u, 6], shape[v, 6]) >= _TRAIL):
                continue
            d1 = max(d, 1e-9)
            if kind[u] == CORNER and not _tangent(dx / d1, dy / d1, d, ux, uy, shape[u]):
                continue
            if kind[v] == CORNER and not _tangent(dx / d1, dy / d1, d, position[v, 0], position[v, 1], shape[v]):
                continue
            want = min(need, relaxed[u], relaxed[v])
            if not sweep_free(ux, uy, position[v, 0], position[v, 1], walls, w_start, w_items, want):
                continue
            free = crossing_free(
                ux, uy, position[v, 0], position[v, 1], pieces, p_start, p_items, owner,
                vertex_owner[u], vertex_owner[v],
                slack if kind[u] == LEAF else 0.0, slack if kind[v] == LEAF else 0.0,
            )  # fmt: skip
            if count == capacity:
                capacity *= 2
                pairs = np.concatenate((pairs, np.empty((count, 2), np.int64)))
                length = np.concatenate((length, np.empty(count)))
                state = np.concatenate((state, np.empty(count, np.int8)))
                wants = np.concatenate((wants, np.empty(count)))
            pairs[count, 0] = u
            pairs[count, 1] = v
            length[count] = d
            state[count] = OPEN if free else BLOCKED
            wants[count] = want
            count += 1
    return pairs[:count].copy(), length[:count].copy(), state[:count].copy(), wants[:count].copy()


@njit(cache=True)
def unblock(ends, state, n_edges, position, kind, box, pieces, p_start, p_items, owner, vertex_owner, slack):
    """Open the blocked edges meeting `box` (x0, y0, x1, y1) that no open edge crosses any more; which."""
    opened = np.empty(n_edges, np.int64)
    count = 0
    for e in range(n_edges):
        if state[e] != BLOCKED:
            continue
        u = ends[e, 0]
        v = ends[e, 1]
        ax = position[u, 0]
        ay = position[u, 1]
        bx = position[v, 0]
        by = position[v, 1]
        if max(ax, bx) < box[0] or min(ax, bx) > box[2] or max(ay, by) < box[1] or min(ay, by) > box[3]:
            continue
        if crossing_free(
            ax, ay, bx, by, pieces, p_start, p_items, owner, vertex_owner[u], vertex_owner[v],
            slack if kind[u] == LEAF else 0.0, slack if kind[v] == LEAF else 0.0,
        ):  # fmt: skip
            state[e] = OPEN
            opened[count] = e
            count += 1
    return opened[:count].copy()


@njit(cache=True)
def block_by_walls(ends, state, wants, length, n_edges, position, kind, n_vertices, shape, walls, need):
    """Kill the corner vertices and the edges that new walls (m, 4) come too near to; the edges that were open."""
    killed = np.empty(n_edges, np.int64)
    count = 0
    x0 = y0 = math.inf
    x1 = y1 = -math.inf
    for w in range(walls.shape[0]):
        x0 = min(x0, walls[w, 0] - need, walls[w, 2] - need)
        x1 = max(x1, walls[w, 0] + need, walls[w, 2] + need)
        y0 = min(y0, walls[w, 1] - need, walls[w, 3] - need)
        y1 = max(y1, walls[w, 1] + need, walls[w, 3] + need)
    middle = np.empty((walls.shape[0], 3))  # and the radius of a disc that holds the inflated wall
    for w in range(walls.shape[0]):
        middle[w, 0] = 0.5 * (walls[w, 0] + walls[w, 2])
        middle[w, 1] = 0.5 * (walls[w, 1] + walls[w, 3])
        middle[w, 2] = 0.5 * math.hypot(walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]) + need
    for v in range(n_vertices):
        x = position[v, 0]
        y = position[v, 1]
        if kind[v] != CORNER or shape[v, 6] >= _TRAIL or x < x0 or x > x1 or y < y0 or y > y1:
            continue
        for w in range(walls.shape[0]):
            if point_segment_distance(x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]) < need - 0.008:
                kind[v] = -1
                break
    for e in range(n_edges):
        if state[e] == DEAD:
            continue
        u = ends[e, 0]
        v = ends[e, 1]
        dead = kind[u] < 0 or kind[v] < 0
        if not dead:
            ax = position[u, 0]
            ay = position[u, 1]
            bx = position[v, 0]
            by = position[v, 1]
            if max(ax, bx) < x0 or min(ax, bx) > x1 or max(ay, by) < y0 or min(ay, by) > y1:
                continue
            ux = (bx - ax) / max(length[e], 1e-9)
            uy = (by - ay) / max(length[e], 1e-9)
            for w in range(walls.shape[0]):
                cx = middle[w, 0] - ax
                cy = middle[w, 1] - ay
                if abs(ux * cy - uy * cx) > middle[w, 2] or abs(ux * cx + uy * cy - 0.5 * length[e]) > (
                    middle[w, 2] + 0.5 * length[e]
                ):
                    continue
                # A wall refitted a few millimetres nearer does not cut the edge: it would flicker.
                if (
                    segment_distance(ax, ay, bx, by, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3])
                    < wants[e] - 0.002
                ):
                    dead = True
                    break
        if dead:
            if state[e] == OPEN:
                killed[count] = e
                count += 1
            state[e] = DEAD
    return killed[:count].copy()


@njit(cache=True)
def adjacency(ends, state, length, n_edges, kind, n_vertices):
    """Open edges by vertex: `first` (v + 1,) into `target` and `cost`; marks edges of dead vertices as dead."""
    first = np.zeros(n_vertices + 1, np.int64)
    for e in range(n_edges):
        if state[e] != DEAD and (kind[ends[e, 0]] < 0 or kind[ends[e, 1]] < 0):
            state[e] = DEAD
        if state[e] == OPEN:
            first[ends[e, 0] + 1] += 1
            first[ends[e, 1] + 1] += 1
    for v in range(n_vertices):
        first[v + 1] += first[v]
    target = np.empty(first[n_vertices], np.int64)
    cost = np.empty(first[n_vertices])
    fill = first[:-1].copy()
    for e in range(n_edges):
        if state[e] == OPEN:
            for side in range(2):
                v = ends[e, side]
                target[fill[v]] = ends[e, 1 - side]
                cost[fill[v]] = length[e]
                fill[v] += 1
    return first, target, cost


@njit(cache=True, inline="always")
def _push(heap_d, heap_v, size, d, v):
    i = size
    while i > 0:
        p = (i - 1) >> 1
        if heap_d[p] <= d:
            break
        heap_d[i] = heap_d[p]
        heap_v[i] = heap_v[p]
        i = p
    heap_d[i] = d
    heap_v[i] = v


@njit(cache=True, inline="always")
def _pop(heap_d, heap_v, size):
    """Removes the top (read it before); `size` is the size before."""
    d = heap_d[size - 1]
    v = heap_v[size - 1]
    n = size - 1
    i = 0
    while True:
        c = 2 * i + 1
        if c >= n:
            break
        if c + 1 < n and heap_d[c + 1] < heap_d[c]:
            c += 1
        if heap_d[c] >= d:
            break
        heap_d[i] = heap_d[c]
        heap_v[i] = heap_v[c]
        i = c
    heap_d[i] = d
    heap_v[i] = v


@njit(cache=True)
def _settle(dist, parent, source, heap_d, heap_v, size, first, target, cost, kind):
    """Dijkstra from a heap that is already filled; leaves but the source are not gone through."""
    while size > 0:
        d = heap_d[0]
        v = heap_v[0]
        _pop(heap_d, heap_v, size)
        size -= 1
        if d > dist[v] or (kind[v] == LEAF and v != source):
            continue
        for h in range(first[v], first[v + 1]):
            w = target[h]
            nd = d + cost[h]
            if nd < dist[w]:
                dist[w] = nd
                parent[w] = v
                if kind[w] != LEAF:
                    if size == heap_d.size:
                        heap_d = np.concatenate((heap_d, np.empty(size)))
                        heap_v = np.concatenate((heap_v, np.empty(size, np.int64)))
                    _push(heap_d, heap_v, size, nd, w)
                    size += 1


@njit(cache=True)
def search(dist, parent, source, first, target, cost, kind):
    """Fill the field of one source: shortest distances (v,) and the parents on the way back to it."""
    dist[:] = math.inf
    parent[:] = -1
    dist[source] = 0.0
    heap_d = np.empty(1024)
    heap_v = np.empty(1024, np.int64)
    heap_d[0] = 0.0
    heap_v[0] = source
    _settle(dist, parent, source, heap_d, heap_v, 1, first, target, cost, kind)


@njit(cache=True)
def repair(dist, parent, sources, killed, added, ends, state, length, first, target, cost, kind):
    """Repair the fields dist, parent (k, v) of `sources` after edges were killed and added (or opened)."""
    affected = np.empty(dist.shape[1], np.int64)
    for k in range(sources.size):
        s = sources[k]
        d = dist[k]
        p = parent[k]
        n_hit = 0
        for i in range(killed.size):
            e = killed[i]
            for side in range(2):
                v = ends[e, side]
                if p[v] == ends[e, 1 - side] and d[v] < math.inf:
                    p[v] = -1
                    d[v] = math.inf
                    affected[n_hit] = v
                    n_hit += 1
        i = 0
        while i < n_hit:
            v = affected[i]
            i += 1
            for h in range(first[v], first[v + 1]):
                w = target[h]
                if p[w] == v and d[w] < math.inf:
                    p[w] = -1
                    d[w] = math.inf
                    affected[n_hit] = w
                    n_hit += 1
        heap_d = np.empty(256 + n_hit + 2 * added.size)
        heap_v = np.empty(heap_d.size, np.int64)
        size = 0
        for i in range(n_hit):
            v = affected[i]
            for h in range(first[v], first[v + 1]):
                w = target[h]
                if (kind[w] != LEAF or w == s) and d[w] + cost[h] < d[v]:
                    d[v] = d[w] + cost[h]
                    p[v] = w
            if d[v] < math.inf and kind[v] != LEAF:
                _push(heap_d, heap_v, size, d[v], v)
                size += 1
        for i in range(added.size):
            e = added[i]
            if state[e] != OPEN:
                continue
            for side in range(2):
                v = ends[e, side]
                w = ends[e, 1 - side]
                if (kind[w] != LEAF or w == s) and d[w] + length[e] < d[v]:
                    d[v] = d[w] + length[e]
                    p[v] = w
                    if kind[v] != LEAF:
                        _push(heap_d, heap_v, size, d[v], v)
                        size += 1
        _settle(d, p, s, heap_d, heap_v, size, first, target, cost, kind)


@njit(cache=True)
def retreat(x, y, walls, start, items, need):
    """The nearest place with clearance `need` to go to from (x, y) leaving all near walls: (x, y, found).

    A robot that bumped stands closer to a wall than paths do, and the map is only good to
    millimetres: sliding along the wall would bump again.
    """
    mask = start.size - 2
    b = ((math.floor(x) * 73856093) ^ (math.floor(y) * 19349663)) & mask
    for step in range(1, 11):
        d = 0.04 * step
        best = need
        bx = x
        by = y
        for k in range(32):
            ux = math.cos(k * math.pi / 16)
            uy = math.sin(k * math.pi / 16)
            c = clearance(x + d * ux, y + d * uy, walls, start, items, REACH)
            if c < best:
                continue
            away = True
            for e in range(start[b], start[b + 1]):
                w = walls[items[e]]
                near = point_segment_distance(x, y, w[0], w[1], w[2], w[3])
                if near < need and (
                    point_segment_distance(x + 0.02 * ux, y + 0.02 * uy, w[0], w[1], w[2], w[3]) < near + 0.006
                ):
                    away = False
                    break
                if segment_distance(x, y, x + d * ux, y + d * uy, w[0], w[1], w[2], w[3]) < min(near, need) - 1e-6:
                    away = False
                    break
            if away:
                best = c + 1e-9
                bx = x + d * ux
                by = y + d * uy
        if best > need:
            return bx, by, True
    return x, y, False


@njit(cache=True)
def reachable(root, first, target, kind):
    """Which vertices an open path joins to `root`."""
    seen = np.zeros(first.size - 1, np.bool_)
    stack = np.empty(seen.size, np.int64)
    stack[0] = root
    seen[root] = True
    size = 1
    while size > 0:
        size -= 1
        v = stack[size]
        if kind[v] == LEAF and v != root:
            continue
        for h in range(first[v], first[v + 1]):
            w = target[h]
            if not seen[w]:
                seen[w] = True
                stack[size] = w
                size += 1
    return seen


EVERYTHING = Known(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), np.array([0.0, 1.0]), False, 0.0)
"""No limit to what is known."""


class PathGraph:
    """Owner of the graph. Positions in the map frame, lengths in metres."""

    def __init__(self, radius: float, spare: float, tolerance: float) -> None:
        """For a disc of `radius`: corners are passed at radius + `spare`, way points keep radius + `tolerance` to all
        walls, and the straight legs between them a fifth of the tolerance (a leg cuts the arc round a corner)."""
        self.radius = radius
        self.rho = radius + spare
        self.need = radius + tolerance
        self.sweep = radius + 0.2 * tolerance
        self.n_vertices = 0
        self.position = np.zeros((256, 2))
        self.shape = np.zeros((256, 7))
        self.kind = np.full(256, -1, np.int8)
        self.relaxed = np.full(256, math.inf)
        self.owner = np.full(256, -1, np.int64)
        self.n_edges = 0
        self.ends = np.zeros((1024, 2), np.int64)
        self.length = np.zeros(1024)
        self.state = np.zeros(1024, np.int8)
        self.wants = np.zeros(1024)
        self._open: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self.free_ids = np.zeros(0, np.int64)
        self._fresh = np.zeros(0, np.int64)
        self.waiting = np.zeros((0, 2))
        self._scans_known = 0
        self.sources = np.zeros(0, np.int64)
        self.dist = np.zeros((0, 256))
        self.parent = np.zeros((0, 256), np.int64)
        self.walls = np.zeros((0, 4))
        self.wall_grid = build_grid(self.walls, np.zeros(0, np.bool_), REACH)
        self.pieces = np.zeros((0, 4))
        self.piece_owner = np.zeros(0, np.int64)
        self.piece_grid = build_grid(self.pieces, np.zeros(0, np.bool_), 0.0)
        self._killed: list[np.ndarray] = []
        self._added: list[np.ndarray] = []

    # Obstacles -------------------------------------------------------------------------------

    def set_walls(
        self,
        walls: np.ndarray,
        alive: np.ndarray,
        touched: np.ndarray,
        known: Known = EVERYTHING,
        box: np.ndarray | None = None,
    ) -> None:
        """Take over the walls (m, 4) of the line map; `touched` rows changed since the last call.

        `known` tells which space is known, `box` (x0, y0, x1, y1) where that may have changed.
        """
        self.walls = walls
        self.wall_grid = build_grid(walls, alive, REACH)
        rows = touched[alive[touched]]
        again = retire(
            self.position, self.kind, self.shape, self.n_vertices, walls[touched], walls, *self.wall_grid, self.need
        )
        killed = block_by_walls(
            self.ends, self.state, self.wants, self.length, self.n_edges, self.position, self.kind, self.n_vertices,
            self.shape, walls[rows], self.need,
        )  # fmt: skip
        if killed.size:
            self._killed.append(killed)
        waiting = self.waiting
        if box is not None:
            inside = ((waiting >= box[:2]) & (waiting <= box[2:])).all(axis=1)
            waiting, self.waiting = waiting[inside], waiting[~inside]
        ends = np.concatenate((again, walls[rows, :2], walls[rows, 2:], waiting))
        candidates, shape, more = corner_vertices(
            ends, walls, *self.wall_grid, self.rho, self.need, known, len(ends) - len(waiting), self._scans_known
        )
        self._scans_known = len(known.headings)
        self.waiting = np.concatenate((self.waiting, ends[more]))
        keep = distinct(candidates, shape, self.position, self.shape, self.kind, self.n_vertices)
        self._fresh = self._new_vertices(candidates[keep], shape[keep])

    def set_pieces(self, pieces: np.ndarray, owner: np.ndarray) -> None:
        """Take over the open edges (m, 4) and the chain that owns each; opens what they no longer block."""
        self.pieces = pieces
        self.piece_owner = owner
        self.piece_grid = build_grid(pieces, np.ones(len(pieces), np.bool_), 0.0)

    def refresh(self, box: np.ndarray, slack: float) -> None:
        """After walls and open edges were set: open blocked edges meeting `box`, connect the new corners."""
        opened = unblock(
            self.ends, self.state, self.n_edges, self.position, self.kind, box, self.pieces, *self.piece_grid,
            self.piece_owner, self.owner, slack,
        )  # fmt: skip
        self._open = None
        if opened.size:
            self._added.append(opened)
        self._connect(self._fresh, slack)

    def repair(self) -> None:
        """Bring all distance fields up to date."""
        killed = np.concatenate(self._killed) if self._killed else np.zeros(0, np.int64)
        added = np.concatenate(self._added) if self._added else np.zeros(0, np.int64)
        self._killed, self._added = [], []
        if len(self.sources) and (killed.size or added.size):
            repair(self.dist, self.parent, self.sources, killed, added, self.ends, self.state, self.length,
                   *self.open_edges(), self.kind)  # fmt: skip

    def open_edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The open edges by vertex, see `adjacency`; made anew when the graph has changed."""
        if self._open is None:
            self._open = adjacency(self.ends, self.state, self.length, self.n_edges, self.kind, self.n_vertices)
        return self._open

    def add_way_point(self, x: float, y: float) -> None:
        """Make a place where the robot stood a vertex, if others are far: halls have no corners in their middle."""
        n = self.n_vertices
        near = np.abs(self.position[:n] - (x, y)).max(axis=1)
        corner = self.kind[:n] == CORNER
        in_the_open = corner & (self.shape[:n, 6] >= _ANY)
        if not (corner & (near < _CORNER_NEAR)).any() and not (in_the_open & (near < _WAY_POINT)).any():
            shape = np.array([[x + 1e6, y, 1.0, 0.0, 1.0, 0.0, _ANY]])
            self._fresh = np.concatenate((self._fresh, self._new_vertices(np.array([[x, y]]), shape)))

    # Vertices --------------------------------------------------------------------------------

    def clearance(self, x: float, y: float) -> float:
        """Distance to the nearest wall, m, `REACH` at most."""
        return float(clearance(x, y, self.walls, *self.wall_grid, REACH))

    def add_leaf(self, x: float, y: float, owner: int, slack: float) -> int:
        """A vertex where paths end, connected to all that it sees. Returns its index."""
        at = self._new_vertices(np.array([[x, y]]), np.zeros((1, 7)), LEAF, owner)
        v = int(at[0])
        self.relaxed[v] = max(self.clearance(x, y) - 0.005, 0.05)
        self._connect(at, slack)
        return v

    def remove_leaves(self, vertices: np.ndarray) -> None:
        """Take leaves out, and their fields; no other path leads through them."""
        self._open = None
        self.kind[vertices] = -1
        gone = np.zeros(len(self.kind), np.bool_)
        gone[vertices] = True
        if gone[self.sources].any():
            keep = ~gone[self.sources]
            self.sources, self.dist, self.parent = self.sources[keep], self.dist[keep], self.parent[keep]
        self.dist[:, vertices] = math.inf
        self.parent[:, vertices] = -1

    def _new_vertices(self, position: np.ndarray, shape: np.ndarray, kind: int = CORNER, owner: int = -1) -> np.ndarray:
        m = len(position)
        reused = self.free_ids[:m]
        self.free_ids = self.free_ids[m:]
        fresh = m - len(reused)
        self._grow_vertices(self.n_vertices + fresh)
        ids = np.concatenate((reused, np.arange(self.n_vertices, self.n_vertices + fresh)))
        self.n_vertices += fresh
        self.position[ids] = position
        self.shape[ids] = shape
        self.kind[ids] = kind
        self.owner[ids] = owner
        self.relaxed[ids] = math.inf
        self._open = None
        return ids

    def _grow_vertices(self, size: int) -> None:
        capacity = len(self.kind)
        if size <= capacity:
            return
        while capacity < size:
            capacity *= 2
        extra = capacity - len(self.kind)
        self.position = np.concatenate((self.position, np.zeros((extra, 2))))
        self.shape = np.concatenate((self.shape, np.zeros((extra, 7))))
        self.kind = np.concatenate((self.kind, np.full(extra, -1, np.int8)))
        self.relaxed = np.concatenate((self.relaxed, np.full(extra, math.inf)))
        self.owner = np.concatenate((self.owner, np.full(extra, -1, np.int64)))
        k = len(self.sources)
        self.dist = np.concatenate((self.dist, np.full((k, extra), math.inf)), axis=1)
        self.parent = np.concatenate((self.parent, np.full((k, extra), -1, np.int64)), axis=1)

    def add_trail(self, points: np.ndarray, robot: int) -> None:
        """Make the way driven (k, 2) part of the graph, up to the robot: it led here, so it leads back."""
        shape = np.tile([1e9, 0.0, 1.0, 0.0, 1.0, 0.0, _TRAIL], (len(points), 1))
        ids = self._new_vertices(points, shape)
        self._connect(ids, 0.0)
        chain = np.append(ids, robot)
        pairs = np.stack((chain[:-1], chain[1:]), axis=1)
        length = np.hypot(*(self.position[pairs[:, 0]] - self.position[pairs[:, 1]]).T)
        self._add_edges(pairs, length, np.full(len(pairs), OPEN, np.int8), np.zeros(len(pairs)))

    def _connect(self, fresh: np.ndarray, slack: float) -> None:
        if not len(fresh):
            return
        pairs, length, state, wants = connect(
            fresh, self.position, self.shape, self.kind, self.n_vertices, self.walls, *self.wall_grid,
            self.pieces, *self.piece_grid, self.piece_owner, self.owner, self.sweep, self.relaxed, slack,
        )  # fmt: skip
        self._add_edges(pairs, length, state, wants)

    def _add_edges(self, pairs: np.ndarray, length: np.ndarray, state: np.ndarray, wants: np.ndarray) -> None:
        m = len(pairs)
        first = self.n_edges
        if first + m > len(self.state):
            extra = max(first + m - len(self.state), len(self.state))
            self.ends = np.concatenate((self.ends, np.zeros((extra, 2), np.int64)))
            self.length = np.concatenate((self.length, np.zeros(extra)))
            self.state = np.concatenate((self.state, np.zeros(extra, np.int8)))
            self.wants = np.concatenate((self.wants, np.zeros(extra)))
        rows = slice(first, first + m)
        self.ends[rows] = pairs
        self.length[rows] = length
        self.state[rows] = state
        self.wants[rows] = wants
        self.n_edges += m
        self._open = None
        self._added.append(np.arange(first, self.n_edges))

    def compact(self) -> None:
        """Drop dead edges, then free the indices of dead vertices. Call after `repair`."""
        self.open_edges()
        alive = np.flatnonzero(self.state[: self.n_edges])
        if len(alive) > 0.6 * self.n_edges and len(self.free_ids):
            return
        n = len(alive)
        self.ends[:n] = self.ends[alive]
        self.length[:n] = self.length[alive]
        self.state[:n] = self.state[alive]
        self.wants[:n] = self.wants[alive]
        self.state[n : self.n_edges] = DEAD
        self.n_edges = n
        self.free_ids = np.flatnonzero(self.kind[: self.n_vertices] < 0)

    def retreat(self, x: float, y: float) -> tuple[float, float, bool]:
        """Where to go first from a place nearer to a wall than paths are, and whether there is such a place."""
        if self.clearance(x, y) >= self.need:
            return x, y, True
        return retreat(x, y, self.walls, *self.wall_grid, self.need)

    # Fields ----------------------------------------------------------------------------------

    def set_sources(self, vertices: np.ndarray, rows: np.ndarray) -> None:
        """The vertices to keep distance fields for; `rows` names the old row of each, -1 where it is new."""
        capacity = len(self.kind)
        dist = np.full((len(vertices), capacity), math.inf)
        parent = np.full((len(vertices), capacity), -1, np.int64)
        kept = rows >= 0
        dist[kept] = self.dist[rows[kept]]
        parent[kept] = self.parent[rows[kept]]
        self.dist, self.parent, self.sources = dist, parent, np.asarray(vertices, np.int64)
        for k in np.flatnonzero(~kept):
            search(dist[k], parent[k], self.sources[k], *self.open_edges(), self.kind)

    def path(self, row: int, vertex: int) -> np.ndarray:
        """Way points (k, 2) from a vertex to the source of a field, both included."""
        points = [self.position[vertex]]
        v = vertex
        while v != self.sources[row]:
            v = int(self.parent[row, v])
            points.append(self.position[v])
        return np.array(points)

    def reachable(self, root: int) -> np.ndarray:
        """Which vertices (n_vertices,) an open path joins to `root`."""
        first, target, _ = self.open_edges()
        return reachable(root, first, target, self.kind)
