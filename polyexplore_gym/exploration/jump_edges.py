"""Jump edges: the open boundary of everything seen, kept incrementally as directed pieces and chains.

A piece is a short segment with the unknown on its right. Touching pieces form a chain; a chain that
is wide enough to matter is a jump edge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.scan_polygon import contains, inside_intervals, label_edges, open_edges, subtract
from polyexplore_gym.exploration.segments import crossing, near_point, point_segment_distance
from polyexplore_gym.exploration.tolerances import end_noise, noise_at

_PARALLEL = 0.5
"""Sine of the largest angle between a wall and an open edge that it covers."""
_MAX_TURN = 1.3
"""A chain that turns farther (rad) than this from its beginning is cut: its parts face different ways."""
_ALIKE = 0.27
"""Cosine of the largest angle (that of `_MAX_TURN`) between the directions in which parts of one opening face."""
_SQUARE = 0.26
"""Cosine of the largest incidence (75 degrees) under which a look shows what is behind an open edge."""
_GAPPY = 2.5
"""An opening is at most so many times as wide as what is left of its edges: crumbs far apart are none."""
_LOOKS = 2
"""Fewest beams across a gap of interest with which a look shows what is behind it (Ekman's sampling condition)."""


class Pieces(NamedTuple):
    """Open edges, one row each."""

    segments: np.ndarray
    """(m, 4) ends, m; the unknown lies on the right"""
    kind: np.ndarray
    """(m,) `scan_polygon` label"""
    sigma: np.ndarray
    """(m,) noise of where it lies, m"""
    visits: np.ndarray
    """(m,) halves: measurements made for it in vain count two, attempts that ended before its node one"""
    settled: np.ndarray
    """(m,) a scan that could have shown what is behind it showed nothing"""
    retried: np.ndarray
    """(m,) it was given up, and got one more visit before the end"""
    owner: np.ndarray
    """(m,) id of the chain, -1 for none"""

    @classmethod
    def none(cls) -> Pieces:
        """No open edges."""
        i = np.zeros(0, np.int64)
        return cls(np.zeros((0, 4)), i.astype(np.int8), np.zeros(0), i, i.astype(np.bool_), i.astype(np.bool_), i)


class Opened(NamedTuple):
    """New chains, one row each."""

    id: np.ndarray
    """(c,)"""
    length: np.ndarray
    """(c,) of its pieces, m"""
    width: np.ndarray
    """(c,) with the gaps between its pieces and on to the walls at its ends, m"""
    room: np.ndarray
    """(c,) twice the distance from walls of that place on it (of those tried) that has most, m; `tol.gap` at most, and
    0 where it is too narrow anyhow"""
    middle: np.ndarray
    """(c, 2) point at half the length"""
    normal: np.ndarray
    """(c, 2) unit vector into the unknown"""
    ends: np.ndarray
    """(c, 4)"""
    kind: np.ndarray
    """(c,) of most of it"""
    visits: np.ndarray
    """(c,) halves"""


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
def boxes_of(segments, margin):
    """The boxes (x0, y0, x1, y1) of segments (m, 4), each with a margin, m."""
    out = np.empty(segments.shape)
    for i in range(segments.shape[0]):
        out[i, 0] = min(segments[i, 0], segments[i, 2]) - margin
        out[i, 1] = min(segments[i, 1], segments[i, 3]) - margin
        out[i, 2] = max(segments[i, 0], segments[i, 2]) + margin
        out[i, 3] = max(segments[i, 1], segments[i, 3]) + margin
    return out


@njit(cache=True)
def _take_off(ax, ay, bx, by, walls, boxes, margin, same_way, kept, n_kept, cut):
    """Take off the intervals `kept` of a-b what walls along it cover; `same_way`: only those that run as a-b does."""
    x0 = min(ax, bx)
    x1 = max(ax, bx)
    y0 = min(ay, by)
    y1 = max(ay, by)
    for w in range(walls.shape[0]):
        if (
            boxes[w, 2] < x0
            or boxes[w, 0] > x1
            or boxes[w, 3] < y0
            or boxes[w, 1] > y1
            or (same_way and (walls[w, 2] - walls[w, 0]) * (bx - ax) + (walls[w, 3] - walls[w, 1]) * (by - ay) <= 0.0)
        ):
            continue
        lo, hi = _covered(ax, ay, bx, by, walls[w], margin)
        if hi > lo:
            cut[0, 0] = lo
            cut[0, 1] = hi
            kept, n_kept = subtract(kept, n_kept, cut, 1)
            if n_kept == 0:
                break
    return kept, n_kept


@njit(cache=True)
def _part(segment, lo, hi, out):
    """The part of a segment from share lo to share hi of its length."""
    dx = segment[2] - segment[0]
    dy = segment[3] - segment[1]
    out[0] = segment[0] + lo * dx
    out[1] = segment[1] + lo * dy
    out[2] = segment[0] + hi * dx
    out[3] = segment[1] + hi * dy


@njit(cache=True)
def clip(pieces, sigma, scans, first, last, walls, tol):
    """Clip pieces (m, 4) with noise `sigma` (m,) by scan polygons `first` to `last` and by walls along them.

    A piece is resolved where the point `tol.nudge` and the noise beyond it, on its unknown side, lies in a scan
    polygon: so two coincident edges that face the same way never delete each other. Returns the remaining pieces, the
    index of the piece each comes from, and which pieces changed.
    """
    m = pieces.shape[0]
    reach = tol.max_range + tol.gap
    out = np.empty((2 * m + 64, 4))
    origin = np.empty(out.shape[0], np.int64)
    changed = np.zeros(m, np.bool_)
    cut = np.empty((scans.angles.size + 2, 2))
    boxes = boxes_of(walls, tol.cover)
    count = 0
    for i in range(m):
        ax, ay, bx, by = pieces[i, 0], pieces[i, 1], pieces[i, 2], pieces[i, 3]
        size = math.hypot(bx - ax, by - ay)
        if size <= 0.0:
            changed[i] = True
            continue
        kept = np.empty((1, 2))
        kept[0, 0] = 0.0
        kept[0, 1] = 1.0
        n_kept = 1
        # The point that must be seen lies no farther beyond the piece than this.
        beyond = tol.nudge + 2.0 * max(sigma[i], noise_at(reach, tol))
        lx, ly, hx, hy = ax, ay, bx, by  # ends of what is left
        for s in range(last - 1, first - 1, -1):  # the latest look was from near by
            if (
                scans.boxes[s, 2] < min(lx, hx) - beyond
                or scans.boxes[s, 0] > max(lx, hx) + beyond
                or scans.boxes[s, 3] < min(ly, hy) - beyond
                or scans.boxes[s, 1] > max(ly, hy) + beyond
            ):
                continue
            px = scans.apexes[s, 0]
            py = scans.apexes[s, 1]
            away = point_segment_distance(px, py, ax, ay, bx, by)
            if away > reach:
                continue
            nudge = (tol.nudge + 2.0 * max(sigma[i], noise_at(away, tol))) / size
            ox = nudge * (by - ay)
            oy = nudge * (ax - bx)
            if (
                max(lx, hx) + ox < scans.boxes[s, 0]
                or min(lx, hx) + ox > scans.boxes[s, 2]
                or max(ly, hy) + oy < scans.boxes[s, 1]
                or min(ly, hy) + oy > scans.boxes[s, 3]
            ):
                continue
            n_cut = inside_intervals(
                ax + ox - px, ay + oy - py, bx + ox - px, by + oy - py,
                scans.points[s], scans.rays[s], scans.angles, scans.headings[s], scans.full, cut,
            )  # fmt: skip
            kept, n_kept = subtract(kept, n_kept, cut, n_cut)
            if n_kept == 0:
                break
            lx, ly = ax + kept[0, 0] * (bx - ax), ay + kept[0, 0] * (by - ay)
            hx, hy = ax + kept[n_kept - 1, 1] * (bx - ax), ay + kept[n_kept - 1, 1] * (by - ay)
        if n_kept > 0:
            kept, n_kept = _take_off(ax, ay, bx, by, walls, boxes, tol.cover, False, kept, n_kept, cut)
        if n_kept != 1 or kept[0, 0] > 1e-9 or kept[0, 1] < 1.0 - 1e-9:
            changed[i] = True
        for r in range(n_kept):
            if (kept[r, 1] - kept[r, 0]) * size < tol.crumb and changed[i]:
                continue
            if count == out.shape[0]:
                out = np.concatenate((out, np.empty_like(out)))
                origin = np.concatenate((origin, np.empty_like(origin)))
            _part(pieces[i], kept[r, 0], kept[r, 1], out[count])
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
    cut = np.empty((1, 2))
    boxes = boxes_of(known, margin)
    count = 0
    for i in range(m):
        ax, ay, bx, by = pieces[i, 0], pieces[i, 1], pieces[i, 2], pieces[i, 3]
        size = math.hypot(bx - ax, by - ay)
        kept = np.empty((1, 2))
        kept[0, 0] = 0.0
        kept[0, 1] = 1.0
        kept, n_kept = _take_off(ax, ay, bx, by, known, boxes, margin, True, kept, 1, cut)
        for r in range(n_kept):
            whole = kept[r, 1] - kept[r, 0] == 1.0
            if not whole and (kept[r, 1] - kept[r, 0]) * size < shortest:
                continue
            if count == out.shape[0]:
                out = np.concatenate((out, np.empty_like(out)))
                origin = np.concatenate((origin, np.empty_like(origin)))
            _part(pieces[i], kept[r, 0], kept[r, 1], out[count])
            origin[count] = i
            count += 1
    return out[:count].copy(), origin[:count].copy()


@njit(cache=True)
def _wall_between(ax, ay, bx, by, walls):
    for w in range(walls.shape[0]):
        if crossing(ax, ay, bx, by, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]) >= 0.0:
            return True
    return False


