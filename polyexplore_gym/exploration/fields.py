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
def _enter(v, d, head, after, before, inside):
    """Put a vertex at distance d into its bucket, out of any other. Returns the bucket."""
    b = min(int(d * _PER_METRE), _BUCKETS - 1)
    if inside[v] != b:
        if inside[v] >= 0:
            _leave(v, head, after, before, inside)
        after[v] = head[b]
        before[v] = -1
        if head[b] >= 0:
            before[head[b]] = v
        head[b] = v
        inside[v] = b
    return b


@njit(cache=True, inline="always")
def _leave(v, head, after, before, inside):
    if before[v] >= 0:
        after[before[v]] = after[v]
    else:
        head[inside[v]] = after[v]
    if after[v] >= 0:
        before[after[v]] = before[v]
    inside[v] = -1


@njit(cache=True)
def _settle(dist, parent, source, reach, low, high, head, after, before, inside, links, kind):
    """Empty the queue, whose buckets from `low` to `high` hold vertices; leaves but the source are not gone through."""
    first, degree, _, target, cost, _ = links
    b = low
    while b <= high:
        v = head[b]
        if v < 0:
            b += 1
            continue
        _leave(v, head, after, before, inside)
        d = dist[v]
        if kind[v] == LEAF and v != source:
            continue
        for h in range(first[v], first[v] + degree[v]):
            w = target[h]
            if d + cost[h] < dist[w]:
                dist[w] = d + cost[h]
                parent[w] = v
                if kind[w] != LEAF and dist[w] <= reach:
                    high = max(high, _enter(w, dist[w], head, after, before, inside))


@njit(cache=True)
def grow(row, source, to, dist, parent, reach, links, kind):
    """Let the field in a row of dist, parent (k, v) and reach (k,) reach as far as `to`.

    A new one has the reach -1 and is infinite but at its source.
    """
    head = np.full(_BUCKETS, -1, np.int32)
    after = np.empty(dist.shape[1], np.int32)
    before = np.empty(dist.shape[1], np.int32)
    inside = np.full(dist.shape[1], -1, np.int32)
    d = dist[row]
    low = _BUCKETS
    high = -1
    for v in range(d.size):
        if reach[row] < d[v] <= to and d[v] < math.inf and (kind[v] != LEAF or v == source):
            b = _enter(v, d[v], head, after, before, inside)
            low = min(low, b)
            high = max(high, b)
    reach[row] = to
    _settle(d, parent[row], source, to, low, high, head, after, before, inside, links, kind)


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
    affected = np.empty(dist.shape[1], np.int64)
    head = np.full(_BUCKETS, -1, np.int32)
    after = np.empty(dist.shape[1], np.int32)
    before = np.empty(dist.shape[1], np.int32)
    inside = np.full(dist.shape[1], -1, np.int32)
    for k in range(sources.size):
        s = sources[k]
        if s < 0:
            continue
        d = dist[k]
        p = parent[k]
        n_hit = 0
        for e in range(cut.shape[0]):
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
            for h in range(links.first[v], links.first[v] + links.degree[v]):
                w = links.target[h]
                if p[w] == v and d[w] < math.inf:
                    p[w] = -1
                    d[w] = math.inf
                    affected[n_hit] = w
                    n_hit += 1
        low = _BUCKETS
        high = -1
        for i in range(n_hit):
            v = affected[i]
            for h in range(links.first[v], links.first[v] + links.degree[v]):
                w = links.target[h]
                if (kind[w] != LEAF or w == s) and d[w] + links.cost[h] < d[v]:
                    d[v] = d[w] + links.cost[h]
                    p[v] = w
            if d[v] < math.inf and d[v] <= reach[k] and kind[v] != LEAF:
                b = _enter(v, d[v], head, after, before, inside)
                low = min(low, b)
                high = max(high, b)
        for e in range(added.shape[0]):
            if kind[added[e, 0]] < 0 or kind[added[e, 1]] < 0:
                continue
            for side in range(2):
                v = added[e, side]
                w = added[e, 1 - side]
                if (kind[w] != LEAF or w == s) and d[w] + length[e] < d[v]:
                    d[v] = d[w] + length[e]
                    p[v] = w
                    if kind[v] != LEAF and d[v] <= reach[k]:
                        b = _enter(v, d[v], head, after, before, inside)
                        low = min(low, b)
                        high = max(high, b)
        _settle(d, p, s, reach[k], low, high, head, after, before, inside, links, kind)
