"""Frontier nodes: where to stand for a jump edge, and how much of all jump edges is seen from there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.exploration.segments import clearance, crossing_free, norm, sweep_free

_FRACTIONS = np.array([0.5, 0.35, 0.65, 0.2, 0.8, 0.08, 0.92])
_OFFSETS = np.array([0.0, 0.4, 0.8, 1.2, 1.8, 2.4, 3.2, 4.0, 5.2, 6.4, 8.0])
"""Where else to stand for a jump edge: shares of its length, and radii before it."""
_PARTS = 16
"""Parts of a jump edge of which each is visible or not."""
_MARGIN = 0.1
"""A scan must have had a place this far (rad) inside its field of view to have looked there."""


@njit(cache=True)
def sees(ax, ay, bx, by, walls, pieces, own_a, own_b, tol):
    """Whether b is in sight of a: no wall between them, and no unknown but the jump edges that own them."""
    return crossing_free(ax, ay, bx, by, walls, -2, -2, 0.0, tol.sight) and crossing_free(
        ax, ay, bx, by, pieces, own_a, own_b, tol.sight, tol.sight
    )


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
def stands(x, y, mx, my, chain, walls, pieces, room, tol):
    """Whether the disc may stand at (x, y), with clearance `room`, and the point (mx, my) of its jump edge is in
    sight."""
    if clearance(x, y, walls, tol.reach) < room:
        return False
    if norm(mx - x, my - y) < tol.sight:
        return True
    return sees(x, y, mx, my, walls, pieces, chain, chain, tol)


@njit(cache=True)
def place(which, edges, front, walls, pieces, tol):
    """Nodes of the jump edges `which` at their configured place: (k, 3), and what came of each (k,).

    The place is at most `front` m before the middle of the jump edge on its known side, and no farther than the
    sampling condition allows. 0: the node that was there stays, or none can stand there; 1: the old one must go; 2: a
    new one.
    """
    out = np.zeros((which.size, 3))
    outcome = np.zeros(which.size, np.int8)
    for k in range(which.size):
        i = which[k]
        mx, my = edges.middle[i]
        nx, ny = edges.normal[i]
        if edges.vertex[i] >= 0:
            x = edges.node[i, 0]
            y = edges.node[i, 1]
            # Walls that came later may stand too near, or between the node and its jump edge.
            if clearance(x, y, walls, tol.reach) >= tol.sweep and (
                norm(mx - x, my - y) < 2.0 * tol.aside
                or crossing_free(x, y, mx - tol.aside * nx, my - tol.aside * ny, walls, -2, -2, 0.0, tol.sight)
            ):
                continue
            outcome[k] = 1
        d = min(front, edges.length[i] / (tol.samples * tol.step))
        x = mx - d * nx
        y = my - d * ny
        if stands(x, y, mx, my, edges.id[i], walls, pieces, tol.stand, tol):
            outcome[k] = 2
            out[k, 0] = x
            out[k, 1] = y
            out[k, 2] = math.atan2(ny, nx)
    return out, outcome


@njit(cache=True)
def _joins(x, y, chain, vertices, seen, walls, pieces, tol):
    """Whether the disc can go straight from (x, y) to a vertex in `seen`; to far ones if there is none near."""
    near = tol.way_point
    some = False
    for v in range(2 * seen.size):
        far = v >= seen.size
        if far and some:
            break
        v = v % seen.size
        if not seen[v] or vertices.kind[v] < 0:
            continue
        vx, vy = vertices.position[v]
        if (abs(vx - x) > near or abs(vy - y) > near) != far:
            continue
        some = True
        if crossing_free(x, y, vx, vy, pieces, chain, chain, tol.slack, tol.slack) and sweep_free(
            x, y, vx, vy, walls, tol.sweep
        ):
            return True
    return False


@njit(cache=True)
def looked_from(x, y, tx, ty, looks, half_view, tol):
    """Whether a look (k, 3) from (x, y) or beside it had (tx, ty) in its field of view: another would show no more."""
    for s in range(looks.shape[0]):
        dx = looks[s, 0] - x
        dy = looks[s, 1] - y
        if abs(dx) < tol.same_place and abs(dy) < tol.same_place:
            turn = math.atan2(ty - y, tx - x) - looks[s, 2]
            turn = math.pi - (math.pi - turn) % (2.0 * math.pi)
            if half_view >= math.pi or abs(turn) < half_view - _MARGIN:
                return True
    return False


@njit(cache=True)
def nearest_reachable(rows, i, edges, vertices, seen, looks, half_view, walls, pieces, tol, through_unknown):
    """The reachable place nearest to jump edge i from which it is visible: (x, y, heading, found).

    `rows` are its pieces. Tries places before the edge on its known side, then the vertices of the graph in `seen`;
    with `through_unknown` also those between which and the edge there are no known walls but other jump
    edges. The heading looks at the edge. Places from which a scan has looked at it are left out.
    """
    chain = edges.id[i]
    mx, my = edges.middle[i]
    nx, ny = edges.normal[i]
    for offset in _OFFSETS:
        if through_unknown or offset * tol.radius > tol.max_range - tol.gap:
            break  # places before the edge were tried, and no path led there
        for fraction in _FRACTIONS:
            px, py = point_along(rows, pieces.segments, fraction)
            x = px - offset * tol.radius * nx
            y = py - offset * tol.radius * ny
            if looked_from(x, y, px + tol.aside * nx, py + tol.aside * ny, looks, half_view, tol):
                continue
            if stands(x, y, px, py, chain, walls, pieces, tol.need, tol) and _joins(
                x, y, chain, vertices, seen, walls, pieces, tol
            ):
                return x, y, math.atan2(ny, nx), True
    # A jump edge begins at the corner that hides what is behind it: aim beside it, on its known side.
    tx = mx - tol.aside * nx
    ty = my - tol.aside * ny
    best = tol.max_range - tol.gap
    bx = 0.0
    by = 0.0
    found = False
    for v in range(seen.size):
        if not seen[v] or vertices.kind[v] < 0:
            continue
        vx, vy = vertices.position[v]
        d = norm(mx - vx, my - vy)
        if d >= best:
            continue
        if through_unknown:
            visible = crossing_free(vx, vy, tx, ty, walls, -2, -2, 0.0, tol.sight)
        else:
            # Only from the known side is the edge a window into the unknown.
            ahead = (mx - vx) * nx + (my - vy) * ny
            visible = (ahead > 0.1 * d or d < tol.on_edge) and sees(vx, vy, tx, ty, walls, pieces, chain, chain, tol)
        if visible and not looked_from(vx, vy, mx + tol.aside * nx, my + tol.aside * ny, looks, half_view, tol):
            best = d
            bx = vx
            by = vy
            found = True
    return bx, by, math.atan2(my + tol.aside * ny - by, mx + tol.aside * nx - bx), found


@njit(cache=True)
def _seen_angle(x, y, n, i, edges, walls, pieces, tol):
    """The angle (rad) that the visible parts of jump edge i subtend at node n, of `_PARTS` parts of its chord."""
    ax, ay, bx, by = edges.ends[i]
    total = 0.0
    for part in range(_PARTS):
        f0 = part / _PARTS
        f1 = (part + 1) / _PARTS
        ux = ax + f0 * (bx - ax) - x
        uy = ay + f0 * (by - ay) - y
        vx = ax + f1 * (bx - ax) - x
        vy = ay + f1 * (by - ay) - y
        mx = x + 0.5 * (ux + vx)
        my = y + 0.5 * (uy + vy)
        if norm(mx - x, my - y) <= tol.max_range and sees(x, y, mx, my, walls, pieces, edges.id[n], edges.id[i], tol):
            total += abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy))
    return total


@njit(cache=True)
def gains(which, edges, walls, pieces, visible, tol, out):
    """g_n (Ekman): the sum of the angles alpha_ni that the jump edges i subtend at node n; pi for its own.

    alpha_ni is the angle at n of the triangle that n makes with the two ends of edge i (Iles et al.): the whole of it
    if the middle of the edge is visible from n and within range, else nothing. With `visible` it is the angle of those
    parts of the edge that are visible. Fills `out` for the chains in `which`.
    """
    for n in which:
        total = math.pi
        x = edges.node[n, 0]
        y = edges.node[n, 1]
        if edges.vertex[n] < 0:
            out[n] = 0.0
            continue
        for i in range(edges.id.size):
            if i == n:
                continue
            if visible:
                total += _seen_angle(x, y, n, i, edges, walls, pieces, tol)
                continue
            mx, my = edges.middle[i]
            if norm(mx - x, my - y) > tol.max_range:
                continue
            if not sees(x, y, mx, my, walls, pieces, edges.id[n], edges.id[i], tol):
                continue
            ax = edges.ends[i, 0] - x
            ay = edges.ends[i, 1] - y
            bx = edges.ends[i, 2] - x
            by = edges.ends[i, 3] - y
            total += abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))
        out[n] = total