@njit(cache=True)
def shown(segments, sigma, scans, s, walls, tol):
    """Which open edges (m, 4) scan s would have resolved if there were anything behind them: (m,) bool.

    It saw the whole edge from its known side, square enough, with beams close enough, and with range to spare; and
    none of the walls (w, 4) stands between it and what lies behind: in a doorway the jambs do, for looks from the side.
    """
    out = np.zeros(segments.shape[0], np.bool_)
    px, py = scans.apexes[s]
    for i in range(segments.shape[0]):
        dx = segments[i, 2] - segments[i, 0]
        dy = segments[i, 3] - segments[i, 1]
        size = math.hypot(dx, dy)
        if size <= 0.0:
            continue
        good = True
        for share in (0.1, 0.5, 0.9):
            x = segments[i, 0] + share * dx - px
            y = segments[i, 1] + share * dy - py
            away = math.hypot(x, y)
            square = (x * dy - y * dx) / size  # distance of the apex from the edge's line, on its known side
            if (
                away > tol.max_range - tol.gap
                or square < _SQUARE * away
                or away * away * tol.step * _LOOKS > tol.gap * square
            ):
                good = False
                break
            back = (tol.nudge + 2.0 * max(sigma[i], noise_at(away, tol))) / size
            if not contains(x - back * dy, y + back * dx, scans.points[s], scans.angles, scans.headings[s], scans.full):
                good = False
                break
            bx = x + back * dy
            by = y - back * dx
            to_line = square / (square + back * size)
            ends = to_line + 2.0 * tol.sigma_range / math.hypot(bx, by)
            if _wall_between(px, py, px + min(ends, 1.0) * bx, py + min(ends, 1.0) * by, walls):
                good = False
                break
        out[i] = good
    return out


