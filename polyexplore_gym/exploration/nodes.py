"""Frontier nodes: where to stand for a jump edge, and how much of all jump edges is seen from there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.exploration.corners import REACH
from polyexplore_gym.exploration.segments import clearance, crossing_free, norm, sweep_free

_FRACTIONS = np.array([0.5, 0.35, 0.65, 0.2, 0.8, 0.08, 0.92])
_OFFSETS = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0])
_ASIDE = 0.15
"""Distance (m) from a jump edge of the point that must be visible."""
_SAME_PLACE = 0.4
"""A scan within this distance (m, in x and in y) was made at the same place."""
_SIGHT = 0.05
"""A line of sight may end within this distance (m) of its target's own walls."""


@njit(cache=True)
def sees(ax, ay, bx, by, walls, w_start, w_items, pieces, p_start, p_items, owner, own_a, own_b):
    """Whether b is in sight of a: no wall between them, and no unknown but the jump edges that own them."""
    none = np.full(walls.shape[0], -1, np.int64)
    return _sees(ax, ay, bx, by, walls, w_start, w_items, none, pieces, p_start, p_items, owner, own_a, own_b)


@njit(cache=True)
def _sees(ax, ay, bx, by, walls, w_start, w_items, no_owner, pieces, p_start, p_items, owner, own_a, own_b):
    if not crossing_free(ax, ay, bx, by, walls, w_start, w_items, no_owner, -2, -2, 0.0, _SIGHT):
        return False
    return crossing_free(ax, ay, bx, by, pieces, p_start, p_items, owner, own_a, own_b, _SIGHT, _SIGHT)


@njit(cache=True)
def point_along(rows, pieces, fraction):
    """Point at a fraction of the length of a chain of pieces (rows in order)."""
    total = 0.0
    for i in rows:
        total += norm(pieces[i, 2] - pieces[i, 0], pieces[i, 3] - pieces[i, 1])
    run = fraction * total
    for i in rows:
        size = norm(pieces[i, 2] - pieces[i, 0], pieces[i, 3] - pieces[i, 1])
        if run <= size and size > 0.0:
            f = run / size
            return pieces[i, 0] + f * (pieces[i, 2] - pieces[i, 0]), pieces[i, 1] + f * (pieces[i, 3] - pieces[i, 1])
        run -= size
    i = rows[-1]
    return pieces[i, 2], pieces[i, 3]


@njit(cache=True)
def stands(x, y, mx, my, chain, walls, w_start, w_items, pieces, p_start, p_items, owner, need):
    """Whether the disc may stand at (x, y) and the point (mx, my) of its jump edge is in sight."""
    if clearance(x, y, walls, w_start, w_items, REACH) < need:
        return False
    if norm(mx - x, my - y) < _SIGHT:
        return True
    return sees(x, y, mx, my, walls, w_start, w_items, pieces, p_start, p_items, owner, chain, chain)


@njit(cache=True)
def place(which, node, vertex, middle, normal, length, chain, front, spacing, walls, w_start, w_items, pieces,
          p_start, p_items, owner, need):  # fmt: skip
    """Nodes of the jump edges `which` at their configured place: (k, 3), and what came of each (k,).

    The place is at most `front` m before the middle of the jump edge on its known side, and no farther than
    `length` / `spacing` (the sampling condition). 0: the node that was there stays, or none can stand there; 1: the
    old one must go; 2: a new one.
    """
    out = np.zeros((which.size, 3))
    outcome = np.zeros(which.size, np.int8)
    no_owner = np.full(walls.shape[0], -1, np.int64)
    for k in range(which.size):
        i = which[k]
        if vertex[i] >= 0:
            x = node[i, 0]
            y = node[i, 1]
            # Walls that came later may stand too near, or between the node and its jump edge.
            if clearance(x, y, walls, w_start, w_items, REACH) >= need - 0.02 and (
                norm(middle[i, 0] - x, middle[i, 1] - y) < 2.0 * _ASIDE
                or crossing_free(
                    x, y, middle[i, 0] - _ASIDE * normal[i, 0], middle[i, 1] - _ASIDE * normal[i, 1], walls, w_start,
                    w_items, no_owner, -2, -2, 0.0, _SIGHT,
                )
            ):  # fmt: skip
                continue
            outcome[k] = 1
        d = min(front, length[i] / spacing)
        x = middle[i, 0] - d * normal[i, 0]
        y = middle[i, 1] - d * normal[i, 1]
        if stands(
            x, y, middle[i, 0], middle[i, 1], chain[i], walls, w_start, w_items, pieces, p_start, p_items, owner, need
        ):
            outcome[k] = 2
            out[k, 0] = x
            out[k, 1] = y
            out[k, 2] = math.atan2(normal[i, 1], normal[i, 0])
    return out, outcome


