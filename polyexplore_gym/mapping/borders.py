"""Which returns each edge of a scan's polylines stands for (see `polylines`).

The returns are in the order of their bearings, c and s are the cosines and sines of these, r the
ranges; `run` numbers the runs of neighbouring returns that an edge may join. A line a x + b y = 1
meets a beam at 1 / (a c + b s), so in 1 / range the fit is linear; with the weights range^4 its
residuals are those of range to first order.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

NEVER = 1e18  # cost of what must not be
LONGEST = 1e3  # m; a line that passes the sensor farther along one of its own beams is none
COARSE = 0.03  # relative error of range up to which the fit to first order will do
ALIKE = 1e-9  # sine; beams of one direction
WIDEST = -0.99  # cosine; no line is seen under half a turn
DISTINCT = 1e-12  # beams in fewer directions than this (determinant over its terms) make no line


@njit(cache=True)
def chord_error(x: np.ndarray, y: np.ndarray, r: np.ndarray, a: int, b: int) -> float:
    """Sum of squared errors of range of the returns between a and b, if their chord stood for them, m2."""
    ux, uy = x[b] - x[a], y[b] - y[a]
    off = x[a] * uy - y[a] * ux
    total = 0.0
    for k in range(a + 1, b):
        across = x[k] * uy - y[k] * ux
        if across * off <= 0.0:
            return NEVER
        e = r[k] * (off / across - 1.0)
        total += e * e
    return total


@njit(cache=True)
def removal(
    x: np.ndarray, y: np.ndarray, r: np.ndarray, run: np.ndarray, before: np.ndarray, after: np.ndarray,
    own: np.ndarray, k: int, miss2: float,
) -> float:  # fmt: skip
    """What it costs to take vertex k out, m2: the error of the longer chord, or returns that lose their line.

    `before` and `after` are the neighbours (-1, m: none), `own` the errors of the chords that begin at a vertex.
    """
    m, a, b = r.size, before[k], after[k]
    left, right = a >= 0 and run[a] == run[k], b < m and run[b] == run[k]
    if left and right:
        return chord_error(x, y, r, a, b) - own[a] - own[k]
    if left:
        alone = before[a] < 0 or run[before[a]] != run[a]
        return miss2 * (k - a + (1 if alone else 0)) - own[a]
    if right:
        alone = after[b] >= m or run[after[b]] != run[b]
        return miss2 * (b - k + (1 if alone else 0)) - own[k]
    return 0.0


@njit(cache=True)
def thin(
    x: np.ndarray, y: np.ndarray, r: np.ndarray, run: np.ndarray, keep: int, budget: int, miss2: float
) -> tuple[np.ndarray, float]:
    """Take vertices out one by one, the cheapest first.

    Returns (m,) which returns are the last `keep` vertices, and the cost of the last `budget`, m2:
    that of the polylines of Schaefer et al. before they are optimised.
    """
    m = r.size
    before, after = np.arange(m) - 1, np.arange(m) + 1
    own, cost = np.zeros(m), np.empty(m)
    stays = np.ones(m, np.bool_)
    total = 0.0
    for k in range(m):
        cost[k] = removal(x, y, r, run, before, after, own, k, miss2)
        if (k == 0 or run[k - 1] != run[k]) and (k + 1 == m or run[k + 1] != run[k]):
            total += miss2
    for left in range(m, budget, -1):
        k = int(np.argmin(cost))
        total += cost[k]
        if left > keep:
            stays[k] = False
        cost[k] = math.inf
        a, b = before[k], after[k]
        if a >= 0:
            after[a] = b
            own[a] = chord_error(x, y, r, a, b) if b < m and run[a] == run[b] else 0.0
        if b < m:
            before[b] = a
        for q in (a, before[a] if a >= 0 else -1, b, after[b] if b < m else m):
            if 0 <= q < m:
                cost[q] = removal(x, y, r, run, before, after, own, q, miss2)
    return stays, total


@njit(cache=True)
def borders(run: np.ndarray, vertex: np.ndarray) -> np.ndarray:
    """(A + 1,) first return of each of A atoms, and m. Edges begin and end with atoms: on either side of a vertex."""
    m = run.size
    starts = np.empty(m + 1, np.int64)
    n = 0
    for k in range(m):
        if k == 0 or run[k] != run[k - 1] or vertex[k] or vertex[k - 1]:
            starts[n] = k
            n += 1
    starts[n] = m
    return starts[: n + 1].copy()


@njit(cache=True)
def measure(
    c: np.ndarray, s: np.ndarray, r: np.ndarray, run: np.ndarray, starts: np.ndarray, miss2: float, bound: float
) -> np.ndarray:
    """(A, A + 1, 6) for atoms i to j - 1 on one line: error, a, b, and the inverse aa, ab, bb of the normal matrix.

    The error is NEVER where there is no line, or one worse than none or than `bound`.
    """
    atoms = starts.size - 1
    sums = np.zeros((atoms, 6))
    for i in range(atoms):
        for k in range(starts[i], starts[i + 1]):
            w, wc, ws = r[k] * r[k], r[k] * r[k] * c[k], r[k] * r[k] * s[k]
            sums[i, 0] += w
            sums[i, 1] += r[k] * wc
            sums[i, 2] += r[k] * ws
            sums[i, 3] += wc * wc
            sums[i, 4] += wc * ws
            sums[i, 5] += ws * ws
    fits = np.empty((atoms, atoms + 1, 6))
    fits[:, :, 0] = NEVER
    for i in range(atoms):
        rr = ra = rb = aa = ab = bb = 0.0
        first = starts[i]
        for j in range(i + 1, atoms + 1):
            last = starts[j] - 1
            cross, dot = c[first] * s[last] - s[first] * c[last], c[first] * c[last] + s[first] * s[last]
            if run[last] != run[first] or cross < -ALIKE or dot < WIDEST:
                break
            rr, ra, rb = rr + sums[j - 1, 0], ra + sums[j - 1, 1], rb + sums[j - 1, 2]
            aa, ab, bb = aa + sums[j - 1, 3], ab + sums[j - 1, 4], bb + sums[j - 1, 5]
            det = aa * bb - ab * ab
            if last == first or det <= DISTINCT * aa * bb:
                continue
            a, b = (ra * bb - rb * ab) / det, (rb * aa - ra * ab) / det
            error = max(rr - a * ra - b * rb, 0.0)
            if bound > error > COARSE * COARSE * rr:
                a, b, error = refit(c, s, r, first, last, a, b)
            least = min(a * c[first] + b * s[first], a * c[last] + b * s[last])
            if error > min(miss2 * (last + 1 - first), bound) or least * LONGEST < 1.0:
                continue
            f = fits[i, j]
            f[0], f[1], f[2], f[3], f[4], f[5] = error, a, b, bb / det, -ab / det, aa / det
    return fits


@njit(cache=True)
def refit(
    c: np.ndarray, s: np.ndarray, r: np.ndarray, first: int, last: int, a: float, b: float
) -> tuple[float, float, float]:
    """Line a, b fitted again with the weights at its own ranges, and its error of range, m2, not to first order."""
    ra = rb = aa = ab = bb = 0.0
    for k in range(first, last + 1):
        p = 1.0 / max(a * c[k] + b * s[k], 1.0 / LONGEST)
        w = p * p * p
        ra += w * c[k]
        rb += w * s[k]
        aa += r[k] * w * c[k] * c[k]
        ab += r[k] * w * c[k] * s[k]
        bb += r[k] * w * s[k] * s[k]
    det = aa * bb - ab * ab
    if det > DISTINCT * aa * bb:
        a, b = (ra * bb - rb * ab) / det, (rb * aa - ra * ab) / det
    error = 0.0
    for k in range(first, last + 1):
        e = r[k] - 1.0 / max(a * c[k] + b * s[k], 1.0 / LONGEST)
        error += e * e
    return a, b, error


@njit(cache=True)
def range_on(f: np.ndarray, c: float, s: float) -> tuple[float, float]:
    """Range at which a fitted line meets the beam of direction c, s, m, and its variance for a unit range noise."""
    p = 1.0 / max(f[1] * c + f[2] * s, 1.0 / LONGEST)
    return p, max((f[3] * c * c + 2.0 * f[4] * c * s + f[5] * s * s) * p * p * p * p, 1e-300)


@njit(cache=True)
def bend(f: np.ndarray, g: np.ndarray, c: np.ndarray, s: np.ndarray, k: int, j: int) -> tuple[float, float]:
    """What it costs that lines f and g meet between beams k and j, m2, and where, from 0 (at k) to 1 (at j).

    Nothing if they do so by themselves; else least squares with the constraint that they meet at k or at j.
    """
    a, b = f[1] - g[1], f[2] - g[2]
    at_k, at_j = a * c[k] + b * s[k], a * c[j] + b * s[j]
    if at_k * at_j <= 0.0:
        return 0.0, abs(at_k) / max(abs(at_k) + abs(at_j), 1e-300)
    p, variance_p = range_on(f, c[k], s[k])
    q, variance_q = range_on(g, c[k], s[k])
    cost_k = (p - q) * (p - q) / (variance_p + variance_q)
    p, variance_p = range_on(f, c[j], s[j])
    q, variance_q = range_on(g, c[j], s[j])
    cost_j = (p - q) * (p - q) / (variance_p + variance_q)
    return (cost_k, 0.0) if cost_k <= cost_j else (cost_j, 1.0)


@njit(cache=True)
def choose(
    c: np.ndarray, s: np.ndarray, run: np.ndarray, starts: np.ndarray, fits: np.ndarray, budget: int, miss2: float,
    bound: float, wraps: bool,
) -> tuple[np.ndarray, bool]:  # fmt: skip
    """The edges of least cost with so many vertices, and whether the last meets the first (only if it `wraps`).

    Rows: first return, end of the returns, 1 if it shares a vertex with the edge before, first atom,
    end of the atoms. An edge takes two vertices, one if it shares. Edges that share must meet (see
    `bend`); a lone return may be an edge that shares with the one before it. `ends` holds the cost
    up to an atom if an edge over two returns or more ends there, `lone` if it is a lone return's,
    `best` the least of both and of leaving the atom before out. What costs more than `bound` is not pursued.
    """
    atoms = starts.size - 1
    size = (atoms + 1, budget + 2)
    best, ends, lone = np.full(size, NEVER), np.full(size, NEVER), np.full(size, NEVER)
    origin, shares = np.zeros(size, np.int64), np.zeros(size, np.int64)
    best[0, 0] = 0.0
    for k in range(atoms + 1):
        for v in range(budget + 2):
            left_out = best[k - 1, v] + miss2 * (starts[k] - starts[k - 1]) if k > 0 else NEVER
            best[k, v] = min(best[k, v], left_out, ends[k, v], lone[k, v])
        if k == atoms:
            break
        least = 0
        while least <= budget and best[k, least] > bound:
            least += 1
        touches = k > 0 and run[starts[k]] == run[starts[k] - 1]
        if touches and starts[k + 1] - starts[k] == 1:
            for v in range(budget + 1):
                lone[k + 1, v + 1] = min(ends[k, v], lone[k, v])
        for j in range(k + 1, atoms + 1):
            if run[starts[j] - 1] != run[starts[k]]:
                break
            error = fits[k, j, 0]
            if error >= NEVER:
                continue
            known, bent = -1, 0.0
            for v in range(least, budget + 1):
                f = best[k, v] + error
                if v < budget and f < ends[j, v + 2]:
                    ends[j, v + 2], origin[j, v + 2], shares[j, v + 2] = f, k, 0
                f = ends[k, v] + error
                if touches and f < ends[j, v + 1]:
                    if origin[k, v] != known:
                        known = origin[k, v]
                        bent, _ = bend(fits[known, k], fits[k, j], c, s, starts[k] - 1, starts[k])
                    if f + bent < ends[j, v + 1]:
                        ends[j, v + 1], origin[j, v + 1], shares[j, v + 1] = f + bent, k, 1

    within = int(np.argmin(best[atoms, : budget + 1]))
    edges = trace(best, ends, lone, origin, shares, starts, within, False)
    if wraps and ends[atoms, budget + 1] < best[atoms, within]:
        # with one vertex more, if its ends then become one
        more = trace(best, ends, lone, origin, shares, starts, budget + 1, True)
        n = more.shape[0]
        if n > 2 and more[0, 0] == 0 and more[n - 1, 3] >= 0:
            f, g = fits[more[n - 1, 3], more[n - 1, 4]], fits[more[0, 3], more[0, 4]]
            bent, _ = bend(f, g, c, s, starts[atoms] - 1, 0)
            if ends[atoms, budget + 1] + bent < best[atoms, within]:
                return more, True
    return edges, False


@njit(cache=True)
def trace(
    best: np.ndarray, ends: np.ndarray, lone: np.ndarray, origin: np.ndarray, shares: np.ndarray, starts: np.ndarray,
    v: int, line: bool,
) -> np.ndarray:  # fmt: skip
    """(P, 5) edges behind the last entry of `best` with v vertices, or of `ends` if `line` (see `choose`)."""
    out = np.empty((starts.size, 5), np.int64)
    n, k = 0, starts.size - 1
    state = 1 if line else 0
    while k > 0:
        if state == 0:
            state = 1 if best[k, v] == ends[k, v] else 2 if best[k, v] == lone[k, v] else 0
            if state == 0:
                k -= 1
        elif state == 1:
            i, shared = int(origin[k, v]), int(shares[k, v])
            out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = starts[i], starts[k], shared, i, k
            n, k, v, state = n + 1, i, v - 2 + shared, shared
        else:
            out[n, 0], out[n, 1], out[n, 2], out[n, 3], out[n, 4] = starts[k - 1], starts[k], 1, k - 1, k
            n, k, v = n + 1, k - 1, v - 1
            state = 1 if lone[k + 1, v + 1] == ends[k, v] else 2
    return out[:n][::-1].copy()
