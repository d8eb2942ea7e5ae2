"""Pairs of scans that see the same walls, aligned once more on corrected poses: `pairs`, `pair_edges`."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from polyexplore_gym.mapping.logs.poses import between
from polyexplore_gym.mapping.slam.align import align, target_of
from polyexplore_gym.mapping.slam.graph import Edges
from polyexplore_gym.mapping.slam.loops import in_own_frame
from polyexplore_gym.mapping.slam.surface import Surface

NEAR = 4.0
"""Scans taken no farther apart are a pair, m ..."""
MOST = 10
"""... but a scan has at most so many partners before it: the nearest."""
LEAST_MATCHED = 20
"""Points on lines that both must see ..."""
LEAST_SHARE = 0.25
"""... of all that one of them sees."""
HOLD = 0.05, 0.02
"""Standard deviations with which the poses at hand hold what the lines of a pair do not, m and rad."""


def pairs(poses: np.ndarray) -> np.ndarray:
    """(e, 2) pairs (earlier, later) of key scans to be aligned: neighbours in the order, and in place.

    Args:
        poses: (n, 3) x, y (m), heading (rad).
    """
    out = []
    for k in range(1, len(poses)):
        off = between(poses[k], poses[:k])
        # scans that look another way see less in common: half a turn counts as two metres
        away = np.hypot(off[:, 0], off[:, 1]) + 2.0 / np.pi * np.abs(off[:, 2])
        away[-2:] = 0.0
        near = np.argsort(away, kind="stable")[:MOST]
        out += [(j, k) for j in sorted(near[away[near] <= NEAR].tolist())]
    return np.array(out, np.int64).reshape(-1, 2)


def pair_edges(
    surfaces: list[Surface],
    poses: np.ndarray,
    ends: np.ndarray,
    track: Callable[[Iterable[int], str], Iterable[int]] = lambda scans, what: scans,
) -> Edges:
    """Edges between scans, each pair aligned from the poses at hand; those that do not fit are left out.

    Args:
        surfaces: of the n key scans.
        poses: (n, 3) theirs.
        ends: (e, 2) of `pairs`.
        track: wraps the scans, to show progress.
    """
    hold = np.diag([HOLD[0] ** -2, HOLD[0] ** -2, HOLD[1] ** -2])
    targets = {}
    rows = []
    begin = np.searchsorted(ends[:, 1], np.arange(len(poses) + 1))
    for k in track(range(len(poses)), "pairs"):
        for i in ends[begin[k] : begin[k + 1], 0].tolist():
            if i not in targets:
                targets[i] = target_of(surfaces[i])
            guess = between(poses[i], poses[k])
            found = align(surfaces[k], targets[i], guess, hold)
            if found.matched >= LEAST_MATCHED and found.share >= LEAST_SHARE:
                information = in_own_frame(found.information, found.pose[2])
                rows.append((i, k, found.pose, information, True))
    return Edges.of(rows)
