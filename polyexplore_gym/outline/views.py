"""What scans saw, each return moved onto the wall that it lies on, so that walls seen many times stand in one place."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import shapely
from numba import njit

from polyexplore_gym.config import SensorConfig
from polyexplore_gym.mapping import Beams, Walls

CLEARANCE = 0.05
"""A return within this + 3 sigma of a wall lies on it, m: as `mapping.evidence` has it."""
SPARE = 0.03
"""A wall may be so much longer at each end than the map knows, m."""
INSIDE = 0.1
"""A beam that goes through a wall ends there only so far from the wall's ends, m: they are not known better."""
OBLIQUE = math.cos(math.radians(87.0))
"""A more oblique beam is not moved: along the beam the wall is far away."""
CRACK = 0.02
"""What is narrower between parts that were seen has been seen, m."""
APART = 2.5
"""Between beams that are so many times as far apart as is usual in their scan nothing is known."""
LEAST_RANGE = 1e-6
"""Nothing is known of a beam with a shorter range, m."""
BLOCK = 256
"""So many scan polygons are joined at a time, which progress is shown by."""


class Views(NamedTuple):
    """What S scans saw, B beams together, in the map frame, m."""

    apexes: np.ndarray
    """(S, 2) where each was made"""
    first: np.ndarray
    """(S + 1,) its first beam, and B"""
    points: np.ndarray
    """(B, 2) where the beams end, of a scan in the order of their bearings"""
    hits: np.ndarray
    """(B,) whether there was a return"""
    noise: np.ndarray
    """(S, 2) variance of each scan's place, m2, and heading, rad2"""
    apart: np.ndarray
    """(B,) whether nothing is known between a beam and the next one of its scan, or the first after the last"""


def views_of(scans: Iterable[Beams], max_range: float) -> Views:
    """The scans in the map frame; beams of which nothing is known are left out, and with them what lies about them."""
    apexes, points, hits, apart, noise = [], [], [], [], []
    for scan in scans:
        known = (scan.ranges >= LEAST_RANGE) & np.isfinite(scan.angles)
        angles, ranges = scan.angles[known], np.minimum(scan.ranges[known], max_range)
        if angles.size < 3:
            continue
        step = np.diff(angles, append=angles[0] + 2.0 * math.pi)
        usual = float(np.median(step))
        gap = step > APART * usual
        # A beam stands for half a step on either side: else views that meet leave a crack.
        before, after = np.flatnonzero(np.roll(gap, 1)), np.flatnonzero(gap)
        wide = np.concatenate((angles[before] - 0.5 * usual, angles, angles[after] + 0.5 * usual))
        order = np.argsort(wide, kind="stable")
        bearing = wide[order] + scan.pose[2]
        ranges = np.concatenate((ranges[before], ranges, ranges[after]))[order]
        apexes.append(scan.pose[:2])
        noise.append((0.5 * (scan.covariance[0, 0] + scan.covariance[1, 1]), scan.covariance[2, 2]))
        points.append(scan.pose[:2] + ranges[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1))
        hits.append(ranges < max_range - 1e-9)
        apart.append(np.concatenate((np.zeros(len(before)), gap & False, np.ones(len(after))))[order] > 0)
    first = np.concatenate(([0], np.cumsum([len(some) for some in points])))
    if not apexes:
        none = np.zeros(0, np.bool_)
        return Views(np.zeros((0, 2)), first, np.zeros((0, 2)), none, np.zeros((0, 2)), none)
    together = np.concatenate(points), np.concatenate(hits), np.array(noise), np.concatenate(apart)
    return Views(np.array(apexes), first, *together)