@njit(cache=True)
def _wake_touching(segments, owner, stale, tolerance):
    """Make stale every whole chain with an end near an end of a stale piece that it could join."""
    n = segments.shape[0]
    woken = True
    while woken:
        woken = False
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for i in range(n):
            if stale[i]:
                x0 = min(x0, segments[i, 0], segments[i, 2])
                x1 = max(x1, segments[i, 0], segments[i, 2])
                y0 = min(y0, segments[i, 1], segments[i, 3])
                y1 = max(y1, segments[i, 1], segments[i, 3])
        for i in range(n):
            if (
                stale[i]
                or owner[i] < 0
                or min(segments[i, 0], segments[i, 2]) > x1 + tolerance
                or max(segments[i, 0], segments[i, 2]) < x0 - tolerance
                or min(segments[i, 1], segments[i, 3]) > y1 + tolerance
                or max(segments[i, 1], segments[i, 3]) < y0 - tolerance
            ):
                continue
            for j in range(n):
                if not stale[j]:
                    continue
                if (
                    abs(segments[i, 0] - segments[j, 2]) <= tolerance
                    and abs(segments[i, 1] - segments[j, 3]) <= tolerance
                ) or (
                    abs(segments[i, 2] - segments[j, 0]) <= tolerance
                    and abs(segments[i, 3] - segments[j, 1]) <= tolerance
                ):
                    chain = owner[i]
                    for q in range(n):
                        if owner[q] == chain:
                            stale[q] = True
                    woken = True
                    break


