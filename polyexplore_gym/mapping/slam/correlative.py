"""Where was a scan taken? The best pose in a window, found by branch and bound: `search`.

A field holds how likely a return is in each cell. A pose is as good as the mean of the field over the scan's returns,
less a penalty for the distance from the guess. Maxima over blocks of 2, 4, 8, 16 cells bound the score of all
translations in such a block, so that most are never looked at (Olson, "Real-time correlative scan matching", ICRA
2009; Hess et al., "Real-time loop closure in 2D lidar SLAM", ICRA 2016).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

CELL = 0.05
"""Side of a cell, m."""
BLUR = 0.06
"""Standard deviation of a return around one seen before, m: of the noise and of half a cell."""
LEVELS = 5
"""Blocks have sides of 1, 2, .. 2 ** (LEVELS - 1) cells."""


class Field(NamedTuple):
    """How likely returns are, around what was seen."""

    levels: np.ndarray
    """(LEVELS, rows, columns) float32 in 0 to 1: the maximum over the block that begins at the cell."""
    corner: np.ndarray
    """(2,) x, y of the corner of cell (0, 0), m."""


class Window(NamedTuple):
    """Where to look, around a guess."""

    guess: np.ndarray
    """(3,) x, y (m), heading (rad)."""
    reach: float
    """Farthest off in x and y, m."""
    turn: float
    """Farthest off in heading, rad."""
    penalty: tuple[float, float] = (0.0, 0.0)
    """What it costs to be off by 1 m, by 1 rad; it grows with the square."""


class Found(NamedTuple):
    """The best pose in a window."""

    pose: np.ndarray
    """(3,) x, y, heading."""
    score: float
    """Mean of the field over the returns, 0 to 1, without the penalty; -1: there are no returns, or no pose is good
    enough. The pose is the guess then."""


def field_of(points: np.ndarray) -> Field:
    """The field around returns (n, 2), m, n >= 1."""
    margin = (2**LEVELS) * CELL
    corner = points.min(axis=0) - margin
    columns, rows = np.ceil((points.max(axis=0) + margin - corner) / CELL).astype(int) + 1
    return Field(_levels(points, corner, rows, columns, CELL, BLUR, LEVELS), corner)


def search(field: Field, points: np.ndarray, window: Window, least: float = -math.inf) -> Found:
    """The pose in a window from which returns fit a field best.

    Args:
        field: of `field_of`.
        points: (n, 2) returns in the frame of the scan, m.
        window: where to look. Translations go by cells, headings by what moves the farthest return by a cell.
        least: poses whose score less the penalty is not above this are of no interest, which saves time.
    """
    if not len(points):
        return Found(window.guess.copy(), -1.0)
    headings = _headings(points, window)
    shifts = math.ceil(window.reach / CELL)
    best, score = _search(
        field.levels, field.corner, points, window.guess, headings, shifts, window.penalty, CELL, least
    )
    if score < 0.0:
        return Found(window.guess.copy(), -1.0)
    x, y = window.guess[:2] + best[1:] * CELL
    return Found(np.array([x, y, window.guess[2] + headings[best[0]]]), score)


def _headings(points: np.ndarray, window: Window) -> np.ndarray:
    """(k,) headings to try, off the guess, rad."""
    far = max(float(np.quantile(np.hypot(points[:, 0], points[:, 1]), 0.9)), 1.0)
    step = max(CELL / far, math.radians(0.25))
    half = math.ceil(window.turn / step)
    return step * np.arange(-half, half + 1)


@njit(cache=True)
def _levels(
    points: np.ndarray, corner: np.ndarray, rows: int, columns: int, cell: float, blur: float, count: int
) -> np.ndarray:
    out = np.zeros((count, rows, columns), np.float32)
    reach = math.ceil(3.0 * blur / cell)
    for k in range(len(points)):
        j, i = int((points[k, 0] - corner[0]) / cell), int((points[k, 1] - corner[1]) / cell)
        for a in range(max(i - reach, 0), min(i + reach + 1, rows)):
            y = corner[1] + (a + 0.5) * cell - points[k, 1]
            for b in range(max(j - reach, 0), min(j + reach + 1, columns)):
                x = corner[0] + (b + 0.5) * cell - points[k, 0]
                d2 = x * x + y * y
                if d2 < 9.0 * blur * blur:
                    value = np.float32(math.exp(-0.5 * d2 / (blur * blur)))
                    if value > out[0, a, b]:
                        out[0, a, b] = value
    for n in range(1, count):
        half = 1 << (n - 1)
        for a in range(rows):
            for b in range(columns):
                value = out[n - 1, a, b]
                if a + half < rows:
                    value = max(value, out[n - 1, a + half, b])
                if b + half < columns:
                    value = max(value, out[n - 1, a, b + half])
                    if a + half < rows:
                        value = max(value, out[n - 1, a + half, b + half])
                out[n, a, b] = value
    return out


@njit(cache=True)
def _sum(level: np.ndarray, size: int, cells: np.ndarray, di: int, dj: int) -> float:
    """Sum of a level over cells (n, 2) moved by (di, dj); a block that begins before the field is cut to it."""
    rows, columns = level.shape
    total = 0.0
    for k in range(len(cells)):
        i, j = cells[k, 0] + di, cells[k, 1] + dj
        if i >= rows or j >= columns or i <= -size or j <= -size:
            continue
        if i >= 0 and j >= 0:
            total += level[i, j]
        else:  # the block of the same end that begins inside holds all of it
            total += level[max(i, 0), max(j, 0)]
    return total


@njit(cache=True)
def _least(d: int, size: int, last: int) -> float:
    """Least distance from 0 of the cells d .. d + size - 1, no farther than last."""
    if d > 0:
        return float(d)
    end = min(d + size - 1, last)
    return float(-end) if end < 0 else 0.0


@njit(cache=True)
def _search(
    levels: np.ndarray, corner: np.ndarray, points: np.ndarray, guess: np.ndarray, headings: np.ndarray, shifts: int,
    penalty: tuple[float, float], cell: float, least: float,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Best (index of the heading, shift in x, shift in y), and its score; -1: none is above `least`."""
    top = levels.shape[0] - 1
    block = 1 << top
    n, m = len(points), len(headings)
    side = (2 * shifts) // block + 1
    cells = np.empty((m, n, 2), np.int32)
    bounds = np.empty(m * side * side)
    for t in range(m):
        c, s = math.cos(guess[2] + headings[t]), math.sin(guess[2] + headings[t])
        for k in range(n):
            x = guess[0] + c * points[k, 0] - s * points[k, 1] - corner[0]
            y = guess[1] + s * points[k, 0] + c * points[k, 1] - corner[1]
            cells[t, k, 0], cells[t, k, 1] = math.floor(y / cell), math.floor(x / cell)
        for a in range(side):
            di = a * block - shifts
            for b in range(side):
                dj = b * block - shifts
                off = (_least(di, block, shifts) ** 2 + _least(dj, block, shifts) ** 2) * cell * cell
                cost = penalty[0] * off + penalty[1] * headings[t] ** 2
                bounds[(t * side + a) * side + b] = _sum(levels[top], block, cells[t], di, dj) / n - cost
    order = np.argsort(-bounds, kind="mergesort")
    best, best_value, best_score = np.zeros(3, np.int64), least, -1.0
    stack = np.empty((4 * top + 1, 3), np.int64)  # level, di, dj
    stack_bound = np.empty(4 * top + 1)
    for o in order:
        if bounds[o] <= best_value:
            break
        t, rest = o // (side * side), o % (side * side)
        stack[0, 0], stack[0, 1], stack[0, 2] = top, (rest // side) * block - shifts, (rest % side) * block - shifts
        stack_bound[0] = bounds[o]
        depth = 1
        turned = penalty[1] * headings[t] ** 2
        while depth > 0:
            depth -= 1
            level, di, dj = stack[depth]
            if stack_bound[depth] <= best_value:
                continue
            if level == 0:
                best_value = stack_bound[depth]
                best_score = best_value + penalty[0] * (di * di + dj * dj) * cell * cell + turned
                best[0], best[1], best[2] = t, dj, di
                continue
            half = 1 << (level - 1)
            begin = depth
            for a in range(2):
                for b in range(2):
                    i, j = di + a * half, dj + b * half
                    if i > shifts or j > shifts:
                        continue
                    off = (_least(i, half, shifts) ** 2 + _least(j, half, shifts) ** 2) * cell * cell
                    bound = _sum(levels[level - 1], half, cells[t], i, j) / n - penalty[0] * off - turned
                    if bound <= best_value:
                        continue
                    at = depth  # the best on top
                    while at > begin and stack_bound[at - 1] > bound:
                        stack_bound[at], stack[at] = stack_bound[at - 1], stack[at - 1]
                        at -= 1
                    stack_bound[at] = bound
                    stack[at, 0], stack[at, 1], stack[at, 2] = level - 1, i, j
                    depth += 1
    return best, best_score
