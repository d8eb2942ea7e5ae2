"""Jump edges: the open boundary of everything seen, kept incrementally as directed pieces and chains.

A piece is a short segment with the unknown on its right. Touching pieces form a chain; a chain that
is long enough to matter is a jump edge.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.exploration.scan_polygon import contains, inside_intervals, subtract
from polyexplore_gym.exploration.segments import point_segment_distance

_MAX_INTERVALS = 64
_PARALLEL = 0.5
"""Sine of the largest angle between a wall and an open edge that it covers."""
_MAX_TURN = 1.3
"""A chain that turns farther (rad) than this from its beginning is cut: its parts face different ways."""


@njit(cache=True)
def _covered(ax, ay, bx, by, wall, margin):
    """Interval of a-b within `margin` of a wall that runs along it; empty as (1, 0)."""
    wx = wall[2] - wall[0]
    wy = wall[3] - wall[1]
    length = math.hypot(wx, wy)
    dx = bx - ax
    dy = by - ay
    size = math.hypot(dx, dy)
    if length <= 0.0 or size <= 0.0:
        return 1.0, 0.0
    wx /= length
    wy /= length
    if abs(wx * dy - wy * dx) > _PARALLEL * size:
        return 1.0, 0.0
    lo = 0.0
    hi = 1.0
    for axis in range(2):
        if axis == 0:
            f0 = (ax - wall[0]) * wx + (ay - wall[1]) * wy
            f1 = dx * wx + dy * wy
            low = -margin
            high = length + margin
        else:
            f0 = wx * (ay - wall[1]) - wy * (ax - wall[0])
            f1 = wx * dy - wy * dx
            low = -margin
            high = margin
        if f1 == 0.0:
            if f0 < low or f0 > high:
                return 1.0, 0.0
        else:
            t0 = (low - f0) / f1
            t1 = (high - f0) / f1
            lo = max(lo, min(t0, t1))
            hi = min(hi, max(t0, t1))
    return lo, hi


@njit(cache=True)
def _take_off(ax, ay, bx, by, walls, margin, same_way, kept, n_kept, cut):
    """Take off the intervals `kept` of a-b what walls along it cover; `same_way`: only those that run as a-b does."""
    x0 = min(ax, bx) - margin
    x1 = max(ax, bx) + margin
    y0 = min(ay, by) - margin
    y1 = max(ay, by) + margin
    for w in range(walls.shape[0]):
        if (
            max(walls[w, 0], walls[w, 2]) < x0
            or min(walls[w, 0], walls[w, 2]) > x1
            or max(walls[w, 1], walls[w, 3]) < y0
            or min(walls[w, 1], walls[w, 3]) > y1
            or (same_way and (walls[w, 2] - walls[w, 0]) * (bx - ax) + (walls[w, 3] - walls[w, 1]) * (by - ay) <= 0.0)
        ):
            continue
        lo, hi = _covered(ax, ay, bx, by, walls[w], margin)
        if hi > lo:
            cut[0, 0] = lo
            cut[0, 1] = hi
            n_kept = subtract(kept, n_kept, cut, 1)
            if n_kept == 0:
                break
    return n_kept


@njit(cache=True)
def clip(pieces, apexes, headings, points, rays, first, last, angles, full, reach, nudge, walls, margin, shortest):
    """Clip pieces (m, 4) by scan polygons `first` to `last` and by walls along them.

    A piece is resolved where the point `nudge` metres on its unknown side lies in a scan polygon: so
    two coincident edges that face the same way never delete each other. Returns the remaining
    pieces, the index of the piece each comes from, and which pieces changed.
    """
    m = pieces.shape[0]
    near = np.empty(max(last - first, 1), np.int64)
    n_near = 0
    if m > 0:
        x0 = min(pieces[:, 0].min(), pieces[:, 2].min()) - reach
        x1 = max(pieces[:, 0].max(), pieces[:, 2].max()) + reach
        y0 = min(pieces[:, 1].min(), pieces[:, 3].min()) - reach
        y1 = max(pieces[:, 1].max(), pieces[:, 3].max()) + reach
        for s in range(first, last):
            if x0 <= apexes[s, 0] <= x1 and y0 <= apexes[s, 1] <= y1:
                near[n_near] = s
                n_near += 1
    out = np.empty((2 * m + 64, 4))
    origin = np.empty(out.shape[0], np.int64)
    changed = np.zeros(m, np.bool_)
    kept = np.empty((_MAX_INTERVALS, 2))
    cut = np.empty((_MAX_INTERVALS, 2))
    count = 0
    for i in range(m):
        ax, ay, bx, by = pieces[i, 0], pieces[i, 1], pieces[i, 2], pieces[i, 3]
        size = math.hypot(bx - ax, by - ay)
        kept[0, 0] = 0.0
        kept[0, 1] = 1.0
        n_kept = 1
        if size <= 0.0:
            changed[i] = True
            continue
        ox = nudge * (by - ay) / size
        oy = -nudge * (bx - ax) / size
        for q in range(n_near):
            s = near[q]
            px = apexes[s, 0]
            py = apexes[s, 1]
            if point_segment_distance(px, py, ax, ay, bx, by) > reach:
                continue
            n_cut = inside_intervals(
                ax + ox - px, ay + oy - py, bx + ox - px, by + oy - py,
                points[s], rays[s], angles, headings[s], full, cut,
            )  # fmt: skip
            n_kept = subtract(kept, n_kept, cut, n_cut)
            if n_kept == 0:
                break
        if n_kept > 0:
            n_kept = _take_off(ax, ay, bx, by, walls, margin, False, kept, n_kept, cut)
        if n_kept != 1 or kept[0, 0] > 1e-9 or kept[0, 1] < 1.0 - 1e-9:
            changed[i] = True
        for r in range(n_kept):
            if (kept[r, 1] - kept[r, 0]) * size < shortest and changed[i]:
                continue
            if count == out.shape[0]:
                bigger = np.empty((2 * count, 4))
                bigger[:count] = out
                out = bigger
                longer = np.empty(2 * count, np.int64)
                longer[:count] = origin
                origin = longer
            out[count, 0] = ax + kept[r, 0] * (bx - ax)
            out[count, 1] = ay + kept[r, 0] * (by - ay)
            out[count, 2] = ax + kept[r, 1] * (bx - ax)
            out[count, 3] = ay + kept[r, 1] * (by - ay)
            origin[count] = i
            count += 1
    return out[:count].copy(), origin[:count].copy(), changed


@njit(cache=True)
def clip_known(pieces, known, margin, shortest):
    """What is left of pieces (m, 4) beside `known` ones (k, 4) that run along them and face the same way.

    The same discontinuity seen again is the same jump edge. Returns the rest and where each came from.
    """
    m = pieces.shape[0]
    out = np.empty((2 * m + 64, 4))
    origin = np.empty(out.shape[0], np.int64)
    kept = np.empty((_MAX_INTERVALS, 2))
    cut = np.empty((1, 2))
    count = 0
    for i in range(m):
        ax, ay, bx, by = pieces[i, 0], pieces[i, 1], pieces[i, 2], pieces[i, 3]
        size = math.hypot(bx - ax, by - ay)
        kept[0, 0] = 0.0
        kept[0, 1] = 1.0
        n_kept = _take_off(ax, ay, bx, by, known, margin, True, kept, 1, cut)
        for r in range(n_kept):
            whole = kept[r, 1] - kept[r, 0] == 1.0
            if (whole or (kept[r, 1] - kept[r, 0]) * size >= shortest) and count < out.shape[0]:
                out[count, 0] = ax + kept[r, 0] * (bx - ax)
                out[count, 1] = ay + kept[r, 0] * (by - ay)
                out[count, 2] = ax + kept[r, 1] * (bx - ax)
                out[count, 3] = ay + kept[r, 1] * (by - ay)
                origin[count] = i
                count += 1
    return out[:count].copy(), origin[:count].copy()


@njit(cache=True)
def _wake_touching(pieces, owner, stale, tolerance):
    """Make stale every whole chain with an end near an end of a stale piece that it could join."""
    n = pieces.shape[0]
    woken = True
    while woken:
        woken = False
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for i in range(n):
            if stale[i]:
                x0 = min(x0, pieces[i, 0], pieces[i, 2])
                x1 = max(x1, pieces[i, 0], pieces[i, 2])
                y0 = min(y0, pieces[i, 1], pieces[i, 3])
                y1 = max(y1, pieces[i, 1], pieces[i, 3])
        for i in range(n):
            if (
                stale[i]
                or owner[i] < 0
                or min(pieces[i, 0], pieces[i, 2]) > x1 + tolerance
                or max(pieces[i, 0], pieces[i, 2]) < x0 - tolerance
                or min(pieces[i, 1], pieces[i, 3]) > y1 + tolerance
                or max(pieces[i, 1], pieces[i, 3]) < y0 - tolerance
            ):
                continue
            for j in range(n):
                if not stale[j]:
                    continue
                if (
                    abs(pieces[i, 0] - pieces[j, 2]) <= tolerance and abs(pieces[i, 1] - pieces[j, 3]) <= tolerance
                ) or (abs(pieces[i, 2] - pieces[j, 0]) <= tolerance and abs(pieces[i, 3] - pieces[j, 1]) <= tolerance):
                    chain = owner[i]
                    for q in range(n):
                        if owner[q] == chain:
                            stale[q] = True
                    woken = True
                    break


@njit(cache=True)
def rechain(pieces, kinds, visits, done, owner, dirty, local, kept, origin, fresh, fresh_kinds, seen_from, max_visits,
            tolerance, shortest, longest, next_id):  # fmt: skip
    """Replace the `local` pieces by what is left of them, add the `fresh` ones, chain what changed anew.

    `dirty` (m,) marks pieces that changed, `kept` (k, 4) is left of `local` by `origin`; `seen_from`
    (k,) marks those of `kept` that the scan looked at without finding more: they are done.
    Returns the new pieces, kinds, visits, done and owner arrays (the pieces of a chain together and
    in order), and the new chains: ids, summary (see `summarise`), ends, kinds, visits.
    """
    m = pieces.shape[0]
    away = np.ones(m, np.bool_)
    for i in local:
        away[i] = False
    n_rest = int(away.sum())
    n = n_rest + kept.shape[0] + fresh.shape[0]
    p = np.empty((n, 4))
    kind = np.empty(n, np.int8)
    visit = np.zeros(n, np.int64)
    finished = np.zeros(n, np.bool_)
    own = np.full(n, -1, np.int64)
    stale = np.ones(n, np.bool_)
    lost = np.zeros(next_id + 1, np.bool_)
    for i in range(m):
        if dirty[i] and owner[i] >= 0:
            lost[owner[i]] = True
    at = 0
    k = 0
    for i in range(m):  # in the old order: the pieces of a chain stay in theirs
        if away[i]:
            p[at], kind[at], visit[at], finished[at], own[at], stale[at] = (
                pieces[i], kinds[i], visits[i], done[i], owner[i], dirty[i],
            )  # fmt: skip
            at += 1
        while k < kept.shape[0] and local[origin[k]] == i:
            p[at], kind[at], visit[at], finished[at], own[at], stale[at] = (
                kept[k], kinds[i], visits[i], done[i] or seen_from[k], owner[i], dirty[i],
            )  # fmt: skip
            at += 1
            k += 1
    for k in range(fresh.shape[0]):
        p[at] = fresh[k]
        kind[at] = fresh_kinds[k]
        at += 1
    for i in range(n):
        finished[i] |= visit[i] >= max_visits
        if own[i] >= 0 and lost[own[i]]:
            stale[i] = True
        if finished[i]:
            own[i] = -1
            stale[i] = False
    _wake_touching(p, own, stale, tolerance)
    rows = np.flatnonzero(stale)
    order, offsets = link(p[rows], tolerance, shortest, longest)
    data, ends, chain_kind, chain_visits = summarise(p[rows], kind[rows], visit[rows], order, offsets)
    ids = np.arange(next_id, next_id + chain_kind.size)
    for q in range(ids.size):
        for e in range(offsets[q], offsets[q + 1]):
            own[rows[order[e]]] = ids[q]
    arranged = np.concatenate((np.flatnonzero(~stale), rows[order]))
    return (
        p[arranged], kind[arranged], visit[arranged], finished[arranged], own[arranged], ids, data, ends, chain_kind,
        chain_visits,
    )  # fmt: skip


@njit(cache=True)
def unchanged(data, ends, gone, old_middle, old_ends):
    """For each new chain (see `summarise`) the row in `gone` of one that was the very same, or -1."""
    out = np.full(data.shape[0], -1, np.int64)
    for q in range(data.shape[0]):
        for row in gone:
            off = abs(data[q, 1] - old_middle[row, 0]) + abs(data[q, 2] - old_middle[row, 1])
            for k in range(4):
                off += abs(ends[q, k] - old_ends[row, k])
            if off < 1e-6:
                out[q] = row
                break
    return out


@njit(cache=True)
def looked_at(pieces, apex, heading, points, angles, full, nudge):
    """Whether the known side of each piece (m, 4) lies in a scan polygon: the scan saw the edge from there."""
    out = np.zeros(pieces.shape[0], np.bool_)
    for i in range(pieces.shape[0]):
        dx = pieces[i, 2] - pieces[i, 0]
        dy = pieces[i, 3] - pieces[i, 1]
        size = max(math.hypot(dx, dy), 1e-9)
        x = 0.5 * (pieces[i, 0] + pieces[i, 2]) - nudge * dy / size - apex[0]
        y = 0.5 * (pieces[i, 1] + pieces[i, 3]) + nudge * dx / size - apex[1]
        out[i] = contains(x, y, points, angles, heading, full)
    return out


@njit(cache=True)
def _successors(pieces, tolerance):
    """Index of the piece that begins where each piece ends (mutually nearest), or -1."""
    n = pieces.shape[0]
    after = np.full(n, -1, np.int64)
    before = np.full(n, -1, np.int64)
    best_after = np.full(n, tolerance)
    best_before = np.full(n, tolerance)
    for i in range(n):
        for j in range(n):
            if i == j:
                continue
            d = math.hypot(pieces[j, 0] - pieces[i, 2], pieces[j, 1] - pieces[i, 3])
            if d < best_after[i]:
                best_after[i] = d
                after[i] = j
            if d < best_before[j]:
                best_before[j] = d
                before[j] = i
    for i in range(n):
        if after[i] >= 0 and before[after[i]] != i:
            after[i] = -1
    return after


@njit(cache=True)
def link(pieces, tolerance, shortest, longest):
    """Chain touching pieces (m, 4): order (m,) of the pieces, and the offsets (c + 1,) of the chains in it.

    A chain is cut where it turns, and where it grows beyond `longest`, but never so that a part
    becomes shorter than `shortest`.
    """
    n = pieces.shape[0]
    after = _successors(pieces, tolerance)
    has_before = np.zeros(n, np.bool_)
    for i in range(n):
        if after[i] >= 0:
            has_before[after[i]] = True
    size = np.empty(n)
    for i in range(n):
        size[i] = math.hypot(pieces[i, 2] - pieces[i, 0], pieces[i, 3] - pieces[i, 1])
    order = np.empty(n, np.int64)
    offsets = np.empty(n + 1, np.int64)
    used = np.zeros(n, np.bool_)
    count = 0
    chains = 0
    for pass_ in range(2):
        for s in range(n):
            if used[s] or (pass_ == 0 and has_before[s]):
                continue
            begin = count
            total = 0.0
            i = s
            while i >= 0 and not used[i]:
                used[i] = True
                order[count] = i
                count += 1
                total += size[i]
                i = after[i]
            offsets[chains] = begin
            chains += 1
            parts = max(math.ceil(total / longest), 1)
            aim = total / parts
            run = 0.0
            left = total
            first = order[begin]
            for e in range(begin, count):
                i = order[e]
                if e > offsets[chains - 1] and run >= shortest and left >= shortest:
                    ux = pieces[first, 2] - pieces[first, 0]
                    uy = pieces[first, 3] - pieces[first, 1]
                    vx = pieces[i, 2] - pieces[i, 0]
                    vy = pieces[i, 3] - pieces[i, 1]
                    turn = abs(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy))
                    if turn > _MAX_TURN or run + 0.5 * size[i] > aim:
                        offsets[chains] = e
                        chains += 1
                        run = 0.0
                        first = i
                run += size[i]
                left -= size[i]
    offsets[chains] = n
    return order, offsets[: chains + 1].copy()


@njit(cache=True)
def summarise(pieces, kinds, visits, order, offsets):
    """Per chain: (c, 5) length, middle x y, normal x y into the unknown; (c, 4) its ends; kind; visits."""
    c = offsets.size - 1
    data = np.empty((c, 5))
    ends = np.empty((c, 4))
    kind = np.empty(c, np.int8)
    visit = np.empty(c, np.int64)
    for q in range(c):
        total = 0.0
        per_kind = np.zeros(4)
        visit[q] = 0
        for e in range(offsets[q], offsets[q + 1]):
            i = order[e]
            size = math.hypot(pieces[i, 2] - pieces[i, 0], pieces[i, 3] - pieces[i, 1])
            total += size
            per_kind[kinds[i]] += size
            visit[q] = max(visit[q], visits[i])
        kind[q] = np.argmax(per_kind)
        first = order[offsets[q]]
        last = order[offsets[q + 1] - 1]
        ends[q, 0] = pieces[first, 0]
        ends[q, 1] = pieces[first, 1]
        ends[q, 2] = pieces[last, 2]
        ends[q, 3] = pieces[last, 3]
        run = 0.0
        mx = ends[q, 0]
        my = ends[q, 1]
        px = 0.0
        py = 0.0
        for e in range(offsets[q], offsets[q + 1]):
            i = order[e]
            size = math.hypot(pieces[i, 2] - pieces[i, 0], pieces[i, 3] - pieces[i, 1])
            if run + size >= 0.5 * total and size > 0.0:
                f = (0.5 * total - run) / size
                mx = pieces[i, 0] + f * (pieces[i, 2] - pieces[i, 0])
                my = pieces[i, 1] + f * (pieces[i, 3] - pieces[i, 1])
                px = pieces[i, 2] - pieces[i, 0]
                py = pieces[i, 3] - pieces[i, 1]
                break
            run += size
        cx = ends[q, 2] - ends[q, 0]
        cy = ends[q, 3] - ends[q, 1]
        chord = math.hypot(cx, cy)
        if chord < 0.3 * total:
            cx = px
            cy = py
            chord = math.hypot(cx, cy)
        chord = max(chord, 1e-12)
        data[q, 0] = total
        data[q, 1] = mx
        data[q, 2] = my
        data[q, 3] = cy / chord
        data[q, 4] = -cx / chord
    return data, ends, kind, visit