@njit(cache=True)
def rechain(pieces, dirty, local, left, fresh, walls, max_visits, next_id, tol):
    """Replace the `local` rows of `pieces` by what is `left` of them, add the `fresh` ones, chain what changed anew.

    `dirty` (m,) marks rows that changed; `left` are pieces in the order of the local rows they come from, with that
    row in place of the owner. A piece that is settled or was visited `max_visits` half times in vain is in no chain;
    openings narrower than `tol.trifle` are forgotten.
    Returns the new pieces (those of a chain together and in order), the new chains, numbered from `next_id` on, and for
    each of them the id (c,) of the chain of which it is what is left, or -1.
    """
    m = pieces.kind.size
    away = np.ones(m, np.bool_)
    for i in local:
        away[i] = False
    n = int(away.sum()) + left.kind.size + fresh.kind.size
    p = Pieces(
        np.empty((n, 4)), np.empty(n, np.int8), np.empty(n), np.zeros(n, np.int64), np.zeros(n, np.bool_),
        np.zeros(n, np.bool_), np.full(n, -1, np.int64),
    )  # fmt: skip
    stale = np.ones(n, np.bool_)
    ids = np.unique(pieces.owner)
    row = np.searchsorted(ids, pieces.owner)
    lost = np.zeros(ids.size, np.bool_)
    size_before = np.zeros(ids.size)
    for i in range(m):
        if dirty[i]:
            lost[row[i]] = True
        size_before[row[i]] += _size(pieces.segments[i])
    at = 0
    k = 0
    for i in range(m):  # in the old order: the pieces of a chain stay in theirs
        if away[i]:
            p.segments[at] = pieces.segments[i]
            p.kind[at], p.sigma[at], p.visits[at] = pieces.kind[i], pieces.sigma[i], pieces.visits[i]
            p.settled[at], p.retried[at], p.owner[at] = pieces.settled[i], pieces.retried[i], pieces.owner[i]
            stale[at] = dirty[i]
            at += 1
        while k < left.kind.size and left.owner[k] == i:
            p.segments[at] = left.segments[k]
            p.kind[at], p.sigma[at], p.visits[at] = left.kind[k], left.sigma[k], left.visits[k]
            p.settled[at], p.retried[at], p.owner[at] = left.settled[k], left.retried[k], pieces.owner[i]
            stale[at] = dirty[i]
            at += 1
            k += 1
    for k in range(fresh.kind.size):
        p.segments[at] = fresh.segments[k]
        p.kind[at], p.sigma[at] = fresh.kind[k], fresh.sigma[k]
        at += 1
    owner_before = p.owner.copy()
    for i in range(n):
        if p.owner[i] >= 0 and lost[np.searchsorted(ids, p.owner[i])]:
            stale[i] = True
        if p.settled[i] or p.visits[i] >= max_visits:
            p.owner[i] = -1
            stale[i] = False
        elif p.owner[i] < 0:
            stale[i] = True
    _wake_touching(p.segments, p.owner, stale, tol.gap)
    rows = np.flatnonzero(stale)
    order, offsets = link(p.segments[rows], p.sigma[rows], walls, tol)
    new = summarise(p.segments[rows], p.kind[rows], p.visits[rows], order, offsets, walls, next_id, tol)
    order, offsets, joined, other = join(p.segments[rows], order, offsets, new, walls, tol)
    if other:
        new = summarise(p.segments[rows], p.kind[rows], p.visits[rows], order, offsets, walls, next_id, tol)
    keep = np.ones(n, np.bool_)
    for i in range(n):
        keep[i] = not p.settled[i] or _size(p.segments[i]) >= tol.trifle
    left_of = np.full(new.id.size, -1, np.int64)
    for q in range(new.id.size):
        members = rows[order[offsets[q] : offsets[q + 1]]]
        left_of[q] = _most_of(p.segments, owner_before, members, ids, size_before)
        for i in members:
            p.owner[i] = new.id[q]
            keep[i] = new.width[q] >= tol.trifle or joined[q]
    arranged = np.concatenate((np.flatnonzero(~stale), rows[order]))
    arranged = arranged[keep[arranged]]
    return (
        Pieces(
            p.segments[arranged], p.kind[arranged], p.sigma[arranged], p.visits[arranged], p.settled[arranged],
            p.retried[arranged], p.owner[arranged],
        ),
        new,
        left_of,
    )  # fmt: skip


@njit(cache=True)
def _size(segment):
    return math.hypot(segment[2] - segment[0], segment[3] - segment[1])


@njit(cache=True)
def _most_of(segments, owner, members, ids, size_before):
    """The owner that most of the members (k,) had, if they are also most of what that of `ids` (o,) had; else -1."""
    total = 0.0
    for i in members:
        total += _size(segments[i])
    for i in members:
        if owner[i] < 0:
            continue
        share = 0.0
        for j in members:
            if owner[j] == owner[i]:
                share += _size(segments[j])
        if 2.0 * share > total:
            return owner[i] if 2.0 * share > size_before[np.searchsorted(ids, owner[i])] else -1
    return -1


