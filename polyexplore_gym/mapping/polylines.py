"""One scan to a few polylines: `extract_polylines`.

The best description of a scan by so many vertices is the one under which the scan is most likely:
with equal noise of range on all beams, the one with the least sum of squared differences of range
along the beams (Schaefer, Buescher, Luft, Burgard, "A Maximum Likelihood Approach to Extract
Polylines from 2-D Laser Range Scans", IROS 2018). They remove vertices greedily and then search for
better places. Here the greedy removal (`thin`) only proposes where an edge may begin and end; the
borders are chosen by dynamic programming over least-squares lines (`choose`) and the vertices are
settled by damped Gauss-Newton steps (`settle`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping.borders import LONGEST, NEVER, bend, borders, choose, measure, range_on, thin
from polyexplore_gym.mapping.extract import check_scan, turned_returns
from polyexplore_gym.mapping.fit import TWO_PI

SPARE = 20  # vertices proposed beyond those asked for ...
LEAST = 60  # ... but no fewer than so many
ROUNDING = 1e-6  # m2; sums of squares are not known better
WIDE = 1.0  # rad; beams farther apart are no neighbours
STEPS = 15  # most Gauss-Newton steps
SETTLED = 1e-4  # a step that gains less than this share ends them


@dataclass(frozen=True, slots=True)
class ScanPolylines:
    """A scan as V vertices on polylines, in the robot frame; n beams, E edges."""

    vertices: np.ndarray
    """(V, 2) x, y, m, in the order of the beams."""
    polyline: np.ndarray
    """(V,) number of the polyline that each vertex is on; vertices in sequence on one polyline are joined."""
    closed: bool
    """Whether there is one polyline only, whose last vertex is joined to its first."""
    explained: np.ndarray
    """(n,) whether an edge stands for the return of the beam."""

    def segments(self) -> np.ndarray:
        """(E, 4) the edges x1, y1, x2, y2, m."""
        if self.closed:
            return np.hstack([self.vertices, np.roll(self.vertices, -1, axis=0)])
        joined = self.polyline[1:] == self.polyline[:-1]
        return np.hstack([self.vertices[:-1][joined], self.vertices[1:][joined]])


def extract_polylines(
    angles: np.ndarray,
    ranges: np.ndarray,
    max_vertices: int,
    sensor: SensorConfig | None = None,
    *,
    miss: float = 0.36,
    max_gap: float = 1.0,
) -> ScanPolylines:
    """Describe one scan by polylines of so many vertices in all, as accurately along the beams as they allow.

    For a compact picture of a scan, whatever it shows. Lines for a map, with covariances and only
    where the noise model holds, come from `extract_lines`.

    Args:
        angles: (n,) beam angles in the robot frame, rad, in any order.
        ranges: (n,) measured ranges, m; inf, or anything from the sensor's maximum range on, is a beam
            without a return. Beams with NaN or less than 1e-6 m are left out.
        max_vertices: most vertices, at least 2.
        sensor: maximum range, and whether the field of view closes.
        miss: a return that nothing stands for counts like an error of so much, m. Less gives lower
            errors on fewer returns (`benchmarks/line_accuracy.py` shows how much).
        max_gap: no edge joins neighbouring returns farther apart than this, m.

    Raises:
        ValueError: the arrays are not one-dimensional, differ in length or do not hold real numbers; or a
            number is out of its limits.

    Example:
        >>> import numpy as np
        >>> from polyexplore_gym.mapping import extract_polylines
        >>> angles = np.linspace(-0.8, 0.8, 161)
        >>> corner = np.minimum(2.0 / np.cos(angles - 0.7), 2.0 / np.cos(angles + 0.7))
        >>> extract_polylines(angles, corner, 3).vertices.round(2)[1] + 0.0
        array([2.61, 0.  ])
    """
    sensor = SensorConfig() if sensor is None else sensor
    known, angles, ranges = check_scan(angles, ranges)
    if max_vertices < 2:
        raise ValueError(f"max_vertices is {max_vertices}; a line has two ends")
    if not 0.0 < miss < math.inf:
        raise ValueError(f"miss is {miss}; it must be positive and finite")
    if not max_gap > 0.0:
        raise ValueError(f"max_gap is {max_gap}; it must be positive")
    start, (x, y, beam, reach, _, _) = turned_returns(angles, ranges, sensor.max_range, sensor.full_circle)
    bearing = np.roll(angles, -start)
    bearing[angles.size - start :] += TWO_PI
    wraps = sensor.full_circle and beam.size > 2 and beam[0] == 0 and beam[-1] == angles.size - 1
    vertices, polyline, closed, explained = _describe(
        x, y, bearing[beam], reach[beam], beam, wraps, max_vertices, miss * miss, max_gap
    )
    of_beam = np.zeros(angles.size, bool)
    of_beam[(beam[explained] + start) % angles.size] = True
    if known is not None:
        of_beam = known.spread(of_beam, False)
    return ScanPolylines(vertices, polyline, closed, of_beam)


@njit(cache=True)
def _describe(
    x: np.ndarray, y: np.ndarray, t: np.ndarray, r: np.ndarray, beam: np.ndarray, wraps: bool, budget: int,
    miss2: float, max_gap: float,
) -> tuple[np.ndarray, np.ndarray, bool, np.ndarray]:  # fmt: skip
    """Returns in the order of their bearings to vertices, polyline numbers, closed, and the returns explained."""
    m = r.size
    budget = min(budget, 2 * m)
    c, s = x / r, y / r
    run = np.zeros(m, np.int64)
    for k in range(1, m):
        near = beam[k] == beam[k - 1] + 1 and t[k] - t[k - 1] < WIDE
        near = near and math.hypot(x[k] - x[k - 1], y[k] - y[k - 1]) <= max_gap
        run[k] = run[k - 1] if near else run[k - 1] + 1
    vertex, bound = thin(x, y, r, run, max(budget + SPARE, LEAST), budget, miss2)
    bound += ROUNDING
    starts = borders(run, vertex)
    fits = measure(c, s, r, run, starts, miss2, bound)
    wraps = wraps and m > 2 and math.hypot(x[0] - x[m - 1], y[0] - y[m - 1]) <= max_gap
    edges, closes = choose(c, s, run, starts, fits, budget, miss2, bound, wraps)
    by = 0
    if closes:
        # the last polyline goes before the first, which it joins; a single one becomes a polygon
        head = edges.shape[0] - 1
        while head > 0 and edges[head, 2] == 1:
            head -= 1
        by = edges[head, 0]
        c, s, r = np.roll(c, -by), np.roll(s, -by), np.roll(r, -by)
        t = np.concatenate((t[by:] - TWO_PI, t[:by]))
        edges = np.concatenate((edges[head:], edges[:head]))
        edges[:, 0] = (edges[:, 0] - by) % m
        edges[:, 1] = (edges[:, 1] - by - 1) % m + 1
        if head > 0:
            edges[edges.shape[0] - head, 2] = 1
        closes = head == 0
    bearing, radius, polyline = place(c, s, t, r, edges, fits, closes)
    explained, sound = np.zeros(m, np.bool_), np.ones(bearing.size, np.bool_)
    lo = first = 0
    for q in range(1, edges.shape[0] + 1):
        if q == edges.shape[0] or edges[q, 2] == 0:
            end = first
            while end < bearing.size and polyline[end] == polyline[first]:
                end += 1
            a, b = edges[lo, 0], edges[q - 1, 1]
            if settle(c, s, t, r, a, b, closes, bearing[first:end], radius[first:end]) < NEVER:
                explained[a:b] = True
            else:  # beams too few to hold the vertices in their order
                sound[first:end] = False
            lo, first = q, end
    vertices = np.empty((bearing.size, 2))
    vertices[:, 0], vertices[:, 1] = radius * np.cos(bearing), radius * np.sin(bearing)
    return vertices[sound], polyline[sound], closes, np.roll(explained, by)


@njit(cache=True)
def place(
    c: np.ndarray, s: np.ndarray, t: np.ndarray, r: np.ndarray, edges: np.ndarray, fits: np.ndarray, closes: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bearing, range and polyline number of the vertices: where the lines of edges meet, or end."""
    size = 2 * edges.shape[0]
    bearing, radius, polyline = np.empty(size), np.empty(size), np.empty(size, np.int64)
    n, number = 0, -1
    for q in range(edges.shape[0]):
        first, end = edges[q, 0], edges[q, 1]
        f = fits[edges[q, 3], edges[q, 4]]
        p = q - 1 if q > 0 else edges.shape[0] - 1  # the edge before
        if edges[q, 2] == 0:
            number += 1
        if edges[q, 2] == 0 and not (closes and q == 0):
            bearing[n], radius[n] = t[first], 1.0 / (f[1] * c[first] + f[2] * s[first])
            n += 1
        elif end - first > 1:
            k = edges[p, 1] - 1
            g = fits[edges[p, 3], edges[p, 4]]
            _, at = bend(g, f, c, s, k, first)
            behind = t[k] if k < first else t[k] - TWO_PI
            bearing[n] = behind + at * (t[first] - behind)
            co, si = math.cos(bearing[n]), math.sin(bearing[n])
            one, variance_f = range_on(f, co, si)
            other, variance_g = range_on(g, co, si)
            radius[n] = (one * variance_g + other * variance_f) / (variance_f + variance_g)
            n += 1
        # else the vertex at the end of the edge before is the one shared with this lone return
        polyline[n - 1] = number
        follows = q + 1 < edges.shape[0] and edges[q + 1, 2] == 1
        if (not follows and not (closes and q + 1 == edges.shape[0])) or (
            follows and edges[q + 1, 1] - edges[q + 1, 0] == 1
        ):
            k = end - 1
            bearing[n] = t[k]
            radius[n] = r[k] if end - first == 1 else 1.0 / (f[1] * c[k] + f[2] * s[k])
            polyline[n] = number
            n += 1
    return bearing[:n].copy(), radius[:n].copy(), polyline[:n].copy()


