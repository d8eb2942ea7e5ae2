"""First guess of a scan's lines: iterative end-point fit with noise-aware splitting.

Runs of neighbouring returns are split where a return leaves the chord between the run's ends by
more than the noise explains, and where two lines fit much better than one. Pieces are then joined
again where one line explains both (likelihood ratio), and the border between neighbours is moved to
where both fit best. Each return ends with the label of its piece, or -1.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from polyexplore_gym.mapping.fit import distance2, fit, normal_variance

SPLIT_GATE = 3.5**2  # squared deviation from the chord over its variance
JOIN_GATE = 20.0  # chi-square of one line instead of two: 2 degrees of freedom, and the choice of the place
JOIN_THREE_GATE = 34.0  # the same for one line instead of three
EXCESS = 4.0  # a piece whose chi-square is so many standard deviations too large is no straight wall
ROUGH = 0.03  # accuracy of the fits that only choose, in standard deviations
BREAK_INCIDENCE = math.radians(86.0)  # neighbouring returns on a wall seen more obliquely start a new run


@njit(cache=True)
def runs(x: np.ndarray, y: np.ndarray, beam: np.ndarray, resolution: float, var_range: float) -> np.ndarray:
    """(m,) number of the run of each return; a new run starts at a missing return or a wide gap."""
    m = x.size
    run = np.zeros(m, np.int64)
    slope = math.sin(resolution) / math.sin(max(0.5 * math.pi - BREAK_INCIDENCE - resolution, resolution))
    noise = 3.0 * math.sqrt(2.0 * var_range)
    before = 0.0
    for k in range(m):
        d = math.sqrt(x[k] * x[k] + y[k] * y[k])
        if k > 0:
            reach = slope * min(d, before) + noise
            dx, dy = x[k] - x[k - 1], y[k] - y[k - 1]
            near = beam[k] == beam[k - 1] + 1 and dx * dx + dy * dy <= reach * reach
            run[k] = run[k - 1] if near else run[k - 1] + 1
        before = d
    return run


@njit(cache=True)
def farthest(x: np.ndarray, y: np.ndarray, lo: int, hi: int, var_range: float, var_angle: float) -> tuple[int, float]:
    """The return between lo and hi farthest from their chord, and the largest squared normalised deviation."""
    ux, uy = x[hi] - x[lo], y[hi] - y[lo]
    length = math.hypot(ux, uy)
    if length == 0.0:
        return (lo + hi) // 2, math.inf
    ux, uy = ux / length, uy / length
    ca, sa = -uy, ux
    v_lo = normal_variance(x[lo], y[lo], ca, sa, var_range, var_angle)
    v_hi = normal_variance(x[hi], y[hi], ca, sa, var_range, var_angle)
    best, far, worst = lo + 1, -1.0, 0.0
    for k in range(lo + 1, hi):
        dx, dy = x[k] - x[lo], y[k] - y[lo]
        off = abs(dx * ca + dy * sa)
        t = (dx * ux + dy * uy) / length
        v = normal_variance(x[k], y[k], ca, sa, var_range, var_angle)
        v += (1.0 - t) * (1.0 - t) * v_lo + t * t * v_hi
        worst = max(worst, off * off / v)
        if off > far:
            best, far = k, off
    return best, worst


@njit(cache=True)
def split(x: np.ndarray, y: np.ndarray, run: np.ndarray, var_range: float, var_angle: float) -> np.ndarray:
    """(p, 2) first and last return of each piece, in beam order."""
    m = x.size
    pieces = np.empty((m, 2), np.int64)
    count = 0
    stack = np.empty((m + 1, 2), np.int64)
    start = 0
    while start < m:
        stop = start
        while stop + 1 < m and run[stop + 1] == run[start]:
            stop += 1
        stack[0, 0], stack[0, 1] = start, stop
        top = 1
        while top > 0:
            top -= 1
            lo, hi = stack[top, 0], stack[top, 1]
            k, worst = (lo, 0.0) if hi - lo < 2 else farthest(x, y, lo, hi, var_range, var_angle)
            if worst <= SPLIT_GATE:
                pieces[count, 0], pieces[count, 1] = lo, hi
                count += 1
                continue
            # the corner return goes to the side it lies nearer to
            left = math.hypot(x[k] - x[k - 1], y[k] - y[k - 1]) <= math.hypot(x[k + 1] - x[k], y[k + 1] - y[k])
            cut = k if left else k - 1
            stack[top, 0], stack[top, 1] = cut + 1, hi
            stack[top + 1, 0], stack[top + 1, 1] = lo, cut
            top += 2
        start = stop + 1
    return pieces[:count]


@njit(cache=True)
def border(
    x: np.ndarray, y: np.ndarray, lo: int, hi: int, rho: float, alpha: float, var_range: float, var_angle: float
) -> tuple[int, float]:
    """Where two lines fit returns lo..hi best: the last return of the first one, and the chi-square of both.

    Each has 3 returns at least. Both are straight lines of deviations over positions along the line (rho, alpha),
    with its weights.
    """
    ca, sa = math.cos(alpha), math.sin(alpha)
    n = hi - lo + 1
    sums = np.zeros((n + 1, 6))
    for q in range(n):
        k = lo + q
        e, t = x[k] * ca + y[k] * sa - rho, y[k] * ca - x[k] * sa
        w = 1.0 / normal_variance(x[k], y[k], ca, sa, var_range, var_angle)
        s = sums[q + 1]
        s[0], s[1], s[2], s[3], s[4], s[5] = w, w * t, w * t * t, w * e, w * e * t, w * e * e
        s += sums[q]
    best, least = -1, math.inf
    for q in range(3, n - 2):
        chi2 = misfit(sums[q]) + misfit(sums[n] - sums[q])
        if chi2 < least:
            best, least = lo + q - 1, chi2
    return best, least


@njit(cache=True)
def misfit(s: np.ndarray) -> float:
    """Chi-square of the best straight line, from the sums of w, wt, wtt, we, wet, wee."""
    tt, et = s[2] - s[1] * s[1] / s[0], s[4] - s[1] * s[3] / s[0]
    return s[5] - s[3] * s[3] / s[0] - (et * et / tt if tt > 0.0 else 0.0)


@njit(cache=True)
def divide(x: np.ndarray, y: np.ndarray, pieces: np.ndarray, var_range: float, var_angle: float) -> np.ndarray:
    """Part the pieces that no one line fits, though no return leaves the chord: steps of a few sigma."""
    order = np.arange(x.size)
    out, stack = np.empty((x.size, 2), np.int64), np.empty((x.size + 1, 2), np.int64)
    line = np.empty(8)
    count = 0
    for p in range(pieces.shape[0]):
        stack[0] = pieces[p]
        top = 1
        while top > 0:
            top -= 1
            lo, hi = stack[top, 0], stack[top, 1]
            dof = hi - lo - 1
            k = -1
            if dof >= 4:
                fit_piece(x, y, order, lo, hi, var_range, var_angle, line)
                if line[7] > dof + EXCESS * math.sqrt(2.0 * dof):
                    at, chi2 = border(x, y, lo, hi, line[2], line[3], var_range, var_angle)
                    if line[7] - chi2 > JOIN_GATE:
                        k = at
            if k < 0:
                out[count, 0], out[count, 1] = lo, hi
                count += 1
            else:
                stack[top, 0], stack[top, 1] = k + 1, hi
                stack[top + 1, 0], stack[top + 1, 1] = lo, k
                top += 2
    return out[:count]


@njit(cache=True)
def fit_piece(
    x: np.ndarray,
    y: np.ndarray,
    order: np.ndarray,
    lo: int,
    hi: int,
    var_range: float,
    var_angle: float,
    out: np.ndarray,
) -> None:
    """Fit returns lo..hi roughly into out = lo, hi, rho, alpha, var_alpha, cov, var_rho, chi-square."""
    out[0], out[1] = lo, hi
    out[2], out[3], out[4], out[5], out[6], out[7] = fit(x, y, order[lo : hi + 1], var_range, var_angle, ROUGH)


@njit(cache=True)
def hopeless(x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two pieces differ so much that joining them need not be tried."""
    k, j = int(a[1]), int(b[0])
    p, q = np.empty((2, 2)), np.empty((2, 2))
    p[0, 0], p[0, 1], p[1, 0], p[1, 1] = a[4], a[5], a[5], a[6]
    q[0, 0], q[0, 1], q[1, 0], q[1, 1] = b[4], b[5], b[5], b[6]
    return distance2(a[2], a[3], p, b[2], b[3], q, 0.5 * (x[k] + x[j]), 0.5 * (y[k] + y[j])) > 10.0 * JOIN_GATE