@njit(cache=True)
def unchanged(new, which, gone, old_middle, old_ends):
    """For each of the new chains `which` the row in `gone` of one that was the very same, or -1."""
    out = np.full(which.size, -1, np.int64)
    for k in range(which.size):
        q = which[k]
        size = new.length[q]
        for row in gone:
            off = abs(new.middle[q, 0] - old_middle[row, 0]) + abs(new.middle[q, 1] - old_middle[row, 1])
            for e in range(4):
                off += abs(new.ends[q, e] - old_ends[row, e])
            if off < 1e-6 * size:
                out[k] = row
                break
    return out


@njit(cache=True)
def _walled(ax, ay, bx, by, walls, tol):
    """Whether a wall fills the gap a-b: it lies along the middle of it."""
    x = 0.5 * (ax + bx)
    y = 0.5 * (ay + by)
    for w in range(walls.shape[0]):
        if point_segment_distance(x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]) <= tol.cover:
            return True
    return False


@njit(cache=True)
def _successors(segments, sigma, walls, tol):
    """Index of the piece that goes on where each piece ends (mutually nearest), or -1.

    First those that touch. Then across gaps smaller than the gap of interest in which no wall stands: scans from the
    side cut an opening's boundary into parts that do not touch, but it is one opening.
    """
    n = segments.shape[0]
    after = np.full(n, -1, np.int64)
    before = np.full(n, -1, np.int64)
    for wide in range(2):
        best_after = np.full(n, math.inf)
        best_before = np.full(n, math.inf)
        to = np.full(n, -1, np.int64)
        back = np.full(n, -1, np.int64)
        for i in range(n):
            if after[i] >= 0:
                continue
            for j in range(n):
                if i == j or before[j] >= 0:
                    continue
                dx = segments[j, 0] - segments[i, 2]
                dy = segments[j, 1] - segments[i, 3]
                limit = tol.gap if wide else tol.join + 2.0 * max(sigma[i], sigma[j])
                if abs(dx) >= limit or abs(dy) >= limit:
                    continue
                d = math.hypot(dx, dy)
                if d >= limit or (d >= best_after[i] and d >= best_before[j]):
                    continue
                if wide and _walled(segments[i, 2], segments[i, 3], segments[j, 0], segments[j, 1], walls, tol):
                    continue
                if d < best_after[i]:
                    best_after[i] = d
                    to[i] = j
                if d < best_before[j]:
                    best_before[j] = d
                    back[j] = i
        for i in range(n):
            if to[i] >= 0 and back[to[i]] == i:
                after[i] = to[i]
                before[to[i]] = i
    return after


@njit(cache=True)
def link(segments, sigma, walls, tol):
    """Chain pieces (m, 4) that go on from each other: order (m,), and the offsets (c + 1,) of the chains in it.

    A chain is cut where it turns, and where it grows beyond the sensor's range, but never so that a part becomes
    shorter than the gap of interest.
    """
    n = segments.shape[0]
    after = _successors(segments, sigma, walls, tol)
    has_before = np.zeros(n, np.bool_)
    for i in range(n):
        if after[i] >= 0:
            has_before[after[i]] = True
    size = np.empty(n)
    for i in range(n):
        size[i] = math.hypot(segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1])
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
            parts = max(math.ceil(total / tol.max_range), 1)
            aim = total / parts
            run = 0.0
            left = total
            first = order[begin]
            for e in range(begin, count):
                i = order[e]
                if e > offsets[chains - 1] and run >= tol.gap and left >= tol.gap:
                    ux = segments[first, 2] - segments[first, 0]
                    uy = segments[first, 3] - segments[first, 1]
                    vx = segments[i, 2] - segments[i, 0]
                    vy = segments[i, 3] - segments[i, 1]
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
def _to_wall(x, y, walls, tol):
    """How far an opening goes on beyond the end of its open edges: to the wall there, no farther than walls cover."""
    limit = tol.cover + tol.join
    best = limit
    for w in range(walls.shape[0]):
        best = min(best, point_segment_distance(x, y, walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]))
    return best if best < limit else 0.0


