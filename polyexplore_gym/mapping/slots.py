"""Storage of the line map: rows and lines in slots, and the few ways they change."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.mapping.fit import wrap
from polyexplore_gym.mapping.grid import Grid, grid_put, grid_remove

MEMORY = 16  # inserts that a line remembers
STILL = 0.004  # of a door's width; a row whose ends move less counts as untouched


class Rows(NamedTuple):
    """Segments in slots, one entry a row."""

    segments: np.ndarray
    """(M, 4) as published: end points, free space seen on the left."""
    ends: np.ndarray
    """(M, 4) the same to the last bit; `segments` follows in steps of `STILL` or more."""
    end_variance: np.ndarray
    """(M, 2) variance of each end along the line, m2."""
    alive: np.ndarray
    line: np.ndarray
    """(M,) line slot, -1 for a fragment."""
    side: np.ndarray
    """(M,) 1: seen from the side of the map's origin, -1: from beyond the line; 0 for a fragment."""
    sigma: np.ndarray
    """(M,) standard deviation across the segment, m."""
    next: np.ndarray
    """(M,) next row on the same line, -1 at the end."""
    touched: np.ndarray
    """(M,) number of the insert that touched the row last."""
    lone: np.ndarray
    """(M,) of a fragment that stands for a lone return: where on it that lies, as a share of its length, outside 0 to 1
    if that part was known already; NaN for all others."""


class Lines(NamedTuple):
    """Lines in slots."""

    rho: np.ndarray
    alpha: np.ndarray
    covariance: np.ndarray
    alive: np.ndarray
    side: np.ndarray
    first: np.ndarray
    """First row on the line, -1 for none."""
    fed: np.ndarray
    """(N, MEMORY) numbers of inserts with a line of their scan for this one, each in the column number % MEMORY."""
    born: np.ndarray
    """Number of the insert that put the line there."""
    shared: np.ndarray
    """(N, 2, 3) E[e_line e_pose'] of (alpha, rho) and the pose of the last insert; 0 if that pose's error is new."""
    misfit: np.ndarray
    """(N, 3) fusions, the sum of their chi-squares, and how much that would grow with 1 m2 of `merge.unevenness`."""
    spread: np.ndarray
    """(N, 2, 2) covariance of what walls on the line are off the line beside `covariance`."""


class Slots(NamedTuple):
    """Free slots, used last in first out, and counters."""

    rows: np.ndarray
    lines: np.ndarray
    counts: np.ndarray
    """Number of free rows, free lines, inserts so far, touched rows of this insert."""
    touched: np.ndarray
    """Rows touched in this insert."""
    found: np.ndarray
    """Scratch for the answers of the spatial index."""


@njit(cache=True)
def facing(lines: Lines, i: int) -> float:
    """Direction of the line's normal that points away from where it was seen, rad."""
    return lines.alpha[i] if lines.side[i] > 0 else wrap(lines.alpha[i] + math.pi)


@njit(cache=True)
def oriented(lines: Lines, i: int) -> tuple[float, float, np.ndarray]:
    """The line with its normal pointing away from where it was seen (rho may be negative)."""
    p = lines.covariance[i]
    if lines.side[i] > 0:
        return lines.rho[i], lines.alpha[i], p
    q = p.copy()
    q[0, 1], q[1, 0] = -p[0, 1], -p[1, 0]
    return -lines.rho[i], wrap(lines.alpha[i] + math.pi), q


@njit(cache=True)
def oriented_shared(lines: Lines, i: int) -> np.ndarray:
    """(2, 3) `Lines.shared` of the line as `oriented` gives it."""
    out = lines.shared[i].copy()
    if lines.side[i] < 0:
        out[1] = -out[1]
    return out


@njit(cache=True)
def store(lines: Lines, i: int, rho: float, alpha: float, p: np.ndarray, shared: np.ndarray) -> None:
    """Write an oriented line into its slot with rho >= 0 and the side it was seen from."""
    lines.covariance[i, 0, 0], lines.covariance[i, 1, 1] = p[0, 0], p[1, 1]
    lines.shared[i] = shared
    if rho < 0.0:
        lines.rho[i], lines.alpha[i], lines.side[i] = -rho, wrap(alpha + math.pi), -1
        lines.covariance[i, 0, 1] = lines.covariance[i, 1, 0] = -p[0, 1]
        lines.shared[i, 1] = -shared[1]
    else:
        lines.rho[i], lines.alpha[i], lines.side[i] = rho, wrap(alpha), 1
        lines.covariance[i, 0, 1] = lines.covariance[i, 1, 0] = p[0, 1]


@njit(cache=True)
def carry(lines: Lines, dx: float, dy: float) -> None:
    """Take what lines share with the pose along a way: C <- C F' with F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]."""
    for i in range(lines.alive.size):
        if lines.alive[i]:
            for k in range(2):
                turn = lines.shared[i, k, 2]
                lines.shared[i, k, 0] -= dy * turn
                lines.shared[i, k, 1] += dx * turn


@njit(cache=True)
def feed(lines: Lines, line: int, stamp: int) -> None:
    lines.fed[line, stamp % MEMORY] = stamp


@njit(cache=True)
def told_apart(lines: Lines, i: int, j: int) -> bool:
    """Whether a scan had a line for each of the two, as far as they remember."""
    return bool(np.any((lines.fed[i] == lines.fed[j]) & (lines.fed[i] > 0)))


@njit(cache=True)
def touch(rows: Rows, slots: Slots, row: int) -> None:
    if rows.touched[row] != slots.counts[2]:
        rows.touched[row] = slots.counts[2]
        slots.touched[slots.counts[3]] = row
        slots.counts[3] += 1


@njit(cache=True)
def new_row(rows: Rows, slots: Slots) -> int:
    slots.counts[0] -= 1
    row = slots.rows[slots.counts[0]]
    rows.alive[row] = True
    rows.segments[row] = math.inf
    rows.lone[row] = math.nan
    return row


@njit(cache=True)
def free_row(rows: Rows, grid: Grid, slots: Slots, row: int) -> None:
    rows.alive[row] = False
    rows.line[row] = -1
    rows.side[row] = 0
    slots.rows[slots.counts[0]] = row
    slots.counts[0] += 1
    grid_remove(grid, row)
    touch(rows, slots, row)


@njit(cache=True)
def free_line(lines: Lines, slots: Slots, line: int) -> None:
    lines.alive[line] = False
    slots.lines[slots.counts[1]] = line
    slots.counts[1] += 1


@njit(cache=True)
def publish(rows: Rows, grid: Grid, slots: Slots, row: int, door: float) -> None:
    """Bring the published segment up to date if an end moved by `STILL` or more."""
    e, s = rows.ends[row], rows.segments[row]
    least = STILL * door
    if not (math.hypot(e[0] - s[0], e[1] - s[1]) < least and math.hypot(e[2] - s[2], e[3] - s[3]) < least):
        rows.segments[row] = e
        grid_put(grid, row, e[0], e[1], e[2], e[3])
        touch(rows, slots, row)


@njit(cache=True)
def unlink(rows: Rows, lines: Lines, slots: Slots, row: int) -> None:
    """Take a row off its line; a line without rows is freed."""
    line = rows.line[row]
    at = lines.first[line]
    if at == row:
        lines.first[line] = rows.next[row]
    else:
        while rows.next[at] != row:
            at = rows.next[at]
        rows.next[at] = rows.next[row]
    if lines.first[line] < 0:
        free_line(lines, slots, line)
