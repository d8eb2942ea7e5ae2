"""Which walls of a map the beams contradict: what moved, doors that opened, lines through scattered returns.

A line map only gains walls: what one scan saw stays. Afterwards every beam is held against every wall that it met.
A beam that ended on the wall, within 5 cm + 3 sigma, speaks for the wall there; one that went on and met something
behind it speaks against it. A beam that met nothing speaks against a wall only from nearer than where others did see
that wall: a laser misses dark, bright and oblique surfaces from afar. A beam of which nothing is known says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit

from polyexplore_gym.mapping.extract import LEAST_RANGE
from polyexplore_gym.mapping.line_map import LineMap

RATIO = 3.0
"""A wall goes where more than so many beams passed through for each that ended on it."""

STEP = 0.05
"""Beams are counted on pieces of about this length, m."""
WINDOW = 2
"""The counts of so many pieces on both sides are added before they are compared: single beams scatter."""
LEAST_BEAMS = 5
"""Fewest beams that contradict a piece."""
LEAST_GAP = 0.2
"""Shortest part that is cut out of a wall, or left of it where something is cut out, m."""
CLEARANCE = 0.05
"""What lies within this + 3 sigma of a wall lies on it, m."""
BIN = 0.5
"""Beams that met nothing are counted by their distance to the wall, in steps of this, m."""
BINS = 64
"""So many steps; farther off, such a beam says nothing."""
OBLIQUE = math.cos(math.radians(80.0))
"""A more oblique beam says nothing."""


class Beams(NamedTuple):
    """One scan."""

    angles: np.ndarray
    """(b,) in the laser's frame, rad, increasing"""
    ranges: np.ndarray
    """(b,) m; the maximum range or more is no return. NaN and less than 1e-6: nothing is known"""
    pose: np.ndarray
    """(3,) of the laser"""
    covariance: np.ndarray
    """(3, 3) of the pose"""