@njit(cache=True)
def _free(x, y, walls, most, tol):
    """Distance of a point from the nearest wall, `most` at most; noise may have made walls longer at their ends."""
    best = most
    less = end_noise(tol)
    for w in range(walls.shape[0]):
        if (
            min(walls[w, 0], walls[w, 2]) < x + best
            and max(walls[w, 0], walls[w, 2]) > x - best
            and min(walls[w, 1], walls[w, 3]) < y + best
            and max(walls[w, 1], walls[w, 3]) > y - best
        ):
            dx = walls[w, 2] - walls[w, 0]
            dy = walls[w, 3] - walls[w, 1]
            length = math.hypot(dx, dy)
            f = less / length if length > 3.0 * less else 0.0
            best = min(
                best,
                point_segment_distance(
                    x, y, walls[w, 0] + f * dx, walls[w, 1] + f * dy, walls[w, 2] - f * dx, walls[w, 3] - f * dy
                ),
            )
    return best


@njit(cache=True)
def _room(segments, rows, walls, tol):
    """How wide a disc that goes through a chain (rows in order) may be: see `Opened.room`."""
    best = 0.0
    step = 0.1 * tol.gap
    for i in rows:  # most have room in the middle of a piece
        mx = 0.5 * (segments[i, 0] + segments[i, 2])
        my = 0.5 * (segments[i, 1] + segments[i, 3])
        if 2.0 * _free(mx, my, walls, 0.5 * tol.gap, tol) >= tol.gap:
            return tol.gap
    x = segments[rows[0], 0]
    y = segments[rows[0], 1]
    for i in rows:
        for share in range(2):  # the gap before a piece, and the piece
            ex = segments[i, 2 * share]
            ey = segments[i, 2 * share + 1]
            parts = max(int(math.hypot(ex - x, ey - y) / step), 1)
            for k in range(parts + 1):
                f = k / parts
                best = max(best, 2.0 * _free(x + f * (ex - x), y + f * (ey - y), walls, 0.5 * tol.gap, tol))
                if best >= tol.gap:
                    return best
            x = ex
            y = ey
    return best


@njit(cache=True)
def summarise(segments, kinds, visits, order, offsets, walls, next_id, tol):
    """What there is to say of the chains in `order` and `offsets` (see `link`)."""
    c = offsets.size - 1
    out = Opened(
        np.arange(next_id, next_id + c), np.zeros(c), np.zeros(c), np.zeros(c), np.empty((c, 2)), np.empty((c, 2)),
        np.empty((c, 4)), np.empty(c, np.int8), np.zeros(c, np.int64),
    )  # fmt: skip
    for q in range(c):
        total = 0.0
        gaps = 0.0
        per_kind = np.zeros(4)
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for e in range(offsets[q], offsets[q + 1]):
            i = order[e]
            size = math.hypot(segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1])
            total += size
            per_kind[kinds[i]] += size
            x0 = min(x0, segments[i, 0], segments[i, 2])
            x1 = max(x1, segments[i, 0], segments[i, 2])
            y0 = min(y0, segments[i, 1], segments[i, 3])
            y1 = max(y1, segments[i, 1], segments[i, 3])
            out.visits[q] = max(out.visits[q], visits[i])
            if e > offsets[q]:
                k = order[e - 1]
                gaps += math.hypot(segments[i, 0] - segments[k, 2], segments[i, 1] - segments[k, 3])
        out.kind[q] = np.argmax(per_kind)
        first = order[offsets[q]]
        last = order[offsets[q + 1] - 1]
        out.ends[q, 0] = segments[first, 0]
        out.ends[q, 1] = segments[first, 1]
        out.ends[q, 2] = segments[last, 2]
        out.ends[q, 3] = segments[last, 3]
        out.length[q] = total
        # Round the tip of a shadow a chain may be longer than it is wide.
        out.width[q] = min(total + gaps, math.hypot(x1 - x0, y1 - y0))
        if out.width[q] < tol.gap:  # else wide enough
            out.width[q] += _to_wall(out.ends[q, 0], out.ends[q, 1], walls, tol)
            out.width[q] += _to_wall(out.ends[q, 2], out.ends[q, 3], walls, tol)
        out.width[q] = min(out.width[q], _GAPPY * total)
        if out.width[q] >= tol.gap - 3.0 * tol.sigma_range:  # else too narrow anyhow
            out.room[q] = _room(segments, order[offsets[q] : offsets[q + 1]], walls, tol)
        run = 0.0
        out.middle[q, 0] = out.ends[q, 0]
        out.middle[q, 1] = out.ends[q, 1]
        px = 0.0
        py = 0.0
        for e in range(offsets[q], offsets[q + 1]):
            i = order[e]
            size = math.hypot(segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1])
            if run + size >= 0.5 * total and size > 0.0:
                f = (0.5 * total - run) / size
                px = segments[i, 2] - segments[i, 0]
                py = segments[i, 3] - segments[i, 1]
                out.middle[q, 0] = segments[i, 0] + f * px
                out.middle[q, 1] = segments[i, 1] + f * py
                break
            run += size
        cx = out.ends[q, 2] - out.ends[q, 0]
        cy = out.ends[q, 3] - out.ends[q, 1]
        chord = math.hypot(cx, cy)
        if chord < 0.3 * total:
            cx = px
            cy = py
            chord = math.hypot(cx, cy)
        chord = max(chord, 1e-300)
        out.normal[q, 0] = cy / chord
        out.normal[q, 1] = -cx / chord
    return out


