"""Links: the edges of the exploration graph, kept at their vertices, and what opens, blocks and cuts them.

Walls cut an edge for good; open edges of the explored area (the boundary to the unknown) block it only as long as they
are there. Blocked edges are kept in a list of their own, so that searches never meet them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.corners import BEND, CORNER, LEAF, TRAIL, Shapes, tangent
from polyexplore_gym.exploration.segments import (
    crossing_free,
    first_hit,
    norm,
    point_segment_distance,
    segment_distance,
    sweep_free,
)

_BLOCKERS = 8
"""So many walls that blocked the last legs are tried before all others."""


class Vertices(NamedTuple):
    """Vertices of the graph, one row each."""

    position: np.ndarray
    """(v, 2), m"""
    shape: Shapes
    """(v,) what paths may do there"""
    kind: np.ndarray
    """(v,) CORNER, LEAF, BEND, or -1: none"""
    owner: np.ndarray
    """(v,) the jump edge that a leaf may look through, -1 for none"""
    relaxed: np.ndarray
    """(v,) clearance that a leaf can offer where it stands: a bumped robot may stand nearer to a wall than paths do"""


class Links(NamedTuple):
    """Half-edges by vertex: those of v are `degree[v]` rows from `first[v]` on, in a block with room for `room[v]`."""

    first: np.ndarray
    """(v,)"""
    degree: np.ndarray
    """(v,)"""
    room: np.ndarray
    """(v,)"""
    target: np.ndarray
    """(h,) the vertex at the other end"""
    cost: np.ndarray
    """(h,) length, m"""
    want: np.ndarray
    """(h,) clearance that the edge needs, m"""

    @classmethod
    def none(cls, vertices: int, rows: int) -> Links:
        """Nothing yet, with space for so many vertices and half-edges."""
        z = np.zeros(vertices, np.int64)
        return cls(z, z.copy(), z.copy(), np.zeros(rows, np.uint32), np.zeros(rows), np.zeros(rows))


@njit(cache=True)
def insert(pairs, length, wants, links, used):
    """Add edges (e, 2). Returns the rows then in use; or, adding nothing, minus the rows that were too few."""
    more = np.zeros(links.first.size, np.int64)
    for e in range(pairs.shape[0]):
        more[pairs[e, 0]] += 1
        more[pairs[e, 1]] += 1
    extra = 0
    for v in range(more.size):
        if links.degree[v] + more[v] > links.room[v]:
            size = 8
            while size < links.degree[v] + more[v]:
                size *= 2
            more[v] = size
            extra += size
        else:
            more[v] = 0
    if used + extra > links.target.size:
        return -extra
    for v in range(more.size):
        if more[v] == 0:
            continue
        a = links.first[v]
        for h in range(links.degree[v]):
            links.target[used + h] = links.target[a + h]
            links.cost[used + h] = links.cost[a + h]
            links.want[used + h] = links.want[a + h]
        links.first[v] = used
        links.room[v] = more[v]
        used += more[v]
    for e in range(pairs.shape[0]):
        for side in range(2):
            v = pairs[e, side]
            h = links.first[v] + links.degree[v]
            links.target[h] = pairs[e, 1 - side]
            links.cost[h] = length[e]
            links.want[h] = wants[e]
            links.degree[v] += 1
    return used


@njit(cache=True)
def repack(old, new):
    """Copy all blocks one behind the other from `old` to `new`. Returns the rows then in use."""
    used = 0
    for v in range(old.first.size):
        new.first[v] = used
        new.degree[v] = old.degree[v]
        if old.degree[v] == 0:
            continue
        for h in range(old.degree[v]):
            new.target[used + h] = old.target[old.first[v] + h]
            new.cost[used + h] = old.cost[old.first[v] + h]
            new.want[used + h] = old.want[old.first[v] + h]
        size = 8
        while size < old.degree[v]:
            size *= 2
        new.room[v] = size
        used += size
    return used


@njit(cache=True)
def _cut_row(v, h, links):
    last = links.first[v] + links.degree[v] - 1
    links.target[h] = links.target[last]
    links.cost[h] = links.cost[last]
    links.want[h] = links.want[last]
    links.degree[v] -= 1


@njit(cache=True)
def _cut(v, w, links):
    """Take one half-edge v-w out."""
    for h in range(links.first[v], links.first[v] + links.degree[v]):
        if links.target[h] == w:
            _cut_row(v, h, links)
            return


@njit(cache=True)
def trail_under(x, y, vertices, n, links, tol):
    """The ends (k,) of the edges at vertices of the way driven, all but those to leaves, on which a place lies."""
    on = np.zeros(n, np.bool_)
    for u in range(n):
        if vertices.kind[u] != CORNER or vertices.shape.limit[u] != TRAIL:
            continue
        ux, uy = vertices.position[u]
        if abs(ux - x) > tol.anchor or abs(uy - y) > tol.anchor:
            continue
        for h in range(links.first[u], links.first[u] + links.degree[u]):
            v = links.target[h]
            vx, vy = vertices.position[v]
            if vertices.kind[v] != LEAF and point_segment_distance(x, y, ux, uy, vx, vy) < tol.crumb:
                on[u] = on[v] = True
    return np.flatnonzero(on)


@njit(cache=True)
def isolate(vertices, links):
    """Take all edges of the vertices out."""
    for v in vertices:
        for h in range(links.first[v], links.first[v] + links.degree[v]):
            _cut(links.target[h], v, links)
        links.degree[v] = 0


@njit(cache=True, inline="always")
def _hit(ax, ay, bx, by, length, want, walls, discs):
    """Whether a wall comes nearer to a-b than `want`; `discs` (m, 3) hold the inflated walls."""
    ux = (bx - ax) / length if length > 0.0 else 1.0
    uy = (by - ay) / length if length > 0.0 else 0.0
    for w in range(walls.shape[0]):
        cx = discs[w, 0] - ax
        cy = discs[w, 1] - ay
        if abs(ux * cy - uy * cx) > discs[w, 2]:
            continue
        if abs(ux * cx + uy * cy - 0.5 * length) > discs[w, 2] + 0.5 * length:
            continue
        if segment_distance(ax, ay, bx, by, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]) < want:
            return True
    return False


@njit(cache=True)
def sever(vertices, n_vertices, links, blocked, blocked_want, walls, tol):
    """Remove the corners and edges that new walls (m, 4) come too near to, and all edges of vertices that are gone.

    Returns the open edges (k, 2) that were cut, and which of the `blocked` ones (b, 2) are left.
    """
    position, shape, kind = vertices.position, vertices.shape, vertices.kind
    cut = np.empty((256, 2), np.int64)
    count = 0
    discs = np.empty((walls.shape[0], 3))
    x0 = y0 = math.inf
    x1 = y1 = -math.inf
    for w in range(walls.shape[0]):
        discs[w, 0] = 0.5 * (walls[w, 0] + walls[w, 2])
        discs[w, 1] = 0.5 * (walls[w, 1] + walls[w, 3])
        discs[w, 2] = 0.5 * norm(walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]) + tol.need
        x0 = min(x0, walls[w, 0] - tol.need, walls[w, 2] - tol.need)
        x1 = max(x1, walls[w, 0] + tol.need, walls[w, 2] + tol.need)
        y0 = min(y0, walls[w, 1] - tol.need, walls[w, 3] - tol.need)
        y1 = max(y1, walls[w, 1] + tol.need, walls[w, 3] + tol.need)
    for v in range(n_vertices):
        x = position[v, 0]
        y = position[v, 1]
        if (kind[v] == CORNER or kind[v] == BEND) and shape.limit[v] < TRAIL and x0 <= x <= x1 and y0 <= y <= y1:
            for w in range(walls.shape[0]):
                if point_segment_distance(x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]) < tol.sweep:
                    kind[v] = -1
                    break
        if kind[v] < 0 and links.degree[v] > 0:
            while cut.shape[0] < count + links.degree[v]:
                cut = np.concatenate((cut, np.empty_like(cut)))
            for h in range(links.first[v], links.first[v] + links.degree[v]):
                cut[count, 0] = v
                cut[count, 1] = links.target[h]
                count += 1
                _cut(links.target[h], v, links)
            links.degree[v] = 0
    keep = np.ones(blocked.shape[0], np.bool_)
    for e in range(blocked.shape[0]):
        u = blocked[e, 0]
        v = blocked[e, 1]
        if kind[u] < 0 or kind[v] < 0:
            keep[e] = False
            continue
        ax = position[u, 0]
        ay = position[u, 1]
        bx = position[v, 0]
        by = position[v, 1]
        if max(ax, bx) >= x0 and min(ax, bx) <= x1 and max(ay, by) >= y0 and min(ay, by) <= y1:
            want = blocked_want[e] - tol.still
            keep[e] = not _hit(ax, ay, bx, by, norm(bx - ax, by - ay), want, walls, discs)
    for u in range(n_vertices if walls.shape[0] > 0 else 0):
        ax = position[u, 0]
        ay = position[u, 1]
        far = tol.last_leg
        if links.degree[u] == 0 or ax < x0 - far or ax > x1 + far or ay < y0 - far or ay > y1 + far:
            continue
        h = links.first[u]
        while h < links.first[u] + links.degree[u]:
            v = links.target[h]
            bx = position[v, 0]
            by = position[v, 1]
            if (
                v > u
                and max(ax, bx) >= x0
                and min(ax, bx) <= x1
                and max(ay, by) >= y0
                and min(ay, by) <= y1
                and _hit(ax, ay, bx, by, links.cost[h], links.want[h] - tol.still, walls, discs)
            ):
                if count == cut.shape[0]:
                    cut = np.concatenate((cut, np.empty_like(cut)))
                cut[count, 0] = u
                cut[count, 1] = v
                count += 1
                _cut(v, u, links)
                _cut_row(u, h, links)
            else:
                h += 1
    return cut[:count].copy(), keep


@njit(cache=True)
def _open(u, v, position, kind, owner, pieces, slack):
    """Whether no open edge lies between two vertices, but near leaves and those that they may look through."""
    return crossing_free(
        position[u, 0], position[u, 1], position[v, 0], position[v, 1], pieces, owner[u], owner[v],
        slack if kind[u] == LEAF else 0.0, slack if kind[v] == LEAF else 0.0,
    )  # fmt: skip


@njit(cache=True)
def unblocked(blocked, vertices, box, pieces, slack):
    """Which of the blocked edges (b, 2) that meet `box` (x0, y0, x1, y1) no open edge crosses any more."""
    position, kind, owner = vertices.position, vertices.kind, vertices.owner
    free = np.zeros(blocked.shape[0], np.bool_)
    for e in range(blocked.shape[0]):
        u = blocked[e, 0]
        v = blocked[e, 1]
        if (
            max(position[u, 0], position[v, 0]) < box[0]
            or min(position[u, 0], position[v, 0]) > box[2]
            or max(position[u, 1], position[v, 1]) < box[1]
            or min(position[u, 1], position[v, 1]) > box[3]
        ):
            continue
        free[e] = _open(u, v, position, kind, owner, pieces, slack)
    return free


@njit(cache=True)
def _crosses_one(ax, ay, ux, uy, segments, n):
    """Whether the leg from a by u properly crosses one of n segments; that comes to the front."""
    for k in range(n):
        s1 = ux * (segments[k, 1] - ay) - uy * (segments[k, 0] - ax)
        s2 = ux * (segments[k, 3] - ay) - uy * (segments[k, 2] - ax)
        if s1 * s2 >= 0.0:
            continue
        vx = segments[k, 2] - segments[k, 0]
        vy = segments[k, 3] - segments[k, 1]
        t1 = vx * (ay - segments[k, 1]) - vy * (ax - segments[k, 0])
        t2 = t1 + vx * uy - vy * ux
        if t1 * t2 < 0.0:
            if k > 0:
                for j in range(4):
                    segments[k, j], segments[k - 1, j] = segments[k - 1, j], segments[k, j]
            return True
    return False


@njit(cache=True)
def connect(fresh, vertices, n_vertices, walls, pieces, tol):
    """New edges between the `fresh` vertices and all others: (e, 2) vertices, lengths, needs, and which are open."""
    position, kind, relaxed = vertices.position, vertices.kind, vertices.relaxed
    anchor, first, second, limit = vertices.shape
    segments = walls.segments
    capacity = 256
    pairs = np.empty((capacity, 2), np.int64)
    length = np.empty(capacity)
    wants = np.empty(capacity)
    count = 0
    rank = np.full(n_vertices, -1, np.int64)
    for i in range(fresh.size):
        rank[fresh[i]] = i
    # What blocked the last legs blocks most of the next: neighbours have neighbouring numbers.
    blocker = np.zeros((_BLOCKERS, 4))
    n_blockers = 0
    for i in range(fresh.size):
        u = fresh[i]
        if kind[u] < 0:
            continue
        ux = position[u, 0]
        uy = position[u, 1]
        for v in range(n_vertices):
            dx = position[v, 0] - ux
            dy = position[v, 1] - uy
            if abs(dx) > tol.last_leg or abs(dy) > tol.last_leg or kind[v] < 0 or rank[v] > i or v == u:
                continue
            d = norm(dx, dy)
            if d > (tol.last_leg if kind[u] == LEAF or kind[v] == LEAF else tol.leg):
                continue
            if d > tol.trail_edge and max(limit[u], limit[v]) >= TRAIL:
                continue
            d1 = d if d > 0.0 else 1.0
            if kind[u] != LEAF and not tangent(
                dx / d1, dy / d1, d, ux - anchor[u, 0], uy - anchor[u, 1], first[u, 0], first[u, 1], second[u, 0],
                second[u, 1], limit[u], tol.short_leg,
            ):  # fmt: skip
                continue
            if kind[v] != LEAF and not tangent(
                dx / d1, dy / d1, d, position[v, 0] - anchor[v, 0], position[v, 1] - anchor[v, 1], first[v, 0],
                first[v, 1], second[v, 0], second[v, 1], limit[v], tol.short_leg,
            ):  # fmt: skip
                continue
            if _crosses_one(ux, uy, dx, dy, blocker, n_blockers):
                continue
            want = min(tol.sweep, relaxed[u], relaxed[v])
            hit = first_hit(ux, uy, position[v, 0], position[v, 1], walls, want)
            if hit >= 0:
                n_blockers = min(n_blockers + 1, _BLOCKERS)
                for k in range(n_blockers - 1, 0, -1):
                    blocker[k] = blocker[k - 1]
                blocker[0] = segments[hit]
                continue
            if count == capacity:
                capacity *= 2
                pairs = np.concatenate((pairs, np.empty((count, 2), np.int64)))
                length = np.concatenate((length, np.empty(count)))
                wants = np.concatenate((wants, np.empty(count)))
            pairs[count, 0] = u
            pairs[count, 1] = v
            length[count] = d
            wants[count] = want
            count += 1
    free = np.empty(count, np.bool_)
    for e in range(count):
        free[e] = _open(pairs[e, 0], pairs[e, 1], position, kind, vertices.owner, pieces, tol.slack)
    return pairs[:count].copy(), length[:count].copy(), wants[:count].copy(), free


@njit(cache=True)
def components(links, kind, n_vertices):
    """Number (v,) of the connected part that each corner belongs to, paths through leaves aside; -1 for the others."""
    label = np.full(n_vertices, -1, np.int64)
    stack = np.empty(n_vertices, np.int64)
    parts = 0
    for root in range(n_vertices):
        if kind[root] != CORNER or label[root] >= 0:
            continue
        label[root] = parts
        stack[0] = root
        size = 1
        while size > 0:
            size -= 1
            v = stack[size]
            for h in range(links.first[v], links.first[v] + links.degree[v]):
                w = links.target[h]
                if kind[w] == CORNER and label[w] < 0:
                    label[w] = parts
                    stack[size] = w
                    size += 1
        parts += 1
    return label


@njit(cache=True)
def anchors(points, vertices, n_vertices, walls, pieces, tol):
    """A corner (k,) that the disc can go to straight from each of the points (k, 2) of a way, or -1."""
    position, kind = vertices.position, vertices.kind
    out = np.full(points.shape[0], -1, np.int64)
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        for k in range(n_vertices + 1):
            v = k - 1 if k > 0 else out[max(0, i - 1)]  # first that of the point before
            if v < 0 or kind[v] != CORNER:
                continue
            if abs(position[v, 0] - x) > tol.anchor or abs(position[v, 1] - y) > tol.anchor:
                continue
            if sweep_free(x, y, position[v, 0], position[v, 1], walls, tol.sweep) and crossing_free(
                x, y, position[v, 0], position[v, 1], pieces, -2, -2, 0.0, 0.0
            ):
                out[i] = v
                break
    return out
