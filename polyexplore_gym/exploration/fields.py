"""Distance fields: shortest ways from a source to all vertices, and their repair where the graph has changed.

Only what a change can have made longer or shorter is searched again (Ramalingam and Reps 1996). A field is right as
far as its reach; beyond it are upper bounds. The queue sorts by buckets of distance: a vertex may leave its bucket too
early, and then comes back to it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.exploration.corners import LEAF

_BUCKETS = 2048
_PER_METRE = 4.0
"""Buckets a metre; what is farther than all buckets shares the last."""
_SPARE = 2.0
"""A field that must grow grows by this much more, m."""


@njit(cache=True, inline="always")
def _enter(v, d, head, after, entry, inside, count):
    """Put a vertex at distance d into its bucket, out of any other. Returns the bucket and the entries in use."""
    b = min(int(d * _PER_METRE), _BUCKETS - 1)
    if inside[v] != b:
        inside[v] = b
        entry[count] = v
        after[count] = head[b]
        head[b] = count
        count += 1
    return b, count


@njit(cache=True)
def _settle(dist, parent, reach, low, high, head, after, entry, inside, count, first, degree, target, cost, kind):
    """Empty the queue, whose buckets from `low` to `high` hold vertices in `count` entries.

    `head` is the last entry of each bucket, `after` what follows an entry; a vertex that is not `inside` the bucket
    any more has moved on. Leaves do not enter: no path goes through them.
    """
    b = low
    while b <= high:
        e = head[b]
        if e < 0:
            b += 1
            continue
        head[b] = after[e]
        v = entry[e]
        if inside[v] != b:
            continue
        inside[v] = -1
        if count + degree[v] > entry.size:
            after = np.concatenate((after, np.empty_like(after)))
            entry = np.concatenate((entry, np.empty_like(entry)))
        d = dist[v]
        h0 = np.uint64(first[v])
        for h in range(h0, h0 + np.uint64(degree[v])):
            w = target[h]
            far = d + cost[h]
            if far < dist[w]:
                dist[w] = far
                parent[w] = v
                if far <= reach and kind[w] != LEAF:
                    bw, count = _enter(w, far, head, after, entry, inside, count)
                    high = max(high, bw)


@njit(cache=True)
def grow(row, source, to, dist, parent, reach, links, kind):
    """Let the field in a row of dist, parent (k, v) and reach (k,) reach as far as `to`.

    A new one has the reach -1 and is infinite but at its source.
    """
    n = dist.shape[1]
    head = np.full(_BUCKETS, -1, np.int32)
    after = np.empty(4 * n, np.int32)
    entry = np.empty(4 * n, np.uint32)
    inside = np.full(n, -1, np.int16)
    count = 0
    d = dist[row]
    low = _BUCKETS
    high = -1
    for v in range(d.size):
        if reach[row] < d[v] <= to and d[v] < math.inf and (kind[v] != LEAF or v == source):
            b, count = _enter(v, d[v], head, after, entry, inside, count)
            low = min(low, b)
            high = max(high, b)
    reach[row] = to
    _settle(d, parent[row], to, low, high, head, after, entry, inside, count, links.first, links.degree, links.target,
            links.cost, kind)  # fmt: skip


@njit(cache=True)
def between(rows, sources, guess, dist, parent, reach, links, kind):
    """Lengths (n, n) of the shortest ways between sources (n,) with fields in `rows`, which grow where they must.

    One field of a pair has to reach the other source. `guess` (n,), a length from anywhere to each, says how far.
    """
    n = rows.size
    out = np.zeros((n, n))
    # What nothing may lead to first: its surroundings are small. Then what reaches far.
    order = np.argsort(np.where(np.isinf(guess), -math.inf, -reach[rows]), kind="mergesort")
    for a in range(n):
        i = order[a]
        for attempt in range(3):
            to = -1.0
            for b in range(a + 1, n):
                j = order[b]
                length = min(dist[rows[i], sources[j]], dist[rows[j], sources[i]])
                if length > max(reach[rows[i]], reach[rows[j]]):
                    to = max(to, min(length, guess[i] + guess[j]) + _SPARE)
                out[i, j] = out[j, i] = length
            if to < 0.0:
                break
            if attempt > 0 or to <= reach[rows[i]]:
                to = math.inf
            grow(rows[i], sources[i], to, dist, parent, reach, links, kind)
    return out


@njit(cache=True)
def repair(dist, parent, reach, sources, cut, added, length, links, kind):
    """Repair the fields dist, parent (k, v), reach (k,) of `sources` (k,) (-1: none) after edges (e, 2) were cut and
    added."""
    n = dist.shape[1]
    head = np.full(_BUCKETS, -1, np.int32)
    after = np.empty(4 * n + 2 * added.shape[0], np.int32)
    entry = np.empty(after.size, np.uint32)
    inside = np.full(n, -1, np.int16)
    affected = np.empty(n, np.uint32)
    target, cost = links.target, links.cost
    runs = _runs(cut)
    live = np.empty(runs.size, np.bool_)
    ends, size, through = _standing(added, length, kind)
    for k in range(sources.size):
        s = sources[k]
        if s < 0:
            continue
        d = dist[k]
        p = parent[k]
        for r in range(runs.size - 1):
            live[r] = d[cut[runs[r], 0]] < math.inf
        n_hit = 0
        for r in range(runs.size - 1):
            # A vertex that the field does not reach is nobody's parent.
            for e in range(runs[r], runs[r + 1] if live[r] else 0):
                for side in range(2):
                    v = cut[e, side]
                    if p[v] == cut[e, 1 - side] and d[v] < math.inf:
                        p[v] = -1
                        d[v] = math.inf
                        affected[n_hit] = v
                        n_hit += 1
        i = 0
        while i < n_hit:
            v = affected[i]
            i += 1
            h0 = np.uint64(links.first[v])
            for h in range(h0, h0 + np.uint64(links.degree[v])):
                w = target[h]
                if p[w] == v and d[w] < math.inf:
                    p[w] = -1
                    d[w] = math.inf
                    affected[n_hit] = w
                    n_hit += 1
        low = _BUCKETS
        high = -1
        count = 0
        for i in range(n_hit):
            v = affected[i]
            best = math.inf
            by = np.uint32(0)
            h0 = np.uint64(links.first[v])
            for h in range(h0, h0 + np.uint64(links.degree[v])):
                w = target[h]
                if d[w] + cost[h] < best and (kind[w] != LEAF or w == s):
                    best = d[w] + cost[h]
                    by = w
            if best < math.inf:
                d[v] = best
                p[v] = by
                if best <= reach[k] and kind[v] != LEAF:
                    b, count = _enter(v, best, head, after, entry, inside, count)
                    low = min(low, b)
                    high = max(high, b)
        for e in range(size.size):
            for side in range(2):
                v = ends[e, side]
                w = ends[e, 1 - side]
                if d[w] + size[e] < d[v] and (through[e, 1 - side] or w == s):
                    d[v] = d[w] + size[e]
                    p[v] = w
                    if through[e, side] and d[v] <= reach[k]:
                        b, count = _enter(v, d[v], head, after, entry, inside, count)
                        low = min(low, b)
                        high = max(high, b)
        _settle(
            d, p, reach[k], low, high, head, after, entry, inside, count, links.first, links.degree, target, cost, kind
        )


@njit(cache=True)
def _runs(cut):
    """Where the rows (k + 1,) of edges (e, 2) with the same first vertex begin, and the end."""
    out = np.empty(cut.shape[0] + 1, np.int64)
    k = 0
    for e in range(cut.shape[0]):
        if e == 0 or cut[e, 0] != cut[e - 1, 0]:
            out[k] = e
            k += 1
    out[k] = cut.shape[0]
    return out[: k + 1]


@njit(cache=True)
def _standing(added, length, kind):
    """The edges (e, 2) that no wall has taken since: their ends, lengths, and whether paths lead through each end."""
    ends = np.empty(added.shape, np.uint32)
    size = np.empty(added.shape[0])
    through = np.empty(added.shape, np.bool_)
    k = 0
    for e in range(added.shape[0]):
        if kind[added[e, 0]] >= 0 and kind[added[e, 1]] >= 0:
            ends[k] = added[e]
            size[k] = length[e]
            for side in range(2):
                through[k, side] = kind[added[e, side]] != LEAF
            k += 1
    return ends[:k], size[:k], through[:k]