@njit(cache=True)
def _total(segments):
    """Length of segments (m, 4) together."""
    total = 0.0
    for i in range(segments.shape[0]):
        total += _size(segments[i])
    return total


@njit(cache=True)
def _one_opening(a, b, new, walls, tol):
    """Whether chains a and b face the same way and one goes on where the other is, with no wall between."""
    if new.normal[a, 0] * new.normal[b, 0] + new.normal[a, 1] * new.normal[b, 1] < _ALIKE:
        return False
    ends = new.ends
    best = tol.gap
    x = y = 0.0
    for p, q in ((a, b), (b, a)):
        x0, y0, x1, y1 = ends[q]
        for e in range(0, 4, 2):
            px = ends[p, e]
            py = ends[p, e + 1]
            if px < min(x0, x1) - best or px > max(x0, x1) + best or py < min(y0, y1) - best or py > max(y0, y1) + best:
                continue
            t = (px - x0) * (x1 - x0) + (py - y0) * (y1 - y0)
            t = min(max(t / max((x1 - x0) ** 2 + (y1 - y0) ** 2, 1e-300), 0.0), 1.0)
            qx = x0 + t * (x1 - x0)
            qy = y0 + t * (y1 - y0)
            d = math.hypot(px - qx, py - qy)
            if d < best:
                best = d
                x = 0.5 * (px + qx)
                y = 0.5 * (py + qy)
    if best >= tol.gap:
        return False
    return best < tol.cover or not _walled(x, y, x, y, walls, tol)


@njit(cache=True)
def join(segments, order, offsets, new, walls, tol):
    """Make one chain of all that are narrow by themselves but parts of one opening: scans on the way past a corner cut
    its boundary into splinters that lie beside each other.

    The chains (c,) are given as by `link`, with what `summarise` says of them as `new`. Returns order and offsets,
    which of the chains have others beside them, and whether any are joined.
    """
    c = offsets.size - 1
    label = np.arange(c)
    beside = np.zeros(c, np.bool_)
    narrow = new.width < tol.gap
    for a in range(c):
        for b in range(a):
            if not (narrow[a] or narrow[b]) or (narrow[a] and narrow[b] and label[a] == label[b]):
                continue
            if not _one_opening(a, b, new, walls, tol):
                continue
            beside[a] = beside[b] = True
            if narrow[a] and narrow[b]:
                low, high = min(label[a], label[b]), max(label[a], label[b])
                for k in range(c):
                    if label[k] == high:
                        label[k] = low
    arranged = np.empty_like(order)
    begins = np.empty(order.size + 1, np.int64)
    joined = np.zeros(order.size, np.bool_)
    count = 0
    chains = 0
    other = False
    for a in range(c):
        if label[a] != a:
            continue
        begin = count
        nx = ny = 0.0
        for b in range(a, c):
            if label[b] == a:
                nx += new.length[b] * new.normal[b, 0]
                ny += new.length[b] * new.normal[b, 1]
                for e in range(offsets[b], offsets[b + 1]):
                    arranged[count] = order[e]
                    count += 1
        several = count - begin > offsets[a + 1] - offsets[a]
        if several:
            other = True
            # The unknown lies on the right: along the opening is to the left of its normal.
            along = np.empty(count - begin)
            for k in range(count - begin):
                i = arranged[begin + k]
                along[k] = (segments[i, 1] + segments[i, 3]) * nx - (segments[i, 0] + segments[i, 2]) * ny
            arranged[begin:count] = arranged[begin:count][np.argsort(along, kind="mergesort")]
        begins[chains] = begin
        joined[chains] = beside[a]
        chains += 1
        for k in range(begin + 1, count):
            i = arranged[k - 1]
            j = arranged[k]
            ax, ay, bx, by = segments[i, 2], segments[i, 3], segments[j, 0], segments[j, 1]
            d = math.hypot(bx - ax, by - ay)
            if several and (d >= tol.gap or (d >= tol.join and _walled(ax, ay, bx, by, walls, tol))):
                begins[chains] = k  # what lies beside each other by way of a third need not go on from each other
                joined[chains] = True
                chains += 1
    begins[chains] = count
    return arranged, begins[: chains + 1].copy(), joined[:chains].copy(), other


