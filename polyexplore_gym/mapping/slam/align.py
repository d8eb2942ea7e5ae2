"""A scan against walls seen before, from a guess that is near: points to lines, `align`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.mapping.slam.surface import SIGMA, Surface

SIDE = 0.25
"""Side of the cells in which neighbours are looked up, m."""
REACHES = 0.25, 0.15, 0.1
"""How far off a point may be from its counterpart, m: from the first guess on, and nearer by and by."""
ROUNDS = 8
"""Iterations at each of them."""
SAME_WAY = 0.9
"""Least cosine of the angle between the normals of one wall in two scans."""


class Target(NamedTuple):
    """Points on lines, by cells."""

    feet: np.ndarray
    """(m, 2) m."""
    normals: np.ndarray
    """(m, 2)"""
    corner: np.ndarray
    """(2,) of cell (0, 0), m."""
    begin: np.ndarray
    """(rows, columns + 1) the points of a cell are those from `begin` to the next `begin`."""


class Aligned(NamedTuple):
    """A pose that was fitted."""

    pose: np.ndarray
    """(3,) x, y (m), heading (rad)."""
    information: np.ndarray
    """(3, 3) of the pose, from the points alone; m-2, m-1, 1."""
    matched: int
    """Points that have a counterpart."""
    share: float
    """Of the points on lines, those that have one, 0 to 1."""
    rms: float
    """Root mean square of their distances from the lines, m."""


def target_of(surface: Surface) -> Target:
    """The part of a surface that lies on lines, by cells."""
    feet = surface.feet
    if not len(feet):
        return Target(feet, surface.normals, np.zeros(2), np.zeros((1, 2), np.int64))
    corner = feet.min(axis=0) - SIDE
    at = np.floor((feet - corner) / SIDE).astype(np.int64)
    columns, rows = at.max(axis=0) + 2
    index = at[:, 1] * columns + at[:, 0]
    order = np.argsort(index, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(index, minlength=rows * columns))])
    begin = np.stack([ends[r * columns : (r + 1) * columns + 1] for r in range(rows)])
    return Target(feet[order], surface.normals[order], corner, begin)


def align(surface: Surface, target: Target, guess: np.ndarray, prior: np.ndarray, sigma: float = SIGMA) -> Aligned:
    """The pose from which a scan fits walls best.

    Each point on a line of the scan is held against the line at the nearest point of the target that was seen from the
    same side; distances across the lines count, with Cauchy's weights, until nothing changes.

    Args:
        surface: of the scan, in its own frame.
        target: what was seen before.
        guess: (3,) pose of the scan in the frame of the target.
        prior: (3, 3) information of the guess, which holds what the lines do not.
        sigma: standard deviation of a point across a line, m.
    """
    n = len(surface.feet)
    pose, information, matched, squares = _align(
        surface.points[:n], surface.normals, target, guess, prior, np.array(REACHES), ROUNDS, sigma
    )
    return Aligned(pose, information, matched, matched / max(n, 1), math.sqrt(squares / max(matched, 1)))


@njit(cache=True)
def _nearest(target: Target, x: float, y: float, nx: float, ny: float, reach: float) -> int:
    rows, columns = target.begin.shape[0], target.begin.shape[1] - 1
    i, j = math.floor((y - target.corner[1]) / SIDE), math.floor((x - target.corner[0]) / SIDE)
    best, best_d2 = -1, reach * reach
    for a in range(max(i - 1, 0), min(i + 2, rows)):
        lo, hi = max(j - 1, 0), min(j + 2, columns)
        if lo >= hi:
            continue
        for k in range(target.begin[a, lo], target.begin[a, hi]):
            dx, dy = x - target.feet[k, 0], y - target.feet[k, 1]
            d2 = dx * dx + dy * dy
            if d2 < best_d2 and nx * target.normals[k, 0] + ny * target.normals[k, 1] > SAME_WAY:
                best, best_d2 = k, d2
    return best


@njit(cache=True)
def _align(
    points: np.ndarray, normals: np.ndarray, target: Target, guess: np.ndarray, prior: np.ndarray, reaches: np.ndarray,
    rounds: int, sigma: float,
) -> tuple[np.ndarray, np.ndarray, int, float]:  # fmt: skip
    pose = guess.copy()
    h = np.zeros((3, 3))
    matched, squares = 0, 0.0
    for reach in reaches:
        for _ in range(rounds):
            h[:] = 0.0
            g, off = np.zeros(3), np.empty(3)
            matched, squares = 0, 0.0
            c, s = math.cos(pose[2]), math.sin(pose[2])
            for k in range(len(points)):
                rx, ry = c * points[k, 0] - s * points[k, 1], s * points[k, 0] + c * points[k, 1]
                nx, ny = c * normals[k, 0] - s * normals[k, 1], s * normals[k, 0] + c * normals[k, 1]
                at = _nearest(target, pose[0] + rx, pose[1] + ry, nx, ny, reach)
                if at < 0:
                    continue
                ux, uy = target.normals[at]
                r = ux * (pose[0] + rx - target.feet[at, 0]) + uy * (pose[1] + ry - target.feet[at, 1])
                lever = uy * rx - ux * ry
                w = 1.0 / (sigma * sigma * (1.0 + r * r / (4.0 * sigma * sigma)))
                j = (ux, uy, lever)
                for a in range(3):
                    g[a] -= w * j[a] * r
                    for b in range(3):
                        h[a, b] += w * j[a] * j[b]
                matched += 1
                squares += r * r
            for a in range(3):
                off[a] = guess[a] - pose[a]
            step = np.linalg.solve(h + prior, g + prior @ off)
            pose += step
            if math.hypot(step[0], step[1]) < 1e-5 and abs(step[2]) < 1e-6:
                break
    return pose, h, matched, squares