@njit(cache=True)
def edges_of(t: np.ndarray, lo: int, hi: int, bearing: np.ndarray, closed: bool, edge: np.ndarray) -> None:
    """Write the edge that each return from lo to hi - 1 is on, by bearing; edge e goes from vertex e to the next."""
    n = bearing.size
    e, most = (-1, n - 1) if closed else (0, n - 2)
    for k in range(lo, hi):
        while e < most and t[k] > bearing[e + 1]:
            e += 1
        edge[k] = n - 1 if e < 0 else 0 if closed and t[k] > bearing[0] + TWO_PI else e


@njit(cache=True)
def misfit(
    c: np.ndarray, s: np.ndarray, r: np.ndarray, lo: int, hi: int, edge: np.ndarray, bearing: np.ndarray,
    radius: np.ndarray,
) -> float:  # fmt: skip
    """Sum of squared errors of range of returns lo to hi - 1 on the edges between vertices, m2."""
    n = bearing.size
    cv, sv = np.cos(bearing), np.sin(bearing)
    total = 0.0
    for k in range(lo, hi):
        i = edge[k]
        j = i + 1 if i + 1 < n else 0
        after, before = s[k] * cv[i] - c[k] * sv[i], sv[j] * c[k] - cv[j] * s[k]
        side = radius[i] * after + radius[j] * before
        turn = sv[j] * cv[i] - cv[j] * sv[i]
        if side <= 0.0 or turn <= 0.0:
            return NEVER
        e = r[k] - radius[i] * radius[j] * turn / side
        total += e * e
    return total