def held_against(
    line_map: LineMap, scans: Iterable[Beams], max_range: float, var_range: float, var_angle: float, ratio: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What is left of a map's walls and fragments when all beams have been held against them.

    Args:
        line_map: as it stands; it does not change.
        scans: that it was made of.
        max_range: of the laser, m.
        var_range, var_angle: of the noise, m2, rad2.
        ratio: a wall goes where more than so many beams passed through for each that ended there; 0 keeps all.

    Returns:
        Rows (R,) of the map that were looked at; what is left of them, parts (K, 4), and the index among these rows of
        each (K,); and of each scan the share of its beams that passed through a wall, of those that met one (NaN: none
        did).
    """
    rows = np.flatnonzero(line_map.alive)
    # A row may have shrunk to a point, which is no obstacle of its own.
    rows = rows[(line_map.segments[rows, :2] != line_map.segments[rows, 2:]).any(axis=1)]
    whole, walls = line_map.segments[rows], line_map.line[rows] >= 0
    begin = pieces_of(whole)
    counts, misfits = Counts.zero(begin[-1]), []
    for scan in scans:
        noise = max_range, scan.pose, scan.covariance, var_range, var_angle
        stopped, passed = count(whole, begin, walls, scan.angles, scan.ranges, *noise, counts)
        misfits.append(passed / (stopped + passed) if stopped + passed else math.nan)
    if ratio > 0:
        parts, of = confirmed(whole, begin, counts.stopped, counts.through, ratio)
    else:
        parts, of = whole, np.arange(rows.size)
    return rows, parts, of, np.array(misfits)


def pieces_of(segments: np.ndarray) -> np.ndarray:
    """(R + 1,) where the pieces of each of R segments (R, 4) begin; the last entry is their number."""
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    return np.concatenate([[0], np.cumsum(np.maximum(np.ceil(length / STEP), 1))]).astype(np.int64)


class Counts(NamedTuple):
    """Beams on each of P pieces."""

    stopped: np.ndarray
    """(P,) that ended there."""
    passed: np.ndarray
    """(P,) that passed through it and ended behind it."""
    blank: np.ndarray
    """(P, BINS) that met nothing, by distance."""
    seen_from: np.ndarray
    """(P,) farthest place from which a beam ended there, m."""

    @classmethod
    def zero(cls, pieces: int) -> Counts:
        """No beam on any of so many pieces."""
        whole = np.zeros(pieces, np.int64), np.zeros(pieces, np.int64)
        return cls(*whole, np.zeros((pieces, BINS), np.int32), np.zeros(pieces))

    @property
    def through(self) -> np.ndarray:
        """(P,) beams that speak against each piece."""
        near = np.arange(BINS) < np.floor(self.seen_from / BIN)[:, None]
        return self.passed + (self.blank * near).sum(axis=1)


@njit(cache=True)
def count(
    segments: np.ndarray,
    begin: np.ndarray,
    walls: np.ndarray,
    angles: np.ndarray,
    ranges: np.ndarray,
    max_range: float,
    pose: np.ndarray,
    covariance: np.ndarray,
    var_range: float,
    var_angle: float,
    counts: Counts,
) -> tuple[int, int]:
    """Add one scan's beams to the counts of each piece; returns how many ended on walls, and passed through them.

    Args:
        segments: (R, 4) walls in the map frame, m.
        begin: of `pieces_of`; the counts are of begin[-1] pieces.
        walls: (R,) which segments are walls: the beams on them are told of.
        angles: (b,) beam angles in the laser's frame, rad, increasing.
        ranges: (b,) m; max_range or more is no return. NaN and less than 1e-6: nothing is known.
        pose, covariance: (3,) and (3, 3) of the laser.
        var_range, var_angle: of the noise, m2, rad2.
    """
    var_xy = 0.5 * (covariance[0, 0] + covariance[1, 1])
    var_turn = var_angle + covariance[2, 2]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n, stopped, passed = angles.size, 0, 0
    for i in range(segments.shape[0]):
        dx, dy = segments[i, 0] - pose[0], segments[i, 1] - pose[1]
        ax, ay = c * dx + s * dy, c * dy - s * dx
        dx, dy = segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1]
        ux, uy = c * dx + s * dy, c * dy - s * dx
        length = math.hypot(ux, uy)
        if length < 1e-9:
            continue
        ux, uy = ux / length, uy / length
        rho = ax * uy - ay * ux  # the normal (uy, -ux) points away from the laser if positive
        nx, ny = (uy, -ux) if rho >= 0.0 else (-uy, ux)
        rho = abs(rho)
        if rho > max_range:
            continue
        low, high = math.atan2(ay, ax), math.atan2(ay + length * uy, ax + length * ux)
        if low > high:
            low, high = high, low
        if high - low > math.pi:
            low, high = high, low + 2.0 * math.pi
        first, pieces = begin[i], begin[i + 1] - begin[i]
        for turn in range(-1, 2):
            shift = 2.0 * math.pi * turn
            if low + shift > angles[n - 1] or high + shift < angles[0]:
                continue
            for k in range(np.searchsorted(angles, low + shift), n):
                if angles[k] > high + shift:
                    break
                ct, st = math.cos(angles[k]), math.sin(angles[k])
                across = ct * nx + st * ny
                if across < OBLIQUE:
                    continue
                at = rho / across
                along = (at * ct - ax) * ux + (at * st - ay) * uy
                sigma = math.sqrt(var_range * across * across + var_xy + var_turn * at * at * (1.0 - across * across))
                tolerance = CLEARANCE + 3.0 * sigma
                q = first + min(max(int(along / length * pieces), 0), pieces - 1)
                if not ranges[k] >= LEAST_RANGE:
                    continue
                if ranges[k] >= max_range:
                    if max_range * across - rho > tolerance and at < BIN * BINS:
                        counts.blank[q, int(at / BIN)] += 1
                    continue
                beyond = ranges[k] * across - rho
                if beyond > tolerance:
                    counts.passed[q] += 1
                    passed += walls[i]
                elif beyond > -tolerance:
                    counts.stopped[q] += 1
                    stopped += walls[i]
                    counts.seen_from[q] = max(counts.seen_from[q], at)
    return stopped, passed


def confirmed(
    segments: np.ndarray, begin: np.ndarray, stopped: np.ndarray, against: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """The parts of the segments (R, 4) that are not contradicted: parts (K, 4) and the segment of each (K,).

    A piece is contradicted where more than `ratio` beams passed through it for each that ended on it.
    """
    parts, of = [], []
    for i, segment in enumerate(segments):
        stop, through = stopped[begin[i] : begin[i + 1]], against[begin[i] : begin[i + 1]]
        bad = (_around(through) >= LEAST_BEAMS) & (_around(through) > ratio * _around(stop))
        bad |= (_around(bad) > 0) & (through > ratio * stop)  # as far as the edges of the opening
        least = min(math.ceil(LEAST_GAP / STEP), bad.size)
        good = _long(~_long(bad, least), least) if bad.any() else ~bad
        edges = np.flatnonzero(np.diff(good.astype(int), prepend=0, append=0)).reshape(-1, 2)
        for a, b in edges / bad.size:
            along = segment[2:] - segment[:2]
            parts.append(
                segment if b - a == 1.0 else np.concatenate([segment[:2] + a * along, segment[:2] + b * along])
            )
            of.append(i)
    return np.array(parts).reshape(-1, 4), np.array(of, dtype=np.int64)


def _around(counts: np.ndarray) -> np.ndarray:
    """The sum over each piece and its WINDOW neighbours on both sides."""
    total = np.concatenate([[0], np.cumsum(counts)])
    at = np.arange(counts.size)
    return total[np.minimum(at + WINDOW + 1, counts.size)] - total[np.maximum(at - WINDOW, 0)]


def _long(mask: np.ndarray, least: int) -> np.ndarray:
    """The mask without runs shorter than `least`."""
    out = mask.copy()
    for a, b in np.flatnonzero(np.diff(mask.astype(int), prepend=0, append=0)).reshape(-1, 2):
        out[a:b] = b - a >= least
    return out