@njit(cache=True)
def join(
    x: np.ndarray, y: np.ndarray, run: np.ndarray, pieces: np.ndarray, var_range: float, var_angle: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join neighbouring pieces of a run which one line explains. Returns pieces, rho, alpha (3 returns and more)."""
    order = np.arange(x.size)
    line = np.empty((pieces.shape[0] + 1, 8))
    p = 0
    for q in range(pieces.shape[0]):
        if pieces[q, 1] - pieces[q, 0] >= 2:
            fit_piece(x, y, order, pieces[q, 0], pieces[q, 1], var_range, var_angle, line[p])
            p += 1
    trial = np.empty(8)
    # neighbours first; then three at once, where a chance tilt of the middle one keeps the outer two apart
    width = 2
    while width <= 3:
        joined = False
        kept = 0
        for q in range(p):
            line[kept] = line[q]
            kept += 1
            first = kept - width
            if first < 0:
                continue
            lo, hi = int(line[first, 0]), int(line[kept - 1, 1])
            used, apart = 0, 0.0
            for r in range(first, kept):
                apart += line[r, 7]
                used += int(line[r, 1] - line[r, 0]) + 1
            free = hi - lo + 1 - used
            if run[lo] != run[hi] or free > 2 * (width - 1) or hopeless(x, y, line[first], line[kept - 1]):
                continue
            fit_piece(x, y, order, lo, hi, var_range, var_angle, trial)
            if trial[7] - apart < (JOIN_GATE if width == 2 else JOIN_THREE_GATE) + 4.0 * free:
                line[first] = trial
                kept = first + 1
                joined = True
        p = kept
        width = 2 if joined else width + 1
    return line[:p, :2].astype(np.int64), line[:p, 2].copy(), line[:p, 3].copy()


@njit(cache=True)
def sharpen(
    x: np.ndarray,
    y: np.ndarray,
    run: np.ndarray,
    pieces: np.ndarray,
    rho: np.ndarray,
    alpha: np.ndarray,
    var_range: float,
    var_angle: float,
) -> None:
    """Move the border between neighbouring pieces to where the squared normalised residuals are least."""
    for q in range(pieces.shape[0] - 1):
        a_hi, b_lo = pieces[q, 1], pieces[q + 1, 0]
        if run[a_hi] != run[b_lo]:
            continue
        lo = max(pieces[q, 0] + 2, a_hi - 8)
        hi = min(pieces[q + 1, 1] - 2, b_lo + 8)
        ca, sa, cb, sb = math.cos(alpha[q]), math.sin(alpha[q]), math.cos(alpha[q + 1]), math.sin(alpha[q + 1])
        # border k: returns up to k belong to the first piece; the cost is relative to border lo
        cost, best, border = 0.0, 0.0, lo
        for k in range(lo + 1, hi):
            ea = x[k] * ca + y[k] * sa - rho[q]
            eb = x[k] * cb + y[k] * sb - rho[q + 1]
            cost += ea * ea / normal_variance(x[k], y[k], ca, sa, var_range, var_angle)
            cost -= eb * eb / normal_variance(x[k], y[k], cb, sb, var_range, var_angle)
            if cost < best:
                best, border = cost, k
        if hi > lo:
            pieces[q, 1], pieces[q + 1, 0] = border, border + 1


@njit(cache=True)
def endpoint_labels(
    x: np.ndarray,
    y: np.ndarray,
    beam: np.ndarray,
    resolution: float,
    var_range: float,
    var_angle: float,
    min_points: int,
    min_length: float,
) -> tuple[np.ndarray, int]:
    """(m,) label of the piece each return lies on (-1 none) and the number of pieces."""
    run = runs(x, y, beam, resolution, var_range)
    pieces = split(x, y, run, var_range, var_angle)
    pieces = divide(x, y, pieces, var_range, var_angle)
    pieces, rho, alpha = join(x, y, run, pieces, var_range, var_angle)
    sharpen(x, y, run, pieces, rho, alpha, var_range, var_angle)
    label = np.full(x.size, -1, np.int64)
    count = 0
    for q in range(pieces.shape[0]):
        lo, hi = pieces[q, 0], pieces[q, 1]
        if hi - lo + 1 < min_points:
            continue
        sa, ca = math.sin(alpha[q]), math.cos(alpha[q])
        if abs((x[hi] - x[lo]) * sa - (y[hi] - y[lo]) * ca) < min_length:
            continue
        label[lo : hi + 1] = count
        count += 1
    return label, count