@njit(cache=True)
def snap(
    segments: np.ndarray,
    sigma: np.ndarray,
    apex: np.ndarray,
    points: np.ndarray,
    hits: np.ndarray,
    var_range: float,
    var_angle: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The beams of one scan, those that end on a wall or behind it moved along the beam to where they meet it.

    Args:
        segments: (K, 4) of `Walls`.
        sigma: (K,) standard deviation of the scan's place across each, m.
        apex: (2,) of the scan, m.
        points, hits: (b, 2) and (b,) of its beams, by bearing.
        var_range, var_angle: of the noise, m2 and rad2.

    Returns:
        The ends (b, 2), and which segment each lies on (b,), -1: none.
    """
    n = points.shape[0]
    out, on = points.copy(), np.full(n, -1)
    reach, bearing, off = np.empty(n), np.empty(n), np.full(n, np.inf)
    for k in range(n):
        dx, dy = points[k, 0] - apex[0], points[k, 1] - apex[1]
        reach[k] = math.hypot(dx, dy)
        bearing[k] = math.atan2(dy, dx)
        if k:
            turn = (bearing[k] - bearing[k - 1]) % (2.0 * math.pi)
            bearing[k] = bearing[k - 1] + (turn if turn < math.pi else turn - 2.0 * math.pi)
    farthest, stop = reach.max(), reach.copy()
    for i in range(segments.shape[0]):
        ax, ay = segments[i, 0] - apex[0], segments[i, 1] - apex[1]
        ux, uy = segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1]
        length = math.hypot(ux, uy)
        if length < 1e-9:
            continue
        ux, uy = ux / length, uy / length
        rho = ax * uy - ay * ux  # > 0: the apex lies on the left
        if rho <= 0.0 or rho > farthest + CLEARANCE:
            continue
        low = math.atan2(ay - SPARE * uy, ax - SPARE * ux)
        span = (math.atan2(ay + (length + SPARE) * uy, ax + (length + SPARE) * ux) - low) % (2.0 * math.pi)
        low = bearing[0] + (low - bearing[0]) % (2.0 * math.pi) - 2.0 * math.pi
        for _ in range(3):
            for k in range(np.searchsorted(bearing, low), n):
                if bearing[k] > low + span:
                    break
                c, s = math.cos(bearing[k]), math.sin(bearing[k])
                across = c * uy - s * ux
                if across < OBLIQUE:
                    continue
                at = rho / across
                along = (at * c - ax) * ux + (at * s - ay) * uy
                beyond = (reach[k] - at) * across
                spread = var_range * across * across + var_angle * at * at * (1.0 - across * across) + sigma[i] ** 2
                if hits[k] and abs(beyond) <= CLEARANCE + 3.0 * math.sqrt(spread):
                    if abs(beyond) < off[k]:
                        off[k], on[k], stop[k] = abs(beyond), i, at
                elif beyond > 0.0 and INSIDE <= along <= length - INSIDE and at < stop[k]:
                    off[k], on[k], stop[k] = 0.0, i, at  # seen through by a few, or it would have been cut
            low += 2.0 * math.pi
    for k in range(n):
        if on[k] >= 0:
            out[k, 0] = apex[0] + stop[k] * math.cos(bearing[k])
            out[k, 1] = apex[1] + stop[k] * math.sin(bearing[k])
    return out, on


def seen(
    views: Views,
    walls: Walls,
    sensor: SensorConfig,
    track: Callable[[Iterable[int], str], Iterable[int]] = lambda scans, what: scans,
) -> tuple[Any, np.ndarray]:
    """The area that the scans saw, up to the walls.

    Args:
        views, walls: what was seen, and the walls on which it ends.
        sensor: its noise.
        track: wraps the scans, to show progress.

    Returns:
        The area (a shapely Polygon or MultiPolygon), and the returns (h, 2) that lie on no wall, m.
    """
    joined: list[Any] = []
    polygons: list[Any] = []
    loose = []
    for i in track(range(len(views.apexes)), "outline"):
        part = slice(views.first[i], views.first[i + 1])
        points, hits = views.points[part], views.hits[part]
        if len(points) < 3:
            continue
        noise = sensor.sigma_range**2, sensor.sigma_angle**2 + views.noise[i, 1]
        across = np.sqrt(walls.sigma**2 + views.noise[i, 0])
        ends, on = snap(walls.segments, across, views.apexes[i], points, hits, *noise)
        loose.append(points[hits & (on < 0)])
        gaps = np.flatnonzero(views.apart[part]) + 1
        ring = np.insert(ends, gaps, views.apexes[i], axis=0)
        polygon = shapely.Polygon(ring)
        polygons.append(polygon if polygon.is_valid else polygon.buffer(0))
        if len(polygons) == BLOCK:
            joined.append(shapely.union_all(polygons))
            polygons = []
    joined.append(shapely.union_all(polygons))
    area = shapely.union_all(joined)
    for way in (CRACK, -2.0 * CRACK, CRACK):
        area = shapely.buffer(area, 0.5 * way, join_style="mitre")
    return area, np.concatenate(loose) if loose else np.zeros((0, 2))
