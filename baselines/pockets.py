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
    k = len(edges)
    length = np.full((k, count), reach)
    ends_on = np.full((k, count), -2, dtype=np.int64)
    m = len(lines)
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
            c, s = math.cos(a), math.sin(a)
            dx, dy = c * nx - s * ny, s * nx + c * ny
            for j in range(m + k):
                if j < m:
                    ax, ay, bx, by = lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3]
                elif j - m != i:
                    ax, ay, bx, by = edges[j - m, 0], edges[j - m, 1], edges[j - m, 2], edges[j - m, 3]
                else:
                    continue
                wx, wy = bx - ax, by - ay
                det = dx * wy - dy * wx
                if abs(det) < 1e-12:
                    continue
                px, py = ax - ox, ay - oy
                t = (px * wy - py * wx) / det
                u = (px * dy - py * dx) / det
                if 0.0 <= t < length[i, r] and 0.0 <= u <= 1.0:
                    length[i, r] = t
                    ends_on[i, r] = -1 if j < m else j - m
    return length, ends_on


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
    shared = np.stack([(ends_on == j).mean(axis=1) for j in range(len(slots))], axis=1)
    return np.sqrt((length**2).mean(axis=1)), shared
