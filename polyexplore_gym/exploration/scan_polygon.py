"""The scan polygon: the star-shaped free space of one scan, with labelled boundary edges.

Everything is relative to the apex (the sensor) unless said otherwise, and directed so that the
free space lies on the left: an open edge has the unknown on its right.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

WALL, JUMP, RANGE, VIEW = 0, 1, 2, 3

_ARC_SAGITTA = 0.03
"""How far (m) a chord that stands for an arc of range edges may lie inside the arc."""


@njit(cache=True)
def corner_points(angles, ranges, heading, max_range):
    """Corners of the scan polygon and the unit vectors of the beams, both (n, 2), about the apex.

    A beam without a return (inf) ends at `max_range`.
    """
    n = angles.size
    points = np.empty((n, 2))
    rays = np.empty((n, 2))
    for k in range(n):
        r = min(ranges[k], max_range)
        c = math.cos(heading + angles[k])
        s = math.sin(heading + angles[k])
        rays[k, 0] = c
        rays[k, 1] = s
        points[k, 0] = r * c
        points[k, 1] = r * s
    return points, rays


@njit(cache=True)
def _extrapolated(r0, r1, step):
    """Range of the line through two neighbouring returns, one more beam on; inf if it runs away."""
    # A line seen from the apex has 1/r sinusoidal in the angle: u(k+1) = 2 cos(step) u(k) - u(k-1).
    u = 2.0 * math.cos(step) / r1 - 1.0 / r0
    return 1.0 / u if u > 1e-9 else math.inf


@njit(cache=True)
def _same_surface(ranges, k, step, sigma_range, sigma_angle, full):
    """Whether returns k and k + 1 are explained by one local line and the noise (5 sigma)."""
    n = ranges.size
    j = (k + 1) % n
    a = ranges[k]
    b = ranges[j]
    far = max(a, b)
    # Noise of range, plus the shift of the end points by the angle noise on a surface at 45 degrees.
    slack = 5.0 * math.sqrt(2.0) * math.hypot(sigma_range, sigma_angle * far) + 0.05
    if abs(a - b) <= slack + far * step:
        return True
    before = (k - 1) % n
    after = (j + 1) % n
    if (k >= 1 or full) and not math.isinf(ranges[before]):
        predicted = _extrapolated(ranges[before], a, step)
        # The extrapolation amplifies the noise of its two returns about threefold.
        if abs(predicted - b) <= 3.0 * slack and (a - ranges[before]) * (b - a) > 0:
            return True
    if (j <= n - 2 or full) and not math.isinf(ranges[after]):
        predicted = _extrapolated(ranges[after], b, step)
        if abs(predicted - a) <= 3.0 * slack and (b - ranges[after]) * (a - b) > 0:
            return True
    return False


@njit(cache=True)
def label_edges(angles, ranges, point_segment, max_range, sigma_range, sigma_angle, min_gap, full):
    """Label of the edge from beam k to beam k + 1: WALL, JUMP or RANGE; (n,) or, not full, (n - 1,).

    Two returns on one fitted segment, or explained by the local line and the noise, lie on one
    surface, unless they are so far apart (`min_gap`) that a passage could hide between two beams.
    """
    n = angles.size
    m = n if full else n - 1
    step = (angles[n - 1] - angles[0]) / (n - 1)
    labels = np.empty(m, np.int8)
    for k in range(m):
        j = (k + 1) % n
        a = ranges[k]
        b = ranges[j]
        if math.isinf(a) and math.isinf(b):
            labels[k] = RANGE
        elif math.isinf(a) or math.isinf(b):
            labels[k] = JUMP if min(a, b) < max_range - 0.1 - 3.0 * sigma_range else RANGE
        else:
            gap = math.sqrt(max(a * a + b * b - 2.0 * a * b * math.cos(step), 0.0))
            if gap >= min_gap:
                labels[k] = JUMP
            elif (point_segment[k] >= 0 and point_segment[k] == point_segment[j]) or _same_surface(
                ranges, k, step, sigma_range, sigma_angle, full
            ):
                labels[k] = WALL
            else:
                labels[k] = JUMP
    return labels


@njit(cache=True)
def open_edges(points, labels, max_range, piece_length, full):
    """The open boundary as directed pieces: (m, 4) about the apex, and their kinds (m,).

    Runs of range edges become chords, long edges are cut to `piece_length` at most.
    """
    n = points.shape[0]
    m = labels.size
    out = np.empty((4 * n + 64, 4))
    kinds = np.empty(out.shape[0], np.int8)
    count = 0
    if not full:
        # The sides of the field of view; from the apex to the first corner the free space is on the left.
        for side in range(2):
            x = points[0 if side == 0 else n - 1, 0]
            y = points[0 if side == 0 else n - 1, 1]
            parts = math.ceil(math.hypot(x, y) / piece_length)
            for i in range(parts):
                f0 = i / parts
                f1 = (i + 1) / parts
                if side == 0:
                    out[count, 0], out[count, 1], out[count, 2], out[count, 3] = f0 * x, f0 * y, f1 * x, f1 * y
                else:
                    out[count, 0], out[count, 1], out[count, 2], out[count, 3] = f1 * x, f1 * y, f0 * x, f0 * y
                kinds[count] = VIEW
                count += 1
    k = 0
    while k < m:
        if labels[k] == WALL:
            k += 1
            continue
        stop = k + 1
        if labels[k] == RANGE:
            while stop < m and labels[stop] == RANGE:
                nx = points[(stop + 1) % n, 0]
                ny = points[(stop + 1) % n, 1]
                chord = math.hypot(nx - points[k, 0], ny - points[k, 1])
                if chord * chord / (8.0 * max_range) > _ARC_SAGITTA or chord > piece_length:
                    break
                stop += 1
        x0 = points[k, 0]
        y0 = points[k, 1]
        x1 = points[stop % n, 0]
        y1 = points[stop % n, 1]
        parts = max(math.ceil(math.hypot(x1 - x0, y1 - y0) / piece_length), 1)
        for i in range(parts):
            if count == out.shape[0]:
                break
            f0 = i / parts
            f1 = (i + 1) / parts
            out[count, 0] = x0 + f0 * (x1 - x0)
            out[count, 1] = y0 + f0 * (y1 - y0)
            out[count, 2] = x0 + f1 * (x1 - x0)
            out[count, 3] = y0 + f1 * (y1 - y0)
            kinds[count] = labels[k]
            count += 1
        k = stop
    return out[:count].copy(), kinds[:count].copy()


@njit(cache=True)
def sector_of(x, y, angles, heading, full):
    """Index k of the sector between beams k and k + 1 that holds a point; n - 1 is what lies behind."""
    n = angles.size
    theta = (math.atan2(y, x) - heading - angles[0]) % (2.0 * math.pi)
    span = angles[n - 1] - angles[0]
    if theta > span:
        # Behind a partial field of view, or the closing sector of a full circle.
        return n - 1
    k = int(theta / span * (n - 1))
    while k > 0 and angles[k] - angles[0] > theta:
        k -= 1
    while k < n - 1 and angles[k + 1] - angles[0] <= theta:
        k += 1
    return min(k, n - 1) if full else min(k, n - 2)


@njit(cache=True)
def contains(x, y, points, angles, heading, full):
    """Whether a point (about the apex) lies in the scan polygon."""
    n = angles.size
    k = sector_of(x, y, angles, heading, full)
    if k == n - 1 and not full:
        return False
    j = (k + 1) % n
    ex = points[j, 0] - points[k, 0]
    ey = points[j, 1] - points[k, 1]
    return ex * (y - points[k, 1]) - ey * (x - points[k, 0]) >= 0.0


@njit(cache=True)
def inside_intervals(ax, ay, bx, by, points, rays, angles, heading, full, out):
    """Parts of the segment a-b (about the apex) inside the scan polygon, as intervals of [0, 1].

    Walks through the sectors between neighbouring beams; within one the boundary is a line, so the
    crossing is exact. Writes (lo, hi) rows to `out` and returns how many.
    """
    n = angles.size
    dx = bx - ax
    dy = by - ay
    turn = ax * dy - ay * dx
    tiny = 1e-12 * (abs(dx) + abs(dy))
    k = sector_of(ax, ay, angles, heading, full)
    t = 0.0
    count = 0
    for _ in range(n + 2):
        end = 1.0
        if abs(turn) > tiny:
            ray = (k + 1) % n if turn > 0 else k
            ux = rays[ray, 0]
            uy = rays[ray, 1]
            c = ux * dy - uy * dx
            if (turn > 0 and c > 0) or (turn < 0 and c < 0):
                s = -(ux * ay - uy * ax) / c
                if s < 1.0 and ux * (ax + s * dx) + uy * (ay + s * dy) > 0.0:
                    end = max(s, t)
        if full or k != n - 1:
            j = (k + 1) % n
            ex = points[j, 0] - points[k, 0]
            ey = points[j, 1] - points[k, 1]
            base = ex * (ay - points[k, 1]) - ey * (ax - points[k, 0])
            slope = ex * dy - ey * dx
            lo = t
            hi = end
            f_lo = base + lo * slope
            f_hi = base + hi * slope
            if f_lo >= 0.0 or f_hi >= 0.0:
                if f_lo < 0.0:
                    lo = min(max(-base / slope, lo), hi)
                elif f_hi < 0.0:
                    hi = min(max(-base / slope, lo), hi)
                if hi > lo:
                    if count > 0 and lo - out[count - 1, 1] <= 1e-9:
                        out[count - 1, 1] = hi
                    elif count < out.shape[0]:
                        out[count, 0] = lo
                        out[count, 1] = hi
                        count += 1
        if end >= 1.0:
            break
        t = end
        k = (k + 1) % n if turn > 0 else (k - 1) % n
    return count


@njit(cache=True)
def subtract(kept, n_kept, cut, n_cut):
    """Intervals `kept` less the intervals `cut` (both ascending), in place; the new number."""
    if n_cut == 0 or n_kept == 0:
        return n_kept
    result = np.empty_like(kept)
    count = 0
    for i in range(n_kept):
        lo = kept[i, 0]
        hi = kept[i, 1]
        for c in range(n_cut):
            if cut[c, 1] <= lo:
                continue
            if cut[c, 0] >= hi:
                break
            if cut[c, 0] > lo and count < result.shape[0]:
                result[count, 0] = lo
                result[count, 1] = cut[c, 0]
                count += 1
            lo = cut[c, 1]
            if lo >= hi:
                break
        if lo < hi and count < result.shape[0]:
            result[count, 0] = lo
            result[count, 1] = hi
            count += 1
    for i in range(count):
        kept[i, 0] = result[i, 0]
        kept[i, 1] = result[i, 1]
    return count
