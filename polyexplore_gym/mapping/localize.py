"""Correcting the pose by the line map: an extended Kalman filter on matched lines that knows what it shares with them.

Every wall of the map was put there from some pose, with that pose's error. A filter on the pose alone, which takes the
map as an independent reference, counts that error again with every scan and soon believes itself far better than it is.
So the joint covariance of the pose's error and all the lines' errors is kept,

    e_p (x, y, heading; 3)   P = E[e_p e_p'],   C = E[e_p e_l'],   L = E[e_l e_l'],   e_l (alpha, rho; 2 a line),

with e = true - estimated. A scan corrects the pose alone (Schmidt's filter, which "considers" the rest); the lines stay
with the line map, which fuses them in its own way. The covariance is right, to first order, for whatever gains are
used, so that nothing need be inflated. What is given up: a loop that closes does not bend the walls seen before. Steps:

- Moved: with dx, dy the estimated way, F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]: P <- F P F' + Q (the odometry's),
  C <- F C.
- Matched: line (alpha, rho) of the map is expected at (alpha - heading, rho - x cos(alpha) - y sin(alpha)). With Hp, Hl
  the derivatives by pose and line, R the scan line's covariance and U = Hp C + Hl L, T = Hp P + Hl C':
  S = T Hp' + (U)_line Hl' + R, K = T' S^-1, pose <- pose + K innovation, P <- P - K T, C <- C - K U. L stays. The
  scan line's own error v becomes one with the pose's: E[e_p v'] = V <- (I - K Hp) V for earlier lines, -K R for this.
- Fused: the map moves line j by a gain G towards the scan line as seen from the corrected pose, whose error is
  Kg e_p - H v (see `fit.to_map`): e_j <- (I - G) e_j + G (Kg e_p - H v). G need not be told: the map's covariance went
  from Pj to Pj+ = (I - G) Pj, so I - G = Pj+ Pj^-1, and where no match tells R, G (H R H') G' = Pj+ G' - G Kg Pg Kg' G'
  with the Pg that it was given.
- New: e_j = Kg e_p - H v.

R is the covariance of the fit and a little more (`BIAS`). Not exact: two lines of the map that one scan makes one count
as if the scan had brought the second.

The map itself is given the covariance of the pose *relative to the lines matched*, P - C_m L_mm^-1 C_m': what two walls
near each other share must not make its merge test lenient (parallel walls 20 cm apart, 50 m from the start, stay two).
So covariances of the map's lines are relative to their neighbours; how far all of them may be off is in the pose's.

Source of the idea: S. F. Schmidt, "Application of state-space methods to navigation problems" (1966).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from polyexplore_gym.mapping.extract import ScanLines
from polyexplore_gym.mapping.fit import by_pose as seen_by
from polyexplore_gym.mapping.fit import product, wrap
from polyexplore_gym.mapping.grid import Grid
from polyexplore_gym.mapping.line_map import LineMap
from polyexplore_gym.mapping.merge import MAX_TURN, box_query, interval_gap
from polyexplore_gym.mapping.slots import Lines, Rows, oriented

GATE = 9.21
"""A match must pass this chi-square gate (2 degrees of freedom, 99 %)."""
RIVAL_GATE = 18.4
"""Another line that passes this gate (99.99 %) makes the match ambiguous, unless both stand for one wall."""
# Lengths are shares of a door's width.
SAME_OFFSET, SAME_TURN = 0.08, 0.05
"""Two lines of the map that differ by less than this (offset, rad) at the place in question stand for one wall."""
LEAST_LENGTH = 2.0
"""Shorter walls are left out of account: with few returns a corner easily tilts them more than they say."""
OVERLAP = 0.4
"""Least overlap of two segments that are compared."""
BIAS = (0.001, 0.004)
"""What a scan's line may be off beside what its covariance says (rad, offset): returns of door frames and corners that
the fit cannot tell from the wall's, and walls a few centimetres apart that became one. Found on validation plans."""
NEAREST, FARTHEST = 0.2, 3.0
"""Walls are looked for so far from where they are expected at least, and at most."""


@dataclass(frozen=True, slots=True)
class Correction:
    """What a scan says of the pose that it was taken from."""

    pose: np.ndarray
    """(3,) corrected x, y (m) and heading (rad)."""
    covariance: np.ndarray
    """(3, 3) its covariance in the map's frame, that of the start."""
    relative: np.ndarray
    """(3, 3) its covariance relative to the lines matched: for the insertion into the line map."""
    matched: np.ndarray
    """(L,) the line slot that each line of the scan was matched with, -1 for none."""

    @classmethod
    def none(cls, pose: np.ndarray, covariance: np.ndarray) -> Correction:
        """The pose as it was."""
        return cls(pose, covariance, covariance, np.zeros(0, np.int64))