@njit(cache=True)
def _joins(x, y, chain, position, kind, seen, walls, w_start, w_items, pieces, p_start, p_items, owner, need, slack):
    """Whether the disc can go straight from (x, y) to a vertex in `seen`."""
    for v in range(seen.size):
        if not seen[v] or kind[v] < 0:
            continue
        vx = position[v, 0]
        vy = position[v, 1]
        if abs(vx - x) > 8.0 or abs(vy - y) > 8.0:
            continue
        if crossing_free(x, y, vx, vy, pieces, p_start, p_items, owner, chain, chain, slack, slack) and sweep_free(
            x, y, vx, vy, walls, w_start, w_items, need
        ):
            return True
    return False


@njit(cache=True)
def looked_from(x, y, tx, ty, known):
    """Whether a scan from (x, y) or beside it had (tx, ty) in its field of view: another would show no more."""
    for s in range(known.headings.size):
        dx = known.apexes[s, 0] - x
        dy = known.apexes[s, 1] - y
        if abs(dx) < _SAME_PLACE and abs(dy) < _SAME_PLACE:
            turn = math.atan2(ty - y, tx - x) - known.headings[s]
            turn = math.pi - (math.pi - turn) % (2.0 * math.pi)
            if known.full or known.angles[0] + 0.1 < turn < known.angles[-1] - 0.1:
                return True
    return False


@njit(cache=True)
def nearest_reachable(rows, mx, my, nx, ny, chain, position, kind, seen, known, walls, w_start, w_items, pieces,
                      p_start, p_items, owner, need, slack, through_unknown):  # fmt: skip
    """The reachable place nearest to a jump edge from which it is visible: (x, y, heading, found).

    Tries places before the edge on its known side, then the vertices of the graph in `seen`; with
    `through_unknown` also those between which and the edge there are no known walls but other jump
    edges. The heading looks at the edge. Places from which a scan has looked at it are left out.
    """
    no_owner = np.full(walls.shape[0], -1, np.int64)
    for offset in _OFFSETS:
        if through_unknown:
            break  # places before the edge were tried, and no path led there
        for fraction in _FRACTIONS:
            px, py = point_along(rows, pieces, fraction)
            x = px - offset * nx
            y = py - offset * ny
            if looked_from(x, y, px, py, known):
                continue
            if stands(
                x, y, px, py, chain, walls, w_start, w_items, pieces, p_start, p_items, owner, need
            ) and _joins(
                x, y, chain, position, kind, seen, walls, w_start, w_items, pieces, p_start, p_items, owner, need,
                slack,
            ):  # fmt: skip
                return x, y, math.atan2(ny, nx), True
    # A jump edge begins at the corner that hides what is behind it: aim beside it, on its known side.
    tx = mx - _ASIDE * nx
    ty = my - _ASIDE * ny
    best = 0.8 * known.reach
    bx = 0.0
    by = 0.0
    found = False
    for v in range(seen.size):
        if not seen[v] or kind[v] < 0:
            continue
        d = norm(mx - position[v, 0], my - position[v, 1])
        if d >= best:
            continue
        if through_unknown:
            visible = crossing_free(
                position[v, 0], position[v, 1], tx, ty, walls, w_start, w_items, no_owner, -2, -2, 0.0, _SIGHT
            )
        else:
            # Only from the known side is the edge a window into the unknown.
            visible = (mx - position[v, 0]) * nx + (my - position[v, 1]) * ny > 0.1 * d and sees(
                position[v, 0], position[v, 1], tx, ty, walls, w_start, w_items, pieces, p_start, p_items, owner,
                chain, chain,
            )  # fmt: skip
        if visible and not looked_from(position[v, 0], position[v, 1], tx, ty, known):
            best = d
            bx = position[v, 0]
            by = position[v, 1]
            found = True
    return bx, by, math.atan2(my - by, mx - bx), found


@njit(cache=True)
def gains(which, node, vertex, middle, ends, chain, max_range, walls, w_start, w_items, pieces, p_start,
          p_items, owner, out):  # fmt: skip
    """g_n (Ekman): the sum of the angles that the jump edges subtend at node n where visible; pi for its own.

    Fills `out` for the chains in `which`; jump edges farther than `max_range` are not seen.
    """
    no_owner = np.full(walls.shape[0], -1, np.int64)
    for n in which:
        total = math.pi
        x = node[n, 0]
        y = node[n, 1]
        if vertex[n] < 0:
            out[n] = 0.0
            continue
        for i in range(middle.shape[0]):
            if i == n:
                continue
            if norm(middle[i, 0] - x, middle[i, 1] - y) > max_range:
                continue
            if not _sees(
                x, y, middle[i, 0], middle[i, 1], walls, w_start, w_items, no_owner, pieces, p_start, p_items, owner,
                chain[n], chain[i],
            ):  # fmt: skip
                continue
            ax = ends[i, 0] - x
            ay = ends[i, 1] - y
            bx = ends[i, 2] - x
            by = ends[i, 3] - y
            total += abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))
        out[n] = total
