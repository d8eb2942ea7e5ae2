"""What may lie behind a jump edge: rays into the unknown, until they meet a known wall or another jump edge."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numba import njit

RAYS = 12
"""Rays from a jump edge into the unknown, evenly spread over the half circle."""
REACH = 2.0
"""They end after so many laser ranges."""
LIFT = 0.05
"""They start so far (m) beyond the edge, off the walls that it ends on."""


@njit(cache=True)
def rays(
    edges: np.ndarray, heading: np.ndarray, lines: np.ndarray, count: int, lift: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the middles of jump edges (k, 4) into the unknown, the side to which the heading (k,) points.

    Returns:
        Lengths (k, count), m, and what ends them: -2 nothing within `reach`, -1 a line (m, 4), j >= 0 the jump edge j.
        They start `lift` (m) beyond the edge.
    """
    k, m = len(edges), len(lines)
    length = np.full((k, count), reach)
    ends_on = np.full((k, count), -2, dtype=np.int64)
    dx, dy = np.empty(count), np.empty(count)
    for i in range(k):
        ex, ey = edges[i, 2] - edges[i, 0], edges[i, 3] - edges[i, 1]
        size = max(math.hypot(ex, ey), 1e-9)
        nx, ny = -ey / size, ex / size
        if nx * math.cos(heading[i]) + ny * math.sin(heading[i]) < 0.0:
            nx, ny = -nx, -ny
        ox = 0.5 * (edges[i, 0] + edges[i, 2]) + lift * nx
        oy = 0.5 * (edges[i, 1] + edges[i, 3]) + lift * ny
        for r in range(count):
            a = math.pi * ((r + 0.5) / count - 0.5)
            dx[r] = math.cos(a) * nx - math.sin(a) * ny
            dy[r] = math.sin(a) * nx + math.cos(a) * ny
        for j in range(m + k):
            if j == m + i:
                continue
            ends = lines[j] if j < m else edges[j - m]
            px, py, qx, qy = ends[0] - ox, ends[1] - oy, ends[2] - ox, ends[3] - oy
            if px * nx + py * ny < 0.0 and qx * nx + qy * ny < 0.0:
                continue  # behind the edge
            if min(px, qx) > reach or max(px, qx) < -reach or min(py, qy) > reach or max(py, qy) < -reach:
                continue
            wx, wy = qx - px, qy - py
            for r in range(count):
                if (px * dy[r] - py * dx[r]) * (qx * dy[r] - qy * dx[r]) > 0.0:
                    continue  # both ends on one side of the ray
                det = dx[r] * wy - dy[r] * wx
                if abs(det) < 1e-12:
                    continue
                t = (px * wy - py * wx) / det
                if 0.0 <= t < length[i, r]:
                    length[i, r] = t
                    ends_on[i, r] = -1 if j < m else j - m
    return length, ends_on


def shares(ends_on: np.ndarray) -> np.ndarray:
    """Share (k, k) of the rays of each jump edge (row) that end on each other one, from what ends them (k, count)."""
    k, count = ends_on.shape
    row, ray = np.nonzero(ends_on >= 0)
    return np.bincount(row * k + ends_on[row, ray], minlength=k * k).reshape(k, k) / count


def pockets(observation: Mapping[str, np.ndarray], slots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What may lie behind the jump edges of some nodes (k,).

    Returns:
        Radius (k,) of the half disc that has the area which the rays sweep, m, and the share (k, k) of the rays of
        one edge that end on another: two that see each other lead into one room.
    """
    edges = np.asarray(observation["edges"], dtype=np.float64)[slots]
    heading = np.asarray(observation["node_heading"], dtype=np.float64)[slots]
    lines = np.asarray(observation["lines"], dtype=np.float64)[np.asarray(observation["line_mask"]) > 0, :4]
    reach = REACH * float(observation["max_range"][0])
    length, ends_on = rays(edges, heading, np.ascontiguousarray(lines), RAYS, LIFT, reach)
    return np.sqrt((length**2).mean(axis=1)), shares(ends_on)
