"""The scan polygon: the star-shaped free space of one scan, with labelled boundary edges.

Everything is relative to the apex (the sensor) unless said otherwise, and directed so that the
free space lies on the left: an open edge has the unknown on its right.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.exploration.segments import point_segment_distance
from polyexplore_gym.exploration.tolerances import noise_at

WALL, JUMP, RANGE, VIEW = 0, 1, 2, 3
BLOCK = 8
"""So many neighbouring sectors are passed at once where a segment is nearer or farther than their whole boundary."""


class Scans(NamedTuple):
    """Scan polygons: which space is known."""

    apexes: np.ndarray
    """(s, 2) where each scan was made, m"""
    headings: np.ndarray
    """(s,) rad"""
    boxes: np.ndarray
    """(s, 4) x0, y0, x1, y1 of the polygon, m"""
    points: np.ndarray
    """(s, n, 2) corners about the apex, m"""
    rays: np.ndarray
    """(s, n, 2) unit vectors of the beams"""
    blocks: np.ndarray
    """(s, b, 2) nearest and farthest distance of the boundary in blocks of sectors, m"""
    angles: np.ndarray
    """(n,) of the beams in the robot's frame, rad"""
    full: bool
    """whether the last beam neighbours the first"""
    reach: float
    """maximum range, m"""


EVERYTHING = Scans(
    np.zeros((0, 2)), np.zeros(0), np.zeros((0, 4)), np.zeros((0, 2, 2)), np.zeros((0, 2, 2)),
    np.zeros((0, 1, 2)), np.array([0.0, 1.0]), False, 0.0,
)  # fmt: skip
"""No limit to what is known."""


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
def box_of(points, x, y):
    """The box (x0, y0, x1, y1) of a scan polygon with corners (n, 2) about its apex (x, y)."""
    x0 = y0 = x1 = y1 = 0.0
    for k in range(points.shape[0]):
        x0 = min(x0, points[k, 0])
        y0 = min(y0, points[k, 1])
        x1 = max(x1, points[k, 0])
        y1 = max(y1, points[k, 1])
    spare = 1e-9 * (x1 - x0 + y1 - y0)  # rounding must not take a corner out
    return np.array([x + x0 - spare, y + y0 - spare, x + x1 + spare, y + y1 + spare])