class Localizer:
    """Owner of the covariance that the pose and the lines of one `LineMap` share.

    Before every `LineMap.insert` call `correct`, insert with the pose and the relative covariance that it returns, and
    call `learn` after it.

    Example:
        >>> import numpy as np
        >>> from polyexplore_gym.config import SensorConfig
        >>> from polyexplore_gym.mapping import LineMap, Localizer, extract_lines
        >>> angles = np.linspace(-0.5, 0.5, 101)
        >>> wall = extract_lines(angles, 2.0 / np.cos(angles), SensorConfig())
        >>> line_map, localizer = LineMap(), Localizer()
        >>> for pose, sigma in ((np.zeros(3), 0.0), (np.array([0.05, 0.0, 0.01]), 0.1)):  # 5 cm and 0.01 rad off
        ...     fix = localizer.correct(wall, line_map, pose, np.eye(3) * sigma**2)
        ...     _ = line_map.insert(wall, fix.pose, fix.relative)
        ...     localizer.learn(line_map)
        >>> fix.matched, fix.pose.round(3) + 0.0
        (array([0]), array([0., 0., 0.]))
    """

    def __init__(self) -> None:
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._relative = np.zeros((3, 3))
        self._shared = np.zeros((3, 0))
        self._lines = np.zeros((0, 0))
        self._fused = np.zeros((0, 2, 2))
        self._born = np.zeros(0, np.int64)
        self._recent = np.zeros((0, 2), np.int64)
        self._matched = np.zeros(0, np.int64)
        self._noise = np.zeros((0, 3, 2))
        self._scanned = np.zeros((0, 2, 2))

    def correct(self, lines: ScanLines, line_map: LineMap, pose: np.ndarray, covariance: np.ndarray) -> Correction:
        """Match a scan's lines with the map's and correct the pose.

        Args:
            lines: of `extract_lines`.
            line_map: the map, as it was at the last `learn`.
            pose: (3,) predicted x, y (m) and heading (rad).
            covariance: (3, 3) of the prediction: that of the last correction, moved on.
        """
        pose, covariance = pose.copy(), covariance.copy()
        door = line_map.door
        scanned = lines.covariance + np.diag(np.square((BIAS[0], BIAS[1] * door)))
        known = self._fused.shape[0]
        _carry(self._shared, pose[0] - self._pose[0], pose[1] - self._pose[1])
        matched, noise = np.full(lines.rho.size, -1, np.int64), np.zeros((lines.rho.size, 3, 2))
        if known:
            length = np.hypot(*(lines.segments[:, 2:] - lines.segments[:, :2]).T)
            length = np.bincount(lines.segment_line, length, lines.rho.size)
            order = np.argsort(-length, kind="stable")
            order = order[length[order] >= LEAST_LENGTH * door]
            rows, table, grid, scratch = line_map.tables
            _correct(
                order, lines.rho, lines.alpha, scanned, lines.segments, lines.segment_line, pose, covariance,
                self._shared, self._lines, rows, table, grid, scratch, matched, noise,
                door,
            )  # fmt: skip
            seen = np.unique(matched[matched >= 0])
            if seen.size:
                self._recent = np.stack((seen, self._born[seen]), axis=1)
        self._pose, self._covariance, self._matched, self._noise = pose, covariance, matched, noise
        self._scanned = scanned
        self._relative = self._relative_covariance()
        return Correction(pose.copy(), covariance.copy(), self._relative.copy(), matched)

    def _relative_covariance(self) -> np.ndarray:
        """P - C_m L_mm^-1 C_m' for the lines matched last."""
        slots, born = self._recent.T
        slots = slots[self._born[slots] == born]
        at = np.stack((2 * slots, 2 * slots + 1), axis=1).ravel()
        if not at.size:
            return self._covariance
        own = self._lines[np.ix_(at, at)]
        scale = 1.0 / np.sqrt(np.diag(own))
        scaled = own * np.outer(scale, scale) + 1e-9 * np.eye(at.size)  # lines that share all of their error
        shared = self._shared[:, at] * scale
        out = self._covariance - shared @ np.linalg.solve(scaled, shared.T)
        values, vectors = np.linalg.eigh(0.5 * (out + out.T))
        return (vectors * np.maximum(values, 0.0)) @ vectors.T

    def covariance(self, line_map: LineMap) -> np.ndarray:
        """(N, 2, 2) covariance of each line (alpha, rho) in the frame of the start; that of `LineMap` is relative."""
        n = line_map.rho.size
        out = np.zeros((n, 2, 2))
        for i, k in np.ndindex(2, 2):
            out[:, i, k] = np.diagonal(self._lines[i : 2 * n : 2, k : 2 * n : 2])
        out[line_map.line_side < 0] *= [[1.0, -1.0], [-1.0, 1.0]]
        return out + line_map.tables[1].spread[:n]

    def learn(self, line_map: LineMap) -> None:
        """Follow what the insertion made of the lines; once after each insert."""
        table = line_map.tables[1]
        n = table.rho.size
        if n > self._fused.shape[0]:
            old = self._fused.shape[0]
            shared, lines = np.zeros((3, 2 * n)), np.zeros((2 * n, 2 * n))
            shared[:, : 2 * old], lines[: 2 * old, : 2 * old] = self._shared, self._lines
            fused, born = np.zeros((n, 2, 2)), np.zeros(n, np.int64)
            fused[:old], born[:old] = self._fused, self._born
            self._shared, self._lines, self._fused, self._born = shared, lines, fused, born
        _learn(
            line_map.rho.size, self._pose, self._covariance, self._relative, self._matched, self._noise,
            self._scanned, self._shared, self._lines, self._fused, self._born, table,
        )  # fmt: skip