@njit(cache=True)
def take_in(s, ranges, point_segment, scans, pieces, walls, target, halves, max_visits, next_id, tol):
    """Take scan number `s`, with its ranges (n,) and the fitted segment (n,) of each, into the open edges.

    `walls` (w, 4) are those near it. The pieces of the chain `target` count so many `halves` of a visit more.
    Returns the pieces, the new chains and whose rest they are (see `rechain`), and whether it showed anything new.
    """
    x, y = scans.apexes[s]
    reach = tol.max_range + tol.gap
    labels = label_edges(ranges, point_segment, scans.full, tol)
    seen, kinds, sigmas = open_edges(scans.points[s], labels, scans.full, tol)
    for i in range(seen.shape[0]):
        seen[i, 0] += x
        seen[i, 1] += y
        seen[i, 2] += x
        seen[i, 3] += y
    seen, origin, _ = clip(seen, sigmas, scans, 0, s, walls, tol)
    kinds, sigmas = kinds[origin], sigmas[origin]

    local = near_point(pieces.segments, np.ones(pieces.kind.size, np.bool_), x, y, reach)
    before = pieces.segments[local]
    kept, origin, changed = clip(before, pieces.sigma[local], scans, s, s + 1, walls, tol)
    rows = local[origin]
    rest, again = clip_known(seen, kept, tol.nudge + 2.0 * tol.sigma_range, tol.crumb)
    looked_behind = shown(kept, pieces.sigma[rows], scans, s, walls, tol)
    visits = pieces.visits.copy()
    dirty = np.zeros(pieces.kind.size, np.bool_)
    dirty[local] = changed
    for k in range(rows.size):
        if looked_behind[k] and not pieces.settled[rows[k]]:
            dirty[rows[k]] = True
    if target >= 0:
        for i in range(pieces.owner.size):
            if pieces.owner[i] == target:
                visits[i] += halves
                dirty[i] = True
    useful = _total(rest) + _total(before) - _total(kept) >= 2.0 * tol.trifle
    m = rest.shape[0]
    if m == 0 and not dirty.any():
        none = np.zeros(0, np.int64)
        nothing = summarise(kept[:0], kinds[:0], none, none, np.zeros(1, np.int64), walls, next_id, tol)
        return pieces, nothing, none, useful
    left = Pieces(
        kept, pieces.kind[rows], pieces.sigma[rows], visits[rows], pieces.settled[rows] | looked_behind,
        pieces.retried[rows], rows,
    )  # fmt: skip
    fresh = Pieces(
        rest, kinds[again], sigmas[again], np.zeros(m, np.int64), np.zeros(m, np.bool_), np.zeros(m, np.bool_),
        np.full(m, -1, np.int64),
    )  # fmt: skip
    visited = Pieces(
        pieces.segments, pieces.kind, pieces.sigma, visits, pieces.settled, pieces.retried, pieces.owner
    )  # fmt: skip
    after, chains, left_of = rechain(visited, dirty, local, left, fresh, walls, max_visits, next_id, tol)
    return after, chains, left_of, useful


@njit(cache=True)
def succeed(owner, new, left_of, id_, middle, ends, least_width):
    """Which chains (c,) stay, and what becomes of the `new` ones: the `owner` (m,) of pieces and `new.id` follow.

    One that is the very same as a chain that goes is that chain: second, its row there for each of the new ones, or -1.
    Else one that is what is left of a chain still has its name. Third, which of the new ones are jump edges of their
    own: at least `least_width` wide.
    """
    staying = np.zeros(id_.size, np.bool_)
    for q in range(id_.size):
        for i in range(owner.size):
            if owner[i] == id_[q]:
                staying[q] = True
                break
    wide = np.flatnonzero(np.minimum(new.width, new.room) >= least_width)
    gone = np.flatnonzero(~staying)
    again = unchanged(new, wide, gone, middle, ends)
    same_as = np.full(new.id.size, -1, np.int64)
    for k in range(wide.size):
        q = wide[k]
        name = left_of[q]
        if again[k] >= 0:
            same_as[q] = again[k]
            name = id_[again[k]]
        if name >= 0:
            for i in range(owner.size):
                if owner[i] == new.id[q]:
                    owner[i] = name
            if again[k] < 0:
                new.id[q] = name
    for k in range(wide.size):
        if again[k] >= 0:
            staying[again[k]] = True
    return staying, same_as, wide[again < 0]