@njit(cache=True)
def block_distances(points):
    """Nearest and farthest distance from the apex (b, 2) of the boundary with corners (n, 2), `BLOCK` sectors each.

    The sector from the last beam to the first is in none.
    """
    n = points.shape[0]
    out = np.empty((n // BLOCK + 1, 2))
    for b in range(out.shape[0]):
        near = math.inf
        far = 0.0
        for k in range(BLOCK * b, min(BLOCK * (b + 1), n - 1)):
            ax, ay = points[k]
            bx, by = points[k + 1]
            near = min(near, point_segment_distance(0.0, 0.0, ax, ay, bx, by))
            far = max(far, math.hypot(ax, ay), math.hypot(bx, by))
        out[b, 0] = near
        out[b, 1] = far
    return out


@njit(cache=True)
def _extrapolated(r0, r1, step):
    """Range of the line through two neighbouring returns, one more beam on; inf if it runs away."""
    # A line seen from the apex has 1/r sinusoidal in the angle: u(k+1) = 2 cos(step) u(k) - u(k-1).
    u = 2.0 * math.cos(step) / r1 - 1.0 / r0
    return 1.0 / u if u > 1e-9 else math.inf


@njit(cache=True)
def _same_surface(ranges, k, full, tol):
    """Whether returns k and k + 1 are explained by one local line and the noise (5 sigma)."""
    n = ranges.size
    j = (k + 1) % n
    a = ranges[k]
    b = ranges[j]
    far = max(a, b)
    # Noise of range, plus the shift of the end points by the angle noise on a surface at 45 degrees.
    slack = 5.0 * math.sqrt(2.0) * noise_at(far, tol) + tol.surface
    if abs(a - b) <= slack + far * tol.step:
        return True
    before = (k - 1) % n
    after = (j + 1) % n
    if (k >= 1 or full) and not math.isinf(ranges[before]):
        predicted = _extrapolated(ranges[before], a, tol.step)
        # The extrapolation amplifies the noise of its two returns about threefold.
        if abs(predicted - b) <= 3.0 * slack and (a - ranges[before]) * (b - a) > 0:
            return True
    if (j <= n - 2 or full) and not math.isinf(ranges[after]):
        predicted = _extrapolated(ranges[after], b, tol.step)
        if abs(predicted - a) <= 3.0 * slack and (b - ranges[after]) * (a - b) > 0:
            return True
    return False


@njit(cache=True)
def label_edges(ranges, point_segment, full, tol):
    """Label of the edge from beam k to beam k + 1: WALL, JUMP or RANGE; (n,) or, not full, (n - 1,).

    Two returns on one fitted segment, or explained by the local line and the noise, lie on one surface, unless they
    are so far apart (`tol.gap`) that a passage could hide between two beams: there nothing is known to be wall.
    """
    n = ranges.size
    m = n if full else n - 1
    labels = np.empty(m, np.int8)
    for k in range(m):
        j = (k + 1) % n
        a = ranges[k]
        b = ranges[j]
        if math.isinf(a) and math.isinf(b):
            labels[k] = RANGE
        elif math.isinf(a) or math.isinf(b):
            labels[k] = JUMP if min(a, b) < tol.max_range - 2.0 * tol.surface - 3.0 * tol.sigma_range else RANGE
        else:
            apart = math.sqrt(max(a * a + b * b - 2.0 * a * b * math.cos(tol.step), 0.0))
            if apart >= tol.gap:
                labels[k] = JUMP
            elif (point_segment[k] >= 0 and point_segment[k] == point_segment[j]) or _same_surface(
                ranges, k, full, tol
            ):
                labels[k] = WALL
            else:
                labels[k] = JUMP
    return labels


@njit(cache=True)
def _at_limit(point, tol):
    return math.hypot(point[0], point[1]) > (1.0 - 1e-9) * tol.max_range


@njit(cache=True)
def _run_end(points, labels, k, full, tol):
    """The end (a beam number) of the open edge that begins at beam k: runs of range edges become chords.

    Those of beams without return, all at the maximum range: a chord from a return before it would lie deeper inside.
    """
    n = points.shape[0]
    m = labels.size
    stop = k + 1
    if labels[k] != RANGE or not (_at_limit(points[k], tol) and _at_limit(points[stop % n], tol)):
        return stop
    while stop < m and labels[stop] == RANGE and _at_limit(points[(stop + 1) % n], tol):
        chord = math.hypot(points[(stop + 1) % n, 0] - points[k, 0], points[(stop + 1) % n, 1] - points[k, 1])
        if chord * chord / (8.0 * tol.max_range) > tol.sagitta or chord > tol.piece:
            break
        stop += 1
    return stop


@njit(cache=True)
def _cut_up(x0, y0, x1, y1, kind, far, tol, out, kinds, sigmas, count):
    """Append a directed edge in equal pieces of at most `tol.piece`; returns the new number of pieces."""
    parts = max(math.ceil(math.hypot(x1 - x0, y1 - y0) / tol.piece), 1)
    for i in range(parts):
        f0 = i / parts
        f1 = (i + 1) / parts
        out[count, 0] = x0 + f0 * (x1 - x0)
        out[count, 1] = y0 + f0 * (y1 - y0)
        out[count, 2] = x0 + f1 * (x1 - x0)
        out[count, 3] = y0 + f1 * (y1 - y0)
        kinds[count] = kind
        sigmas[count] = noise_at(far, tol)
        count += 1
    return count


@njit(cache=True)
def open_edges(points, labels, full, tol):
    """The open boundary as directed pieces: (m, 4) about the apex, their kinds (m,) and noise (m,), m.

    Runs of range edges become chords, long edges are cut to `tol.piece` at most.
    """
    n = points.shape[0]
    m = labels.size
    longest = 2.0 * tol.max_range  # no edge is longer
    room = 2 * (math.ceil(longest / tol.piece) + 1)
    k = 0
    while k < m:
        if labels[k] == WALL:
            k += 1
            continue
        stop = _run_end(points, labels, k, full, tol)
        size = math.hypot(points[stop % n, 0] - points[k, 0], points[stop % n, 1] - points[k, 1])
        room += max(math.ceil(size / tol.piece), 1)
        k = stop
    out = np.empty((room, 4))
    kinds = np.empty(room, np.int8)
    sigmas = np.empty(room)
    count = 0
    if not full:
        # The sides of the field of view; from the apex to the first corner the free space is on the left.
        x, y = points[0, 0], points[0, 1]
        count = _cut_up(0.0, 0.0, x, y, VIEW, math.hypot(x, y), tol, out, kinds, sigmas, count)
        x, y = points[n - 1, 0], points[n - 1, 1]
        count = _cut_up(x, y, 0.0, 0.0, VIEW, math.hypot(x, y), tol, out, kinds, sigmas, count)
    k = 0
    while k < m:
        if labels[k] == WALL:
            k += 1
            continue
        stop = _run_end(points, labels, k, full, tol)
        x0, y0 = points[k, 0], points[k, 1]
        x1, y1 = points[stop % n, 0], points[stop % n, 1]
        # A range discontinuity begins at the nearer return: the noise there tells where it stands.
        near, far = math.hypot(x0, y0), math.hypot(x1, y1)
        count = _cut_up(
            x0, y0, x1, y1, labels[k], min(near, far) if labels[k] == JUMP else far, tol, out, kinds, sigmas, count
        )
        k = stop
    return out[:count].copy(), kinds[:count].copy(), sigmas[:count].copy()


@njit(cache=True)
def sector_of(x, y, angles, heading, full):
    """Index k of the sector between beams k and k + 1 that holds a point; n - 1 is what lies behind."""
    n = angles.size
    theta = math.atan2(y, x) - heading - angles[0]
    if theta < 0.0:  # most headings need no more than this, and remainders take long
        theta += 2.0 * math.pi
    if theta < 0.0 or theta >= 2.0 * math.pi:
        theta %= 2.0 * math.pi
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
def _next_ray(ax, ay, dx, dy, ux, uy, turn, t):
    """Where (t in [0, 1]) a segment that turns as the sign of `turn` about the apex meets a ray; 1 where it ends
    before."""
    c = ux * dy - uy * dx
    if (turn > 0 and c > 0) or (turn < 0 and c < 0):
        s = -(ux * ay - uy * ax) / c
        if s < 1.0 and ux * (ax + s * dx) + uy * (ay + s * dy) > 0.0:
            return max(s, t)
    return 1.0


@njit(cache=True)
def _add_interval(lo, hi, out, count):
    """Append an interval that begins at or after the end of the last; returns the new number."""
    if hi <= lo:
        return count
    if count > 0 and lo - out[count - 1, 1] <= 1e-9:
        out[count - 1, 1] = hi
        return count
    out[count, 0] = lo
    out[count, 1] = hi
    return count + 1


@njit(cache=True)
def _beside(ax, ay, dx, dy, lo, hi, near, far):
    """1 if the part from lo to hi of a segment is nearer to the apex than `near`, -1 if farther than `far`, else 0."""
    x0, y0 = ax + lo * dx, ay + lo * dy
    x1, y1 = ax + hi * dx, ay + hi * dy
    if max(x0 * x0 + y0 * y0, x1 * x1 + y1 * y1) < (1.0 - 1e-9) * near * near:
        return 1
    if point_segment_distance(0.0, 0.0, x0, y0, x1, y1) > (1.0 + 1e-9) * far:
        return -1
    return 0


@njit(cache=True)
def inside_intervals(ax, ay, bx, by, points, rays, blocks, angles, heading, full, out):
    """Parts of the segment a-b (about the apex) inside the scan polygon, as intervals of [0, 1].

    Walks through the sectors between neighbouring beams; within one the boundary is a line, so the
    crossing is exact. Blocks of sectors are passed at once where the segment is nearer or farther than all of their
    boundary. Writes (lo, hi) rows to `out` (n + 2 or more) and returns how many.
    """
    n = angles.size
    dx = bx - ax
    dy = by - ay
    turn = ax * dy - ay * dx
    radial = abs(turn) <= 1e-12 * (abs(dx) + abs(dy))
    by_block = BLOCK * (angles[n - 1] - angles[0]) < 0.5 * math.pi * (n - 1)
    k = sector_of(ax, ay, angles, heading, full)
    t = 0.0
    count = 0
    tried = -1  # the block whose sectors are looked at one by one
    for _ in range(2 * n + 2):
        block = k // BLOCK
        if by_block and not radial and k < n - 1 and block != tried:
            tried = block
            first = BLOCK * block
            last = min(first + BLOCK, n - 1) - 1
            ray = last + 1 if turn > 0 else first
            end = _next_ray(ax, ay, dx, dy, rays[ray, 0], rays[ray, 1], turn, t)
            beside = _beside(ax, ay, dx, dy, t, end, blocks[block, 0], blocks[block, 1])
            if beside != 0:
                if beside > 0:
                    count = _add_interval(t, end, out, count)
                k = last if turn > 0 else first
                if end >= 1.0:
                    break
                t = end
                k = k + 1 if turn > 0 else (k - 1 if k > 0 else n - 1)
                continue
        j = k + 1 if k < n - 1 else 0
        end = 1.0
        if not radial:
            ray = j if turn > 0 else k
            end = _next_ray(ax, ay, dx, dy, rays[ray, 0], rays[ray, 1], turn, t)
        if full or k != n - 1:
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
                count = _add_interval(lo, hi, out, count)
        if end >= 1.0:
            break
        t = end
        k = j if turn > 0 else (k - 1 if k > 0 else n - 1)
    return count


@njit(cache=True)
def is_known(x, y, scans, since):
    """Whether a point lies in a scan polygon from number `since` on; the newest are tried first."""
    for s in range(scans.headings.size - 1, since - 1, -1):
        if (
            scans.boxes[s, 0] <= x <= scans.boxes[s, 2]
            and scans.boxes[s, 1] <= y <= scans.boxes[s, 3]
            and contains(
                x - scans.apexes[s, 0], y - scans.apexes[s, 1], scans.points[s], scans.angles, scans.headings[s],
                scans.full,
            )
        ):  # fmt: skip
            return True
    return False


@njit(cache=True)
def subtract(kept, n_kept, cut, n_cut):
    """Intervals `kept` less the intervals `cut` (both ascending): the rest, and their number."""
    if n_cut == 0 or n_kept == 0:
        return kept, n_kept
    result = np.empty((n_kept + n_cut, 2))
    count = 0
    for i in range(n_kept):
        lo = kept[i, 0]
        hi = kept[i, 1]
        for c in range(n_cut):
            if cut[c, 1] <= lo:
                continue
            if cut[c, 0] >= hi:
                break
            if cut[c, 0] > lo:
                result[count, 0] = lo
                result[count, 1] = cut[c, 0]
                count += 1
            lo = cut[c, 1]
            if lo >= hi:
                break
        if lo < hi:
            result[count, 0] = lo
            result[count, 1] = hi
            count += 1
    return result, count
