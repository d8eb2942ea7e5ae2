"""Places seen again: `close` recognises the last scans in scans taken long before, `agreeing` asks for two opinions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.mapping.logs.poses import between, compose
from polyexplore_gym.mapping.slam.align import align, target_of
from polyexplore_gym.mapping.slam.correlative import CELL, Field, Window, field_of, search
from polyexplore_gym.mapping.slam.front import thinned
from polyexplore_gym.mapping.slam.surface import Surface, merged

LONG_AGO = 10.0
"""A place is seen again after a way of so much, m."""
NEAR = 3.0
"""It lies so near, drift apart, m."""
LAST, AROUND = 6, 8
"""So many key scans, up to the last, are held against as many to both sides of one from before."""
DRIFT = (0.5, 0.03), (math.radians(4.0), math.radians(0.3))
"""Position (m) and heading (rad) may be off by so much, and by so much more a metre of way."""
FARTHEST = 5.0, math.radians(40.0)
"""But by no more, m and rad."""
RETURNS = 400
"""So many returns are looked at in a search."""
LEAST_SCORE = 0.55
"""Least mean likelihood of the returns in a loop ..."""
LEAST_SHARE = 0.6
"""... of the points on lines, those that have a counterpart ..."""
MOST_THROUGH = 0.1
"""... and of the beams, those that pass through walls."""
AGREE = 0.15, math.radians(2.0)
"""Two loops tell of the same error if they differ by no more, m and rad."""
WITHIN = 5
"""They must be so near in the order of the key scans."""
_CLEAR = 0.3
"""A beam passes through a wall that is farther than that from its end, m."""
_WALL = 0.7
"""Likelihood of a return from which on there is a wall."""


class Loop(NamedTuple):
    """The pose of key scan `new` seen from key scan `old`."""

    old: int
    new: int
    measured: np.ndarray
    """(3,) x, y (m), heading (rad)."""
    information: np.ndarray
    """(3, 3) in the frame of `new`."""


def uncertain(way: float) -> tuple[float, float]:
    """How far off a pose may be after a way (m) since a place was seen again: m, rad."""
    reach, turn = ((base + rate * way) for base, rate in DRIFT)
    return min(reach, FARTHEST[0]), min(turn, FARTHEST[1])


def candidate(poses: np.ndarray, way: np.ndarray, closed: float) -> int:
    """The key scan from long before whose place the last one may be seeing again: the nearest; -1: none.

    Args:
        poses: (k, 3) of the key scans.
        way: (k,) length of the way to each of them, m.
        closed: way when a place was last seen again, m.
    """
    reach, _ = uncertain(way[-1] - closed)
    away = np.hypot(*(poses[:, :2] - poses[-1, :2]).T)
    away[way > way[-1] - LONG_AGO] = np.inf
    at = int(away.argmin())
    return at if away[at] <= NEAR + reach else -1


def close(surfaces: list[Surface], poses: np.ndarray, old: int, window: tuple[float, float]) -> Loop | None:
    """Recognise the last key scans in those around one from long before.

    Args:
        surfaces: of the k key scans.
        poses: (k, 3) theirs.
        old: the one from before.
        window: how far off the last pose may be: m, rad.
    """
    new = len(poses) - 1
    lately = slice(max(new + 1 - LAST, 0), new + 1)
    then = slice(max(old - AROUND, 0), min(old + AROUND + 1, lately.start))
    query, known = merged(surfaces[lately], poses[lately], poses[new]), merged(surfaces[then], poses[then])
    if not len(query.feet) or not len(known.feet):
        return None
    field = field_of(known.points)
    found = search(field, thinned(query.points, RETURNS), Window(poses[new], *window), LEAST_SCORE)
    if found.score < 0.0:
        return None
    weak = np.diag([1.0, 1.0, 10.0])  # the scans alone must tell
    fitted = align(query, target_of(known), found.pose, weak)
    if fitted.share < LEAST_SHARE:
        return None
    moved = compose(fitted.pose, between(poses[new], poses[lately]))
    if _share_through(field, surfaces[lately], moved) > MOST_THROUGH:
        return None
    lately_seen = field_of(merged(surfaces[lately], moved).points)
    if _share_through(lately_seen, surfaces[then], poses[then]) > MOST_THROUGH:
        return None
    # the scans are not independent of each other: they count as one
    information = (fitted.information + weak) / (new + 1 - lately.start)
    return Loop(old, new, between(poses[old], fitted.pose), in_own_frame(information, fitted.pose[2]))


def in_own_frame(information: np.ndarray, heading: float) -> np.ndarray:
    """(3, 3) information of a pose in the frame of a map, as steps of the pose itself."""
    c, s = math.cos(heading), math.sin(heading)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn.T @ information @ turn


def agreeing(pending: list[Loop], poses: np.ndarray) -> bool:
    """Whether the last of some loops and one before it tell of the same error of the map."""
    last = pending[-1]
    told = compose(poses[last.old], last.measured)
    for loop in pending[:-1]:
        if loop.new == last.new or last.new - loop.new > WITHIN:
            continue
        other = compose(compose(poses[loop.old], loop.measured), between(poses[loop.new], poses[last.new]))
        off = between(told, other)
        if math.hypot(off[0], off[1]) <= AGREE[0] and abs(off[2]) <= AGREE[1]:
            return True
    return False


def _share_through(field: Field, surfaces: list[Surface], poses: np.ndarray) -> float:
    """Share of the beams of scans taken from poses (k, 3) that pass through walls of a field."""
    passed = sum(
        _through(field.levels[0], field.corner, pose, surface.points, CELL)
        for surface, pose in zip(surfaces, poses, strict=True)
    )
    return passed / max(sum(len(surface.points) for surface in surfaces), 1)


@njit(cache=True)
def _through(level: np.ndarray, corner: np.ndarray, pose: np.ndarray, points: np.ndarray, cell: float) -> int:
    rows, columns = level.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    passed = 0
    for k in range(len(points)):
        far = math.hypot(points[k, 0], points[k, 1])
        ux = (c * points[k, 0] - s * points[k, 1]) / far
        uy = (s * points[k, 0] + c * points[k, 1]) / far
        for n in range(int((far - _CLEAR) / cell)):
            j = math.floor((pose[0] + ux * n * cell - corner[0]) / cell)
            i = math.floor((pose[1] + uy * n * cell - corner[1]) / cell)
            if 0 <= i < rows and 0 <= j < columns and level[i, j] > _WALL:
                passed += 1
                break
    return passed
