"""What can be seen from where: checkpoints, the places that see them, and the borders of those places."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numba import njit

from baselines.oracle.space import Space, sights
from polyexplore_gym.floorplan import FloorPlan
from polyexplore_gym.sim.coverage import grid_points, visible
from polyexplore_gym.sim.laser import cast_rays
from polyexplore_gym.sim.robot import walls_near

CHECKPOINT_SPACING = 0.3
"""Grid of the points to be seen, m."""
WALL_GAP = 0.01
"""Checkpoints keep this distance from walls, m: on a wall, rounding would decide."""
_BORDER = 1e-6
"""Places nearer than this (m) to where the disc touches a wall are left out: what is on a line sees nothing."""
_STEP = math.radians(3.0)
"""A circle is drawn in chords of at most this angle."""
_BESIDE = 1e-9
"""Rays pass a wall's end at this angle on either side, rad."""
_RANGE_TOLERANCE = 1e-9


def checkpoint_grid(plan: FloorPlan) -> np.ndarray:
    """(k, 2) m: the samples of the free area, seen or not."""
    points = grid_points(plan.segments, CHECKPOINT_SPACING)
    return np.ascontiguousarray(points[plan.clearance(points) >= WALL_GAP])


class Checkpoints:
    """The points of a plan that count as the map, and a grid of places within reach, with their views."""

    def __init__(self, plan: FloorPlan, space: Space, start: np.ndarray, max_range: float, spacing: float) -> None:
        """Samples every 0.3 m of the free area that a sensor of `max_range` can see from the start or some place.

        plan: the floor plan; space: `Space.inner` around start (2,); spacing: grid of the places, m.
        """
        self.walls, self.max_range = plan.segments, max_range
        points = checkpoint_grid(plan)
        places = grid_points(space.walls, spacing)
        border = shapely.multilinestrings(space.walls.reshape(-1, 2, 2))
        places = places[shapely.distance(border, shapely.points(places)) > _BORDER]
        rows = space.sees(places)
        reached = np.isfinite(space.distances(start, places, rows))
        self.places = np.vstack([start, places[reached]])
        """(N, 2) m: the start, then a grid of places within reach."""
        indptr, indices = self._views(self.places, points)
        seen = np.zeros(len(points), bool)
        seen[indices] = True
        self.points = np.ascontiguousarray(points[seen])
        """(C, 2) m: the checkpoints."""
        self.unseen = points[~seen]
        """(k, 2) m: samples of the free area that no place sees."""
        self.indptr, self.indices = indptr, (np.cumsum(seen) - 1).astype(np.int32)[indices]
        order = np.argsort(self.indices, kind="stable")
        self.viewers = np.repeat(np.arange(len(self.places), dtype=np.int32), np.diff(indptr))[order]
        """Places by the checkpoint that they see; row c is viewers[viewer_starts[c] : viewer_starts[c + 1]]."""
        self.viewer_starts = np.searchsorted(self.indices[order], np.arange(len(self.points) + 1))
        self.rows = space.sees(self.places)

    def _views(self, places: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return sights(self.walls, places, points, self.max_range + _RANGE_TOLERANCE)

    def view(self, place: int) -> np.ndarray:
        """Checkpoints seen from a place of the grid."""
        return self.indices[self.indptr[place] : self.indptr[place + 1]]

    def viewers_of(self, checkpoint: int) -> np.ndarray:
        """Places of the grid that see a checkpoint."""
        return self.viewers[self.viewer_starts[checkpoint] : self.viewer_starts[checkpoint + 1]]

    def seen_from(self, points: np.ndarray) -> np.ndarray:
        """Checkpoints seen from any of points (k, 2): sorted, each once."""
        return np.unique(self._views(points, self.points)[1])

    def seen_along(self, a: np.ndarray, b: np.ndarray, step: float) -> np.ndarray:
        """Checkpoints seen from the segment a, b, looking at both ends and at most every `step` m between: sorted."""
        found: np.ndarray = _seen_along(self.walls, a, b, step, self.points, self.max_range + _RANGE_TOLERANCE)
        return found


@njit(cache=True)
def _seen_along(walls, a, b, step, points, reach):  # type: ignore[no-untyped-def]
    """Indices of the points (n, 2) seen from samples of the segment a, b; each sample tests what is still unseen."""
    x0, x1 = min(a[0], b[0]) - reach, max(a[0], b[0]) + reach
    y0, y1 = min(a[1], b[1]) - reach, max(a[1], b[1]) + reach
    near = walls_near(walls, x0, y0, x1, y1)
    local = walls[near]
    left = np.empty(points.shape[0], np.int32)
    count = 0
    for i in range(points.shape[0]):
        if x0 <= points[i, 0] <= x1 and y0 <= points[i, 1] <= y1:
            left[count] = i
            count += 1
    out, found = np.empty(count, np.int32), 0
    slots, dx, dy = np.empty(count, np.int32), np.empty(count), np.empty(count)
    pieces = max(1, math.ceil(math.hypot(b[0] - a[0], b[1] - a[1]) / step))
    for k in range(pieces + 1):
        x, y = a[0] + (b[0] - a[0]) * k / pieces, a[1] + (b[1] - a[1]) * k / pieces
        m = 0
        for j in range(count):
            ux, uy = points[left[j], 0] - x, points[left[j], 1] - y
            if ux * ux + uy * uy <= reach * reach:
                slots[m], dx[m], dy[m] = j, ux, uy
                m += 1
        shown = visible(local, x, y, dx[:m], dy[:m], reach)
        for j in range(m):
            if shown[j]:
                out[found] = left[slots[j]]
                found += 1
                left[slots[j]] = -1
        kept = 0
        for j in range(count):
            if left[j] >= 0:
                left[kept] = left[j]
                kept += 1
        count = kept
    return np.sort(out[:found])


@njit(cache=True)
def _breakpoints(walls, x, y, reach):  # type: ignore[no-untyped-def]
    """Bearings (n,) from a point at which the nearest wall may change: walls' ends, and where they leave the range."""
    out, n = np.empty(4 * walls.shape[0]), 0
    for k in range(walls.shape[0]):
        ax, ay, bx, by = walls[k, 0] - x, walls[k, 1] - y, walls[k, 2] - x, walls[k, 3] - y
        if math.hypot(ax, ay) <= reach:
            out[n] = math.atan2(ay, ax)
            n += 1
        if math.hypot(bx, by) <= reach:
            out[n] = math.atan2(by, bx)
            n += 1
        ex, ey = bx - ax, by - ay
        a, b, c = ex * ex + ey * ey, ax * ex + ay * ey, ax * ax + ay * ay - reach * reach
        root = b * b - a * c
        if root > 0.0:
            for sign in (-1.0, 1.0):
                t = (-b + sign * math.sqrt(root)) / a
                if 0.0 <= t <= 1.0:
                    out[n] = math.atan2(ay + t * ey, ax + t * ex)
                    n += 1
    return out[:n]


def visibility_ring(walls: np.ndarray, point: np.ndarray, max_range: float) -> np.ndarray:
    """Border (n, 2) of what is seen from a point (2,) within max_range, closed; the circle is drawn from outside.

    So the polygon holds the true region, up to 1e-8 m of rounding: between two neighbouring bearings of
    `_breakpoints` one wall, or none, is the nearest.
    """
    x, y = float(point[0]), float(point[1])
    circle = np.arange(-math.pi, math.pi, _STEP)
    angles = np.sort(np.concatenate([_breakpoints(walls, x, y, max_range), circle]))
    angles = np.append(angles, angles[0] + 2.0 * math.pi)
    left, right = angles[:-1] + _BESIDE, angles[1:] - _BESIDE
    wide = right > left
    rays = np.stack([left[wide], right[wide]], axis=1)
    ranges = cast_rays(walls, x, y, rays.ravel(), max_range).reshape(-1, 2)
    beyond = max_range / np.cos(0.5 * (rays[:, 1] - rays[:, 0]) + _BESIDE)
    ranges = np.where(np.isfinite(ranges).all(axis=1)[:, None], ranges, beyond[:, None])
    ring = np.array(point) + ranges.reshape(-1, 1) * np.stack([np.cos(rays.ravel()), np.sin(rays.ravel())], axis=1)
    return np.vstack([ring, ring[:1]])


def windows(
    walls: np.ndarray, point: np.ndarray, max_range: float, area: shapely.Polygon, start: np.ndarray
) -> list[np.ndarray]:
    """The border of a point's viewer region within `area`: polylines (k, 2); none if `start` (2,) is in the region.

    Who comes from the start to see the point (2,) crosses one of them. Where a sight line ends at a wall the disc's
    centre cannot be, so only the open part of the border lies in the area.
    """
    border = shapely.LineString(visibility_ring(walls, point, max_range))
    if not border.intersects(shapely.LineString([point, start])):
        return []
    inside = shapely.intersection(border, area)
    lines = [np.asarray(line.coords) for line in shapely.get_parts(inside) if line.geom_type == "LineString"]
    return [line for line in lines if len(line) > 1]
