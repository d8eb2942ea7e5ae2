"""Spatial index of segments: a hierarchical hashed grid, kept row by row.

A segment lies in exactly one cell, by its middle, on the level whose cells are at least as wide as
the segment. A query visits on each occupied level the cells within half a cell of the box, so its
cost does not depend on the size of the map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

LEVELS = 12  # cells of one unit to 2,048 units
MOST_CELLS = 4096.0  # a box over more cells of a level is compared with every row instead


class Grid(NamedTuple):
    """Chains of rows. `head` (buckets,), the rest one entry a row; -1 ends a chain or marks a row not held."""

    head: np.ndarray
    next: np.ndarray
    previous: np.ndarray
    bucket: np.ndarray
    cell: np.ndarray
    """(rows, 3) level and cell of each row."""
    occupied: np.ndarray
    """(LEVELS,) number of rows on each level."""
    unit: float
    """side of the smallest cells, m: a typical short wall"""


def empty_grid(rows: int, unit: float = 1.0) -> Grid:
    """An empty index with room for so many rows."""
    buckets = 1 << max(8, (2 * rows - 1).bit_length())
    return Grid(
        np.full(buckets, -1, np.int64),
        np.full(rows, -1, np.int64),
        np.full(rows, -1, np.int64),
        np.full(rows, -1, np.int64),
        np.zeros((rows, 3), np.int64),
        np.zeros(LEVELS, np.int64),
        unit,
    )


@njit(cache=True)
def bucket_of(level: int, ix: int, iy: int, buckets: int) -> int:
    h = (ix * 73856093) ^ (iy * 19349663) ^ (level * 83492791)
    return (h ^ (h >> 13)) & (buckets - 1)


@njit(cache=True)
def grid_remove(grid: Grid, row: int) -> None:
    if grid.bucket[row] < 0:
        return
    before, after = grid.previous[row], grid.next[row]
    if before >= 0:
        grid.next[before] = after
    else:
        grid.head[grid.bucket[row]] = after
    if after >= 0:
        grid.previous[after] = before
    grid.bucket[row] = -1
    grid.occupied[grid.cell[row, 0]] -= 1


@njit(cache=True)
def grid_put(grid: Grid, row: int, x1: float, y1: float, x2: float, y2: float) -> None:
    """Insert a row, or move it to where it lies now."""
    grid_remove(grid, row)
    extent = max(abs(x2 - x1), abs(y2 - y1))
    level, size = 0, grid.unit
    while size < extent and level < LEVELS - 1:
        level += 1
        size *= 2.0
    ix, iy = math.floor(0.5 * (x1 + x2) / size), math.floor(0.5 * (y1 + y2) / size)
    b = bucket_of(level, ix, iy, grid.head.size)
    grid.cell[row, 0], grid.cell[row, 1], grid.cell[row, 2] = level, ix, iy
    grid.previous[row], grid.next[row], grid.bucket[row] = -1, grid.head[b], b
    if grid.head[b] >= 0:
        grid.previous[grid.head[b]] = row
    grid.head[b] = row
    grid.occupied[level] += 1


@njit(cache=True)
def grid_query(grid: Grid, x0: float, y0: float, x1: float, y1: float, out: np.ndarray) -> int:
    """Write the rows whose segments may meet the box to out (large enough for all rows); returns their number."""
    count = 0
    size = 0.5 * grid.unit
    for level in range(LEVELS):
        size *= 2.0
        if grid.occupied[level] == 0:
            continue
        low_x, high_x = np.floor(x0 / size - 0.5), np.floor(x1 / size + 0.5)
        low_y, high_y = np.floor(y0 / size - 0.5), np.floor(y1 / size + 0.5)
        if not (high_x - low_x + 1.0) * (high_y - low_y + 1.0) <= MOST_CELLS:
            for row in range(grid.bucket.size):
                ix, iy = grid.cell[row, 1], grid.cell[row, 2]
                held = grid.bucket[row] >= 0 and grid.cell[row, 0] == level
                if held and low_x <= ix <= high_x and low_y <= iy <= high_y:
                    out[count] = row
                    count += 1
            continue
        for ix in range(int(low_x), int(high_x) + 1):
            for iy in range(int(low_y), int(high_y) + 1):
                row = grid.head[bucket_of(level, ix, iy, grid.head.size)]
                while row >= 0:
                    if grid.cell[row, 0] == level and grid.cell[row, 1] == ix and grid.cell[row, 2] == iy:
                        out[count] = row
                        count += 1
                    row = grid.next[row]
    return count