@njit(cache=True)
def _carry(shared: np.ndarray, dx: float, dy: float) -> None:
    """C <- F C for a way of (dx, dy)."""
    for k in range(shared.shape[1]):
        shared[0, k] -= dy * shared[2, k]
        shared[1, k] += dx * shared[2, k]


@njit(cache=True)
def _seen_from(pose: np.ndarray, rho: float, alpha: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """A line of the map as seen from a pose: rho, alpha, and the derivatives of (alpha, rho) by pose and by line."""
    c, s = math.cos(alpha), math.sin(alpha)
    by_pose, by_line = np.zeros((2, 3)), np.zeros((2, 2))
    by_pose[0, 2] = -1.0
    by_pose[1, 0], by_pose[1, 1] = -c, -s
    by_line[0, 0] = by_line[1, 1] = 1.0
    by_line[1, 0] = pose[0] * s - pose[1] * c
    return rho - pose[0] * c - pose[1] * s, wrap(alpha - pose[2]), by_pose, by_line


@njit(cache=True)
def _inverse(a: np.ndarray) -> np.ndarray:
    """Of a (2, 2) matrix."""
    out = np.empty((2, 2))
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    out[0, 0], out[0, 1], out[1, 0], out[1, 1] = a[1, 1] / det, -a[0, 1] / det, -a[1, 0] / det, a[0, 0] / det
    return out


@njit(cache=True)
def _innovation(
    rho: float, alpha: float, r: np.ndarray, j: int, pose: np.ndarray, p: np.ndarray, shared: np.ndarray,
    lines: np.ndarray, table: Lines,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:  # fmt: skip
    """Innovation (2, 1) of a scan line by line j, its covariance, the derivatives, and its squared size."""
    rho_j, alpha_j, _ = oriented(table, j)
    rho_e, alpha_e, by_pose, by_line = _seen_from(pose, rho_j, alpha_j)
    c, own = np.ascontiguousarray(shared[:, 2 * j : 2 * j + 2]), lines[2 * j : 2 * j + 2, 2 * j : 2 * j + 2].copy()
    cross = product(product(by_pose, c), by_line.T)
    s = product(product(by_pose, p), by_pose.T) + cross + cross.T + product(product(by_line, own), by_line.T) + r
    v = np.empty((2, 1))
    v[0, 0], v[1, 0] = wrap(alpha - alpha_e), rho - rho_e
    det = s[0, 0] * s[1, 1] - s[0, 1] * s[1, 0]
    if not (det > 0.0 and s[0, 0] > 0.0):
        return v, s, by_pose, by_line, math.inf
    d2 = (s[1, 1] * v[0, 0] ** 2 - 2.0 * s[0, 1] * v[0, 0] * v[1, 0] + s[0, 0] * v[1, 0] ** 2) / det
    return v, s, by_pose, by_line, d2


@njit(cache=True)
def _length(j: int, rows: Rows, table: Lines) -> float:
    """Length of the wall known on line j, m."""
    out = 0.0
    row = table.first[j]
    while row >= 0:
        e = rows.ends[row]
        out += math.hypot(e[2] - e[0], e[3] - e[1])
        row = rows.next[row]
    return out


@njit(cache=True)
def _match(
    i: int, rho: np.ndarray, alpha: np.ndarray, covariance: np.ndarray, segments: np.ndarray, of: np.ndarray,
    pose: np.ndarray, p: np.ndarray, shared: np.ndarray, lines: np.ndarray, rows: Rows, table: Lines, grid: Grid,
    found: np.ndarray, door: float,
) -> int:  # fmt: skip
    """The map's line that scan line i shows: seen from the same side, overlapping, within the gate, without a rival."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    alpha_0 = wrap(alpha[i] + pose[2])
    ux, uy = -math.sin(alpha_0), math.cos(alpha_0)
    sigma = math.sqrt(max(p[0, 0], p[1, 1]))
    placed = np.empty(4)
    best, best_d2, best_x, best_y = -1, RIVAL_GATE, 0.0, 0.0
    rival, rival_d2, rival_x, rival_y = -1, RIVAL_GATE, 0.0, 0.0
    for k in range(of.size):
        if of[k] != i:
            continue
        far = 0.0
        for e in range(2):
            x, y = segments[k, 2 * e], segments[k, 2 * e + 1]
            placed[2 * e], placed[2 * e + 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
            far = max(far, math.hypot(x, y))
        reach = min(NEAREST * door + 4.0 * (sigma + far * math.sqrt(p[2, 2])), FARTHEST * door)
        for q in range(box_query(grid, placed, reach, found)):
            j = rows.line[found[q]]
            if j < 0 or j in (best, rival):
                continue
            row = rows.segments[found[q]]
            if interval_gap(placed, row, ux, uy) > -OVERLAP * door:
                continue
            _, alpha_j, _ = oriented(table, j)
            if abs(wrap(alpha_0 - alpha_j)) > MAX_TURN or _length(j, rows, table) < LEAST_LENGTH * door:
                continue
            _, _, _, _, d2 = _innovation(rho[i], alpha[i], covariance[i], j, pose, p, shared, lines, table)
            x, y = 0.5 * (placed[0] + placed[2]), 0.5 * (placed[1] + placed[3])
            if d2 < best_d2 or (d2 == best_d2 and j < best):
                rival, rival_d2, rival_x, rival_y = best, best_d2, best_x, best_y
                best, best_d2, best_x, best_y = j, d2, x, y
            elif d2 < rival_d2:
                rival, rival_d2, rival_x, rival_y = j, d2, x, y
    if best < 0 or best_d2 > GATE:
        return -1
    if rival >= 0:
        rho_a, alpha_a, _ = oriented(table, best)
        rho_b, alpha_b, _ = oriented(table, rival)
        a = rho_a - rival_x * math.cos(alpha_a) - rival_y * math.sin(alpha_a)
        b = rho_b - rival_x * math.cos(alpha_b) - rival_y * math.sin(alpha_b)
        if abs(a - b) > SAME_OFFSET * door or abs(wrap(alpha_a - alpha_b)) > SAME_TURN:
            return -1
    return best


@njit(cache=True)
def _correct(
    order: np.ndarray, rho: np.ndarray, alpha: np.ndarray, covariance: np.ndarray, segments: np.ndarray,
    of: np.ndarray, pose: np.ndarray, p: np.ndarray, shared: np.ndarray, lines: np.ndarray, rows: Rows, table: Lines,
    grid: Grid, found: np.ndarray, matched: np.ndarray, noise: np.ndarray, door: float,
) -> None:  # fmt: skip
    """Match and correct line by line, the longest first, so that each match is judged by what the earlier ones gave.

    What was ambiguous is tried once more at the end. Pose, p, shared, matched and noise change in place.
    """
    for q in range(2 * order.size):
        i = order[q % order.size]
        if matched[i] >= 0:
            continue
        j = _match(i, rho, alpha, covariance, segments, of, pose, p, shared, lines, rows, table, grid, found, door)
        if j < 0:
            continue
        v, s, by_pose, by_line, _ = _innovation(rho[i], alpha[i], covariance[i], j, pose, p, shared, lines, table)
        t = product(by_pose, p) + product(by_line, np.ascontiguousarray(shared[:, 2 * j : 2 * j + 2].T))
        u = product(by_pose, shared) + product(by_line, lines[2 * j : 2 * j + 2])
        gain = product(np.ascontiguousarray(t.T), _inverse(s))
        step = product(gain, v)
        for a in range(3):
            pose[a] += step[a, 0]
        pose[2] = wrap(pose[2])
        p -= product(gain, t)
        for a in range(3):
            for b in range(a):
                p[a, b] = p[b, a] = 0.5 * (p[a, b] + p[b, a])
        shared -= product(gain, u)
        back = product(gain, by_pose)
        for k in range(matched.size):
            if matched[k] >= 0:
                noise[k] -= product(back, noise[k])
        noise[i] = -product(gain, covariance[i])
        matched[i] = j


@njit(cache=True)
def _not_negative(a: np.ndarray) -> np.ndarray:
    """The symmetric part of a (2, 2) matrix without negative variances, nor covariances that exceed them."""
    out = np.zeros((2, 2))
    out[0, 0], out[1, 1] = max(a[0, 0], 0.0), max(a[1, 1], 0.0)
    most = math.sqrt(out[0, 0] * out[1, 1])
    out[0, 1] = out[1, 0] = min(max(0.5 * (a[0, 1] + a[1, 0]), -most), most)
    return out


@njit(cache=True)
def _learn(
    count: int, pose: np.ndarray, p: np.ndarray, relative: np.ndarray, matched: np.ndarray, noise: np.ndarray,
    covariance: np.ndarray, shared: np.ndarray, lines: np.ndarray, fused: np.ndarray, born: np.ndarray, table: Lines,
) -> None:  # fmt: skip
    """Carry the joint covariance over an insertion (see the module's docstring); everything changes in place."""
    active = np.empty(count, np.int64)
    n = 0
    for j in range(count):
        if not table.alive[j]:
            continue
        _, _, now = oriented(table, j)
        if table.born[j] != born[j] or not np.array_equal(now, fused[j]):
            active[n] = j
            n += 1
    keep, by_pose = np.zeros((n, 2, 2)), np.zeros((n, 2, 3))
    own, with_pose = np.zeros((n, 2, 2)), np.zeros((n, 2, 3))
    for a in range(n):
        j = active[a]
        _, alpha, now = oriented(table, j)
        k = seen_by(alpha, pose)
        if table.born[j] == born[j]:
            keep[a] = product(now, _inverse(fused[j]))
        gain = np.eye(2) - keep[a]
        by_pose[a] = product(gain, k)
        turn = np.eye(2)
        turn[1, 0] = k[1, 2]
        # scan lines matched with this one count as one, the mean weighted by information
        seen = 0
        weight, v = np.zeros((2, 2)), np.zeros((3, 2))
        for i in range(matched.size):
            if matched[i] == j:
                information = _inverse(covariance[i])
                weight += information
                v += product(noise[i], information)
                seen += 1
        if seen > 0:
            r = _inverse(weight)
            moved = product(gain, turn)
            own[a] = product(product(moved, r), moved.T)
            with_pose[a] = -product(moved, product(r, np.ascontiguousarray(v.T)))
        else:
            own[a] = _not_negative(product(now, gain.T) - product(product(by_pose[a], relative), by_pose[a].T))
        fused[j], born[j] = now, table.born[j]

    # what the changed lines share with each other, then with the rest, then with the pose
    among = np.empty((n, n, 2, 2))
    for a in range(n):
        j = 2 * active[a]
        to_pose = product(keep[a], np.ascontiguousarray(shared[:, j : j + 2].T)) + product(by_pose[a], p)
        for b in range(a + 1):
            q = 2 * active[b]
            m = product(product(keep[a], lines[j : j + 2, q : q + 2].copy()), keep[b].T)
            m += product(to_pose + with_pose[a], by_pose[b].T) + product(by_pose[a], with_pose[b].T)
            m += product(product(by_pose[a], np.ascontiguousarray(shared[:, q : q + 2])), keep[b].T)
            if a == b:
                m += own[a]
            among[a, b], among[b, a] = m, m.T
    for a in range(n):
        j = 2 * active[a]
        row = product(keep[a], lines[j : j + 2, : 2 * count].copy()) + product(by_pose[a], shared[:, : 2 * count])
        lines[j : j + 2, : 2 * count] = row
        lines[: 2 * count, j : j + 2] = row.T
    for a in range(n):
        j = 2 * active[a]
        for b in range(n):
            q = 2 * active[b]
            lines[j : j + 2, q : q + 2] = among[a, b]
        column = product(keep[a], np.ascontiguousarray(shared[:, j : j + 2].T)) + product(by_pose[a], p) + with_pose[a]
        shared[:, j : j + 2] = column.T