@njit(cache=True)
def settle(
    c: np.ndarray, s: np.ndarray, t: np.ndarray, r: np.ndarray, lo: int, hi: int, closed: bool, bearing: np.ndarray,
    radius: np.ndarray,
) -> float:  # fmt: skip
    """Move the vertices of one polyline, in place, to the least squared error of range of returns lo to hi - 1.

    Damped Gauss-Newton steps in bearing and range of each vertex; the ends of an open polyline keep
    their bearings. Returns the error, m2.
    """
    n = bearing.size
    size = 2 * n
    edge, trial_edge = np.empty(r.size, np.int64), np.empty(r.size, np.int64)
    normal, factor = np.zeros((size, size)), np.zeros((size, size))
    gradient, step, d = np.empty(size), np.empty(size), np.empty(4)
    row = np.empty(4, np.int64)
    # first column of each row of the lower triangle that can differ from zero
    begin = np.maximum((np.arange(size) // 2 - 1) * 2, 0)
    if closed:
        begin[size - 2 :] = 0
    edges_of(t, lo, hi, bearing, closed, edge)
    error, damping = misfit(c, s, r, lo, hi, edge, bearing, radius), 1e-3
    for _ in range(STEPS):
        normal[:], gradient[:] = 0.0, 0.0
        cv, sv = np.cos(bearing), np.sin(bearing)
        for k in range(lo, hi):
            i = edge[k]
            j = i + 1 if i + 1 < n else 0
            after, before = s[k] * cv[i] - c[k] * sv[i], sv[j] * c[k] - cv[j] * s[k]
            side = max(radius[i] * after + radius[j] * before, 1e-12)
            turn, along = sv[j] * cv[i] - cv[j] * sv[i], cv[j] * cv[i] + sv[j] * sv[i]
            p = radius[i] * radius[j] * turn / side
            # derivatives of the predicted range p by bearing and range of either vertex
            d[0] = (p * radius[i] * (c[k] * cv[i] + s[k] * sv[i]) - radius[i] * radius[j] * along) / side
            d[1] = (radius[j] * turn - p * after) / side
            d[2] = (radius[i] * radius[j] * along - p * radius[j] * (c[k] * cv[j] + s[k] * sv[j])) / side
            d[3] = (radius[i] * turn - p * before) / side
            row[0], row[1], row[2], row[3] = 2 * i, 2 * i + 1, 2 * j, 2 * j + 1
            for a in range(4):
                gradient[row[a]] += d[a] * (r[k] - p)
                for b in range(4):
                    if row[b] <= row[a]:
                        normal[row[a], row[b]] += d[a] * d[b]
        if not closed:
            for a in (0, size - 2):
                for b in range(size):
                    normal[max(a, b), min(a, b)] = 0.0
                normal[a, a], gradient[a] = 1.0, 0.0
        gained = -1.0
        for _ in range(8):
            solve(normal, gradient, damping, begin, factor, step)
            new_bearing, new_radius = bearing + step[::2], radius + step[1::2]
            if ordered(new_bearing, new_radius, closed):
                edges_of(t, lo, hi, new_bearing, closed, trial_edge)
                new = misfit(c, s, r, lo, hi, trial_edge, new_bearing, new_radius)
                if new < error:
                    gained = error - new
                    bearing[:], radius[:], edge[:], error = new_bearing, new_radius, trial_edge, new
                    damping = max(0.1 * damping, 1e-7)
                    break
            damping *= 10.0
        if gained < SETTLED * error:
            break
    return error


@njit(cache=True)
def ordered(bearing: np.ndarray, radius: np.ndarray, closed: bool) -> bool:
    """Whether the vertices follow each other by bearing, at positive ranges."""
    for i in range(bearing.size):
        after = bearing[i + 1] if i + 1 < bearing.size else bearing[0] + TWO_PI if closed else math.inf
        if not radius[i] * LONGEST > 1.0 or not after - bearing[i] > 1e-6:
            return False
    return True


@njit(cache=True)
def solve(
    normal: np.ndarray, gradient: np.ndarray, damping: float, begin: np.ndarray, factor: np.ndarray, out: np.ndarray
) -> None:
    """Solve (normal + damping * its diagonal) out = gradient by Cholesky within the envelope `begin`."""
    n = gradient.size
    for i in range(n):
        total = gradient[i]
        for j in range(begin[i], i):
            f = normal[i, j]
            for k in range(max(begin[i], begin[j]), j):
                f -= factor[i, k] * factor[j, k]
            factor[i, j] = f / factor[j, j]
            total -= factor[i, j] * out[j]
        f = normal[i, i] * (1.0 + damping) + 1e-9
        for k in range(begin[i], i):
            f -= factor[i, k] * factor[i, k]
        factor[i, i] = math.sqrt(max(f, 1e-12))
        out[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        out[i] /= factor[i, i]
        for j in range(begin[i], i):
            out[j] -= factor[i, j] * out[i]
